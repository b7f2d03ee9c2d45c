"""A coloured triangle mesh and the colour at a point of its surface."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError

__all__ = ["TexturedMesh", "merge_meshes"]


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

    @property
    def centre(self) -> NDArray[np.float64]:
        """Centre of the axis-aligned bounding box [3], metres, at which training cameras look."""
        return (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2

    def transformed(self, matrix: NDArray[np.float64]) -> "TexturedMesh":
        """Return the mesh transformed by a homogeneous matrix [4, 4]; the colours are shared."""
        return dataclasses.replace(self, vertices=self.vertices @ matrix[:3, :3].T + matrix[:3, 3])

    def colors_at(self, face: NDArray[np.integer], barycentric: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Return the sRGB colours of points on the surface.

        Textures are sampled at the nearest texel: a pixel of a training view spans several texels and is averaged in a
        voxel, and bilinear weights would mix in foreign colours at the borders of a chart.

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
        a, b, c = np.moveaxis(self.uv[face], 1, 0)
        uv = a + second * (b - a) + third * (c - a)
        if len(self.textures) == 1:
            return _nearest_texel(self.textures[0], uv)
        colors = np.zeros((len(face), 3), np.uint8)
        texture = self.face_texture[face]
        for index in np.unique(texture):
            here = texture == index
            colors[here] = _nearest_texel(self.textures[index], uv[here])
        return colors


def _nearest_texel(image: NDArray[np.uint8], uv: NDArray[np.floating]) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    column = np.floor(uv[:, 0] * width).astype(np.int64) % width
    row = np.floor((1 - uv[:, 1]) * height).astype(np.int64) % height
    return image[row, column]


def merge_meshes(parts: Sequence[TexturedMesh]) -> TexturedMesh:
    """Merge meshes in the same frame into one.

    Raises:
        InputError: Some meshes have textures and others corner colours.
    """
    if len(parts) == 1:
        return parts[0]
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]).astype(np.int32)
    colors = [part.corner_colors for part in parts if part.corner_colors is not None]
    if len(colors) == len(parts):
        return TexturedMesh(vertices, faces, corner_colors=np.concatenate(colors))
    if colors:
        raise InputError("some parts of the mesh have textures and others vertex colours; bake them into one kind")
    first = np.cumsum([0, *(len(part.textures) for part in parts[:-1])])
    return TexturedMesh(
        vertices,
        faces,
        uv=np.concatenate([part.uv for part in parts if part.uv is not None]),
        textures=tuple(texture for part in parts for texture in part.textures),
        face_texture=np.concatenate(
            [part.face_texture + k for part, k in zip(parts, first, strict=True) if part.face_texture is not None]
        ).astype(np.int32),
    )
