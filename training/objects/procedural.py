"""Procedural objects of any number, with different shapes, proportions and paints, for training an embedding.

    mesh = procedural_object(12)        # the same for every call; metres, standing on z = 0

In each group of five successive seeds, the second object has the shape of the first in another paint, and the fourth
has the paint of the third on another shape. Therefore, neither shape nor colour alone separates all objects.
"""

import colorsys
import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom

from training.objects.mesh import TexturedMesh, box_surface, revolved_surface, superellipse, texel_centres, tube_surface

__all__ = ["procedural_object"]

TEXELS, SIDES = 128, 40
"""Side of a texture, and number of sides of a surface of revolution."""

SIZES = (0.03, 0.32)
"""Range of the longest side, metres."""

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Rng = np.random.Generator

_SIBLINGS = 5
_PALETTE, _TEXTURE, _SHAPE = range(3)
"""Random number streams of an object: for its palette, its textures and its shape."""


def procedural_object(seed: int) -> TexturedMesh:
    """Return the procedural object for a seed, which is a non-negative integer."""
    shape_seed = seed - (seed % _SIBLINGS == 1)
    paint = _paint(seed - (seed % _SIBLINGS == 3))
    rng = np.random.default_rng([_SHAPE, shape_seed])
    family = rng.choice(len(_FAMILIES), p=[*_FAMILIES.values()])
    mesh = [*_FAMILIES][family](rng, paint)
    vertices = mesh.vertices - mesh.centre
    if rng.random() < 0.3:
        vertices = vertices * (1 + rng.uniform(-0.2, 0.2, 3))
    if rng.random() < 0.15:
        height = vertices[:, 2:] / (np.ptp(vertices[:, 2]) + 1e-6)
        vertices = vertices * (1 + rng.uniform(-0.4, 0.4) * height * [1, 1, 0])
    longest = np.ptp(vertices, axis=0).max()
    mesh = dataclasses.replace(mesh, vertices=vertices * (np.clip(longest, *SIZES) / longest))
    if rng.random() < 0.5:
        mesh = mesh.moved(axis="x", degrees=float(rng.choice([0, 90])))
    return mesh.standing()


def _log_uniform(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


# ---------------------------------------------------------------------------------------------------------------- paint


def _paint(seed: int) -> "Paint":
    """Return a function from the number of a part to its texture; all parts share the colours of one palette."""
    rng = np.random.default_rng([_PALETTE, seed])
    palette, is_uniform = _palette(rng), rng.random() < 0.5

    def texture(part: int) -> Image:
        number = min(part, 1) if is_uniform else part
        rng = np.random.default_rng([_TEXTURE, seed, number])
        rotate = number > 0 and rng.random() < 0.5
        return _texture(rng, palette[1:] + palette[:1] if rotate else palette)

    return texture


def _palette(rng: Rng) -> list[Array]:
    """Return one to five sRGB colours [3], 0..255; the first is the background."""
    colors = [_color(rng) for _ in range(rng.integers(1, 6))]
    if len(colors) > 1 and rng.random() < 0.4:
        colors[1] = np.clip(np.array([235.0, 235.0, 230.0]) * rng.uniform(0.85, 1.05), 0, 255)
    return colors


def _color(rng: Rng) -> Array:
    kind = rng.random()
    if kind < 0.22:  # black, grey or white
        low, high = [(0.03, 0.25), (0.25, 0.7), (0.7, 0.98)][rng.integers(3)]
        hsv = rng.random(), rng.uniform(0, 0.12), rng.uniform(low, high)
    elif kind < 0.35:  # wood or cardboard
        hsv = rng.uniform(0.03, 0.12), rng.uniform(0.3, 0.7), rng.uniform(0.3, 0.8)
    else:
        hsv = rng.random(), rng.uniform(0.35, 1), rng.uniform(0.25, 1)
    return np.array(colorsys.hsv_to_rgb(*hsv)) * 255


def _noise(rng: Rng, cells: int) -> Array:
    """Return smooth periodic noise [TEXELS, TEXELS], about 0 to 1, with `cells` cells along each axis."""
    values = np.pad(rng.random((cells, cells)), ((0, 1), (0, 1)), mode="wrap")
    return zoom(values, TEXELS / (cells + 1), order=3)


def _texture(rng: Rng, palette: list[Array]) -> Image:
    """Return an image of the first colour with up to five patterns in colours of the palette."""
    image = np.full((TEXELS, TEXELS, 3), palette[0])
    u, v = texel_centres(TEXELS)
    for _ in range(rng.integers(0, 6) if rng.random() > 0.2 else 0):
        color = palette[rng.integers(len(palette))]
        image[_PATTERNS[rng.integers(len(_PATTERNS))](rng, u, v)] = color
    if rng.random() < 0.5:
        image *= 1 + rng.uniform(0.02, 0.25) * (2 * _noise(rng, int(rng.integers(2, 9))) - 1)[..., None]
    if rng.random() < 0.4:
        image += rng.normal(0, rng.uniform(2, 12), (TEXELS, TEXELS, 1))
    return image[::-1].clip(0, 255).astype(np.uint8)


def _around(u: Array, start: float) -> Array:
    """Return the distance from `start` in the direction of u, in [0, 1), since u is periodic."""
    return (u - start) % 1


def _band(rng: Rng, u: Array, v: Array) -> NDArray[np.bool_]:
    low, high = np.sort(rng.random(2))
    return (v > low) & (v < high)


def _sector(rng: Rng, u: Array, v: Array) -> NDArray[np.bool_]:
    return _around(u, rng.random()) < rng.uniform(0.05, 0.6)


def _panel(rng: Rng, u: Array, v: Array) -> NDArray[np.bool_]:
    left, middle = rng.random(2)
    width, height = rng.uniform(0.05, 0.5, 2)
    return (_around(u, left) < width) & (abs(v - middle) < height / 2)


def _ellipse(rng: Rng, u: Array, v: Array) -> NDArray[np.bool_]:
    left, middle = rng.random(2)
    width, height = rng.uniform(0.05, 0.35, 2)
    return ((_around(u, left + 0.5) - 0.5) / width) ** 2 + ((v - middle) / height) ** 2 < 1


def _blobs(rng: Rng, u: Array, v: Array) -> NDArray[np.bool_]:
    return _noise(rng, int(rng.integers(3, 14))) > rng.uniform(0.4, 0.75)


def _lettering(rng: Rng, u: Array, v: Array) -> NDArray[np.bool_]:
    pitch, middle, height = rng.uniform(0.03, 0.1), rng.random(), rng.uniform(0.1, 0.5)
    left, width = rng.random(), rng.uniform(0.2, 0.8)
    letters = np.kron(rng.random((32, 32)) > 0.35, np.ones((TEXELS // 32, TEXELS // 32), bool))
    lines = ((v - middle) / pitch % 1 < 0.55) & (abs(v - middle) < height / 2)
    return lines & (_around(u, left) < width) & letters


def _stripes(rng: Rng, u: Array, v: Array) -> NDArray[np.bool_]:
    return (u * rng.integers(2, 9) + round(rng.uniform(-2, 2)) * v) % 1 < rng.uniform(0.2, 0.6)


_PATTERNS = (_band, _sector, _panel, _ellipse, _blobs, _lettering, _stripes)

# --------------------------------------------------------------------------------------------------------------- shapes

Paint = Callable[[int], Image]
"""Function from the number of a part of an object to its texture."""


def _closed(profile: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return a profile closed by a flat bottom and top."""
    return [(0, profile[0][1]), *profile, (0, profile[-1][1])]


def _squashed(rng: Rng, least: float) -> float:
    return float(rng.choice([1, rng.uniform(least, 1)]))


def _box(rng: Rng, paint: Paint) -> TexturedMesh:
    """Return a box, book or brick; one in eight is a cube."""
    length = _log_uniform(rng, 0.04, 0.26)
    width = length * rng.uniform(0.3, 1)
    size = rng.permutation([length, width, width * rng.uniform(0.12, 1)])
    if rng.random() < 0.12:
        size = np.full(3, _log_uniform(rng, 0.035, 0.1))
    front, side, top = paint(0), paint(1), paint(2)
    back = front if rng.random() < 0.6 else paint(3)
    return box_surface(size.tolist(), [front, side, back, side, top, top])


def _can(rng: Rng, paint: Paint) -> TexturedMesh:
    r = _log_uniform(rng, 0.018, 0.06)
    h = min(r * _log_uniform(rng, 0.6, 5), 0.28)
    return revolved_surface(_closed([(0.93 * r, 0), (r, 0.003), (r, h - 0.003), (0.93 * r, h)]), paint(0), SIDES)


def _bottle(rng: Rng, paint: Paint) -> TexturedMesh:
    r = _log_uniform(rng, 0.02, 0.055)
    h = min(r * rng.uniform(3, 6.5), 0.3)
    neck, shoulder, slope = rng.uniform(0.25, 0.6) * r, rng.uniform(0.5, 0.85), rng.uniform(0.04, 0.15)
    profile = [(0.9 * r, 0), (r, 0.01 * h), (r * rng.uniform(0.85, 1.05), shoulder * h / 2), (r, shoulder * h)]
    profile += [(1.2 * neck, (shoulder + slope) * h), (neck, (shoulder + slope + 0.02) * h), (neck, h)]
    return revolved_surface(_closed(profile), paint(0), SIDES, rng.choice([2, 2, 3.5]), _squashed(rng, 0.5))


def _vessel(rng: Rng, paint: Paint) -> TexturedMesh:
    """Return a bowl, cup or mug."""
    r = _log_uniform(rng, 0.03, 0.09)
    h, base, wall = r * rng.uniform(0.5, 2.6), r * rng.uniform(0.5, 1), 0.003
    t = np.linspace(0, 1, 9)
    outside = np.stack([base + (r - base) * t ** rng.uniform(0.4, 1.2), h * t], axis=1)
    inside = outside[::-1] - [wall, 0]
    inside[-1, 1] = wall
    vessel = revolved_surface(np.concatenate([[[0, 0]], outside, inside, [[0, wall]]]), paint(0), SIDES)
    if rng.random() < 0.5:
        return vessel
    angle = np.radians(np.linspace(-85, 85, 13))
    reach = h * rng.uniform(0.25, 0.38)
    path = np.stack([0.9 * reach * np.cos(angle), 0 * angle, reach * np.sin(angle)], axis=1) + [0.93 * r, 0, h / 2]
    texture = paint(0 if rng.random() < 0.7 else 1)
    handle = tube_surface(path, np.tile([0.005, 0.007], (13, 1)), (0, 1, 0), texture, 10)
    return TexturedMesh.merged([vessel, handle])


def _ball(rng: Rng, paint: Paint) -> TexturedMesh:
    """Return a ball, fruit or rounded block."""
    r, e = _log_uniform(rng, 0.018, 0.08), rng.choice([2, 2, 2, 3, 4.5])
    height = rng.uniform(0.7, 1.6) if rng.random() < 0.6 else 1.0
    ring = superellipse(48, e)
    half = np.concatenate([ring[-13:], ring[1:13]])  # from the lowest point to the highest
    pear = 1 + rng.uniform(0, 0.25) * half[:, 1]
    profile = np.stack([r * half[:, 0].clip(0) * pear, height * r * half[:, 1]], axis=1)
    return revolved_surface(profile, paint(0), SIDES, rng.choice([2, 2, 3]), _squashed(rng, 0.55))


def _rod(rng: Rng, paint: Paint) -> TexturedMesh:
    """Return a straight or bent rod: pen, marker, screwdriver, banana, spoon."""
    length, t = _log_uniform(rng, 0.08, 0.28), np.linspace(-1, 1, 15)
    bend = rng.choice([0, 0, rng.uniform(0.1, 0.5)]) * length
    path = np.stack([t * length / 2, 0 * t, bend * (1 - t**2)], axis=1)
    radius = _log_uniform(rng, 0.004, 0.02)
    thickness = [
        lambda: np.interp(t, [-1, -0.9, 0.8, 1], [0.8, 1, 1, 0.3]),
        lambda: np.where(t < rng.uniform(-0.3, 0.3), 1, rng.uniform(0.25, 0.6)),
        lambda: np.sqrt(np.clip(1 - np.abs(t) ** 3, 0, 1)) + 0.1,
        lambda: 0.5 + rng.uniform(0.5, 3) * np.sin(np.clip((t - 0.55) / 0.45, 0, 1) * np.pi),
    ][rng.integers(4)]()
    radii = radius * np.stack([thickness, thickness * rng.uniform(0.6, 2)], axis=1)
    return tube_surface(path, radii, (0, 1, 0), paint(0), 14)


def _tool(rng: Rng, paint: Paint) -> TexturedMesh:
    """Return a handle with one to three other parts."""
    length, width = _log_uniform(rng, 0.06, 0.2), _log_uniform(rng, 0.012, 0.04)
    if rng.random() < 0.5:
        size = length, width, width * rng.uniform(0.5, 1.2)
        parts = [box_surface(size, [paint(0)] * 6).moved((0, 0, -size[2] / 2))]
    else:
        path = np.linspace([-length / 2, 0, 0], [length / 2, 0, 0], 6)
        parts = [tube_surface(path, np.full((6, 2), width / 2), (0, 1, 0), paint(0), 20)]
    for index in range(rng.integers(1, 4)):
        long, wide = length * rng.uniform(0.25, 0.9), _log_uniform(rng, 0.01, 0.05)
        if rng.random() < 0.5:
            part = box_surface((long, wide, wide * rng.uniform(0.4, 1.3)), [paint(1)] * 6)
        else:
            top = wide / 2 * rng.uniform(0.4, 1)
            profile = _closed([(wide / 2, -long / 2), (wide / 2, 0), (top, long / 2)])
            part = revolved_surface(profile, paint(1 + index), SIDES)
        part = part.moved(-part.centre, "y", rng.choice([0, 90, rng.uniform(0, 90)]))
        position = rng.uniform(-0.5, 0.5) * length, rng.uniform(-0.5, 0.5) * width, rng.uniform(-1, 1) * width
        parts.append(part.moved(position, "z", rng.choice([0, 90, rng.uniform(0, 180)])))
    return TexturedMesh.merged(parts)


def _plate(rng: Rng, paint: Paint) -> TexturedMesh:
    r = _log_uniform(rng, 0.03, 0.13)
    h = r * rng.uniform(0.06, 0.25)
    profile = _closed([(0.6 * r, 0), (r, 0.7 * h), (r, h), (0.6 * r, h / 2)])
    return revolved_surface(profile, paint(0), SIDES, ratio=_squashed(rng, 0.5))


def _scissors(rng: Rng, paint: Paint) -> TexturedMesh:
    """Return two crossing bars, most of them with rings: scissors, pliers, clamps."""
    length, width, angle = _log_uniform(rng, 0.08, 0.2), _log_uniform(rng, 0.006, 0.02), rng.uniform(5, 50)
    with_rings = rng.random() < 0.6
    theta, reach = np.radians(np.linspace(0, 330, 15)), rng.uniform(0.1, 0.25) * length
    loop = np.stack([reach * np.cos(theta), 0.7 * reach * np.sin(theta), 0 * theta], axis=1)
    parts = []
    for side in (-1, 1):
        bar = box_surface((length, width, width * rng.uniform(0.4, 1)), [paint(0)] * 6)
        shift = side * rng.uniform(0, 0.4) * length * np.sin(np.radians(angle))
        parts.append(bar.moved((0, shift, 0), "z", side * angle / 2))
        if with_rings:
            ring = tube_surface(loop, np.full((15, 2), 0.4 * width), (0, 0, 1), paint(1), 8)
            parts.append(ring.moved((-length / 2, side * 1.1 * reach, 0)))
    return TexturedMesh.merged(parts)


def _prism(rng: Rng, paint: Paint) -> TexturedMesh:
    r, h = _log_uniform(rng, 0.02, 0.07), _log_uniform(rng, 0.03, 0.2)
    return revolved_surface(_closed([(r, 0), (r * rng.uniform(0.3, 1), h)]), paint(0), int(rng.choice([3, 5, 6])))


_FAMILIES = {
    _box: 0.26,
    _can: 0.13,
    _bottle: 0.10,
    _vessel: 0.09,
    _ball: 0.07,
    _rod: 0.12,
    _tool: 0.10,
    _plate: 0.05,
    _scissors: 0.05,
    _prism: 0.03,
}
"""Family of shapes -> its probability."""
