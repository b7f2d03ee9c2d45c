"""Coloured triangle meshes: colours at surface points, and surfaces from which meshes are built (metres)."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import content_digest

__all__ = [
    "TexturedMesh",
    "arc_lengths",
    "box_surface",
    "revolved_surface",
    "superellipse",
    "texel_centres",
    "tube_surface",
]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class TexturedMesh:
    """A coloured triangle mesh; colours are unlit sRGB.

    The colours are either in textures (`uv`, `textures`, `face_texture`) or at the corners of the faces
    (`corner_colors`); the fields of the other kind are None or empty.

    Attributes:
        vertices: [V, 3] float64, metres.
        faces: [F, 3] int32.
        uv: [F, 3, 2] float32, per corner, origin at the image's lower left, repeating outside [0, 1]; or None.
        textures: images [h, w, 3] uint8.
        face_texture: [F] int32, index into `textures`; or None.
        corner_colors: [F, 3, 3] uint8; or None.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    uv: NDArray[np.float32] | None = None
    textures: tuple[NDArray[np.uint8], ...] = ()
    face_texture: NDArray[np.int32] | None = None
    corner_colors: NDArray[np.uint8] | None = None

    @classmethod
    def merged(cls, parts: Sequence["TexturedMesh"]) -> "TexturedMesh":
        """Merge meshes in the same frame into one.

        Raises:
            InputError: some meshes have textures and others corner colours.
        """
        offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])], dtype=np.int32)
        vertices = np.concatenate([part.vertices for part in parts])
        faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
        colors = [part.corner_colors for part in parts if part.corner_colors is not None]
        if len(colors) == len(parts):
            return cls(vertices, faces, corner_colors=np.concatenate(colors))
        if colors:
            raise InputError("some parts of the mesh have textures and others vertex colours; bake them into one kind")
        first = np.cumsum([0, *(len(part.textures) for part in parts[:-1])])
        uv = np.concatenate([part.uv for part in parts if part.uv is not None])
        textures = tuple(texture for part in parts for texture in part.textures)
        numbers = [part.face_texture + k for part, k in zip(parts, first, strict=True) if part.face_texture is not None]
        return cls(vertices, faces, uv, textures, np.concatenate(numbers).astype(np.int32))

    @property
    def centre(self) -> NDArray[np.float64]:
        """Centre of the axis-aligned bounding box [3], metres; training cameras look at it."""
        return (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2

    @property
    def longest_side(self) -> float:
        """Longest side of the axis-aligned bounding box, metres."""
        return float(np.ptp(self.vertices, axis=0).max())

    @property
    def digest(self) -> str:
        """SHA-256 of the arrays, since mesh files may refer to other files and meshes may not come from files."""
        parts: list[str | bytes] = []
        for array in (self.vertices, self.faces, self.uv, self.face_texture, self.corner_colors, *self.textures):
            parts += ["False"] if array is None else [repr((array.dtype.str, array.shape)), array.tobytes()]
        return content_digest(parts)

    def transformed(self, matrix: NDArray[np.float64]) -> "TexturedMesh":
        """Return the mesh transformed by a homogeneous matrix [4, 4]; the colours are shared."""
        return dataclasses.replace(self, vertices=self.vertices @ matrix[:3, :3].T + matrix[:3, 3])

    def moved(self, position: ArrayLike = (0, 0, 0), axis: str = "z", degrees: float = 0.0) -> "TexturedMesh":
        """Return the mesh rotated about a coordinate axis, then translated."""
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        matrix = np.eye(4)
        matrix[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
        matrix[:3, 3] = position
        return self.transformed(matrix)

    def standing(self) -> "TexturedMesh":
        """Return the mesh placed on z = 0, centred over the origin."""
        return self.moved((*-self.centre[:2], -self.vertices[:, 2].min()))

    def colors_at(self, face: NDArray[np.integer], barycentric: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Return the sRGB colours of points on the surface.

        Textures are sampled at the nearest texel, since bilinear weights would mix in wrong colours at the borders of a
        chart. A pixel of a training view spans several texels, and the pixels of a voxel are averaged anyway.

        Args:
            face: [n] integer, index into `faces`.
            barycentric: [n, 2], weights of the face's second and third corner.

        Returns:
            [n, 3] uint8.
        """
        second, third = barycentric[:, :1], barycentric[:, 1:]
        if self.corner_colors is not None:
            a, b, c = np.moveaxis(self.corner_colors[face].astype(np.float32), 1, 0)
            return np.rint(a + second * (b - a) + third * (c - a)).clip(0, 255).astype(np.uint8)
        assert self.uv is not None and self.face_texture is not None
        # NumPy is faster with each coordinate in a contiguous row.
        a, b, c = self.uv.take(face, axis=0).reshape(-1, 6).T.copy().reshape(3, 2, -1)
        uv = a + second.T * (b - a) + third.T * (c - a)
        if len(self.textures) == 1:
            return _nearest_texel(self.textures[0], uv)
        colors = np.zeros((len(face), 3), np.uint8)
        texture = self.face_texture[face]
        for index in np.unique(texture):
            here = texture == index
            colors[here] = _nearest_texel(self.textures[index], uv[:, here])
        return colors


def _nearest_texel(image: NDArray[np.uint8], uv: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the colours [n, 3] at texture coordinates [2, n]."""
    height, width = image.shape[:2]
    column = np.floor(uv[0] * width).astype(np.int64) % width
    row = np.floor((1 - uv[1]) * height).astype(np.int64) % height
    return image.reshape(-1, 3).take(row * width + column, axis=0)


def texel_centres(n: int) -> tuple[Array, Array]:
    """Return the coordinates u and v [n, n] of the centres of a texture's texels, bottom row first."""
    centres = (np.arange(n) + 0.5) / n
    u, v = np.meshgrid(centres, centres)
    return u, v


def _ring_surface(points: Array, v: Array, texture: NDArray[np.uint8]) -> TexturedMesh:
    """Return the surface through closed rings [k, n, 3]; u runs along a ring, `v` [k] across the rings."""
    k, n = points.shape[:2]
    corner = np.arange(k * n).reshape(k, n)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = points.reshape(-1, 3)
    first, second, third = np.moveaxis(vertices[faces], 1, 0)
    faces = faces[np.linalg.norm(np.cross(second - first, third - first), axis=1) > 1e-12]
    u, v = np.meshgrid(np.linspace(0, 1, n), v)
    # Coordinates are clipped, so that the last texel does not wrap around to the first.
    uv = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float32).clip(1e-4, 1 - 1e-4)
    return TexturedMesh(vertices, faces.astype(np.int32), uv[faces], (texture,), np.zeros(len(faces), np.int32))


def arc_lengths(points: Array) -> Array:
    """Return the relative arc length [k] of a line [k, d] at each of its points, from 0 to 1."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return length / length[-1]


def superellipse(sides: int, exponent: float = 2.0) -> Array:
    """Return a closed ring [sides + 1, 2] of radius 1 along the axes: a circle for exponent 2, squarer above."""
    theta = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.cos(theta), np.sin(theta)], axis=1)
    return np.sign(ring) * np.abs(ring) ** (2 / exponent)


def revolved_surface(
    profile: ArrayLike, texture: NDArray[np.uint8], sides: int, exponent: float = 2.0, ratio: float = 1.0
) -> TexturedMesh:
    """Return a surface of revolution about z.

    Args:
        profile: [k, 2] radius and height, metres; runs up the outside, and for a vessel down the inside.
        texture: image; u is the angle, v the arc length of the profile.
        sides: sides of the cross-section.
        exponent: exponent of the cross-section, see `superellipse`.
        ratio: width of the cross-section along y, divided by its width along x.
    """
    line, ring = np.asarray(profile, np.float64), superellipse(sides, exponent) * [1, ratio]
    section = np.concatenate([ring, np.ones((len(ring), 1))], axis=1)
    return _ring_surface(line[:, [0, 0, 1]][:, None, :] * section, arc_lengths(line), texture)


def tube_surface(
    path: ArrayLike, radii: ArrayLike, across: ArrayLike, texture: NDArray[np.uint8], sides: int
) -> TexturedMesh:
    """Return a tube along a path in a plane, with flat ends.

    Args:
        path: [k, 3] metres.
        radii: [k, 2] metres, in the plane and across it.
        across: [3] unit normal of the plane.
        texture: image; u is the angle (0 in the plane, 0.25 across it), v the arc length.
        sides: sides of the cross-section, an ellipse.
    """
    line, size, normal = (np.asarray(values, np.float64) for values in (path, radii, across))
    tangent = np.gradient(line, axis=0)
    inward = np.cross(normal, tangent / np.linalg.norm(tangent, axis=1, keepdims=True))
    x, y = superellipse(sides).T[:, None, :, None]
    around = size[:, None, :1] * x * inward[:, None] + size[:, None, 1:] * y * normal
    ends = np.broadcast_to(line[[0, -1], None], (2, sides + 1, 3))
    points = np.concatenate([ends[:1], line[:, None] + around, ends[1:]])
    return _ring_surface(points, np.concatenate([[0.0], arc_lengths(line), [1.0]]), texture)


QUAD_FACES = ((0, 1, 2), (0, 2, 3))
QUAD_UV = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float32).clip(1e-4, 1 - 1e-4)
"""Texture coordinates of the two triangles of a rectangle, within a texture that must not repeat."""


def box_surface(size: Sequence[float], textures: Sequence[NDArray[np.uint8]]) -> TexturedMesh:
    """Return a box that stands on z = 0, centred over the origin.

    Args:
        size: along x, y, z, metres.
        textures: of the sides -y (the front), +x, +y, -x, top and bottom, seen from outside.
    """
    x, y, z = size[0] / 2, size[1] / 2, size[2]
    low, high = ([[-x, -y, h], [x, -y, h], [x, y, h], [-x, y, h]] for h in (0, z))
    sides = [[low[k - 1], low[k], high[k], high[k - 1]] for k in (1, 2, 3, 0)]
    vertices = np.array([*sides, high, low[::-1]], np.float64).reshape(-1, 3)
    faces = (4 * np.arange(6, dtype=np.int32)[:, None, None] + np.array(QUAD_FACES, np.int32)).reshape(-1, 3)
    uv = np.tile(QUAD_UV, (6, 1, 1))
    return TexturedMesh(vertices, faces, uv, tuple(textures), np.arange(12, dtype=np.int32) // 2)
