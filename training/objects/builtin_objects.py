"""Eighteen procedural household objects, so that the demo needs no scans.

    objects = builtin_objects()
    objects["mug_blue"].vertices        # metres, z up, standing on z = 0

They are built from boxes and from surfaces through rings: surfaces of revolution, and rings swept along a path. Rules
in surface coordinates determine the colour of each texel.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from training.objects.mesh import TexturedMesh, arc_lengths, box_surface, revolved_surface, texel_centres, tube_surface

__all__ = ["COLOR_PAIRS", "SHAPE_PAIRS", "builtin_objects"]

COLOR_PAIRS = (("soup_can_red", "soup_can_green"), ("mug_blue", "mug_white"), ("cereal_box_yellow", "cereal_box_blue"))
"""Pairs with the same mesh and different colours."""

SHAPE_PAIRS = (("white_bowl", "white_plate"), ("white_bowl", "white_cup"), ("yellow_bottle", "yellow_box"))
"""Pairs with different meshes but the same colours, each on the same fraction of the surface."""

Color = tuple[int, int, int]
Array = NDArray[np.float64]
Mark = tuple[Color, Callable[..., Any]]
"""A colour and the region that it covers, a boolean function of surface coordinates (`_lathe`, `_sweep`, `_box`)."""

# Each colour stays in its regions of the colour network under other light. Neutral greys would not, so they are tinted.
RED, GREEN, BLUE, YELLOW = (196, 22, 30), (22, 135, 58), (30, 70, 182), (236, 194, 24)
ORANGE, BROWN, TAN, IVORY = (238, 112, 20), (116, 68, 30), (206, 160, 108), (238, 240, 204)
LIME, TEAL, STEEL, DARK = (186, 214, 52), (20, 150, 152), (152, 152, 192), (30, 32, 66)

SECTIONS = 48
"""Number of sides of a surface of revolution."""

TEXELS = 192


def _texture(base: Color, marks: Sequence[Mark], *coordinates: Array) -> NDArray[np.uint8]:
    """Return an image [TEXELS, TEXELS, 3] of `base` and marks; coordinates are [TEXELS, TEXELS], bottom row first."""
    image = np.full((TEXELS, TEXELS, 3), base, np.uint8)
    for color, where in marks:
        image[np.broadcast_to(where(*coordinates), image.shape[:2])] = color
    return image[::-1]


def _lathe(profile: ArrayLike, base: Color, *marks: Mark) -> TexturedMesh:
    """Return a surface of revolution about z.

    Args:
        profile: [k, 2] radius and height, metres; runs up the outside, and for a vessel down the inside.
        base: colour.
        marks: functions of angle (turns), radius, height, and position along the profile as a fraction of the surface.
    """
    line = np.asarray(profile, np.float64)
    v = arc_lengths(line)
    turn, height = texel_centres(TEXELS)
    r, z = (np.interp(height, v, line[:, k]) for k in (0, 1))
    share = np.cumsum(r[:, :1], axis=0)
    share = np.broadcast_to((share - r[:, :1] / 2) / share[-1], r.shape)
    return revolved_surface(line, _texture(base, marks, turn, r, z, share), SECTIONS)


def _sweep(
    path: ArrayLike, radii: ArrayLike, across: ArrayLike, base: Color, *marks: Mark, sides: int = 24
) -> TexturedMesh:
    """Return a tube with elliptical cross-section along a path in a plane, with flat ends.

    Args:
        path: [k, 3] metres.
        radii: [k, 2] metres, in the plane and across it.
        across: [3] unit normal of the plane.
        base: colour.
        marks: functions of the angle (turns; 0 in the plane, 0.25 across it) and of the fraction [0, 1] of the length.
        sides: sides of the cross-section.
    """
    return tube_surface(path, radii, across, _texture(base, marks, *texel_centres(TEXELS)), sides)


def _box(size: tuple[float, float, float], base: Color, *marks: Mark) -> TexturedMesh:
    """Return a box that stands on z = 0, centred over the origin.

    Args:
        size: along x, y, z, metres.
        base: colour.
        marks: functions of the side (0: -y, the front, 1: +x, 2: +y, 3: -x, 4: top, 5: bottom) and of u (to the right,
            seen from outside) and v (up) in [0, 1].
    """
    textures = [_texture(base, marks, np.full((TEXELS, TEXELS), k), *texel_centres(TEXELS)) for k in range(6)]
    return box_surface(size, textures)


def _arc(radius: float, start: float, stop: float, n: int) -> Array:
    """Return points [n, 2] on a circle about the origin; angles in degrees."""
    angle = np.radians(np.linspace(start, stop, n))
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _ellipse(x: Array, y: Array, centre: tuple[float, float], radii: tuple[float, float]) -> Any:
    """Return which coordinates lie inside an ellipse."""
    return ((x - centre[0]) / radii[0]) ** 2 + ((y - centre[1]) / radii[1]) ** 2 < 1


def _soup_can(label: Color) -> TexturedMesh:
    profile = [(0, 0.002), (0.031, 0.002), (0.033, 0), (0.033, 0.101), (0.031, 0.099), (0, 0.099)]
    across = 0.104  # width of half of the label, metres
    paper: Mark = (label, lambda u, r, z, s: (r > 0.0325) & (z > 0.004) & (z < 0.097))
    band: Mark = (IVORY, lambda u, r, z, s: (r > 0.0325) & (z > 0.004) & (z < 0.030))
    disc = ((0, 0.062), (0.014, 0.014))
    discs: Mark = (YELLOW, lambda u, r, z, s: (r > 0.0325) & _ellipse((u * 2 % 1 - 0.5) * across, z, *disc))
    return _lathe(profile, STEEL, paper, band, discs)


def _mug(outside: Color, inside: Color, stripe: Color) -> TexturedMesh:
    profile = [(0, 0), (0.038, 0), (0.041, 0.003), (0.041, 0.095), (0.038, 0.095), (0.038, 0.007), (0, 0.006)]
    hollow: Mark = (inside, lambda u, r, z, s: (r < 0.0395) & (z > 0.0055))
    ring: Mark = (stripe, lambda u, r, z, s: (r > 0.0405) & (abs(z - 0.070) < 0.009))
    body = _lathe(profile, outside, hollow, ring)
    arc = _arc(0.029, 90, -90, 15)
    path = np.stack([0.0395 + arc[:, 0] * 1.15, np.zeros(15), 0.049 + arc[:, 1]], axis=1)
    handle = _sweep(path, np.tile([0.0045, 0.0065], (15, 1)), (0, 1, 0), outside)
    return TexturedMesh.merged([body, handle])


def _cereal_box(ground: Color, panel: Color, bowl: Color) -> TexturedMesh:
    def front(k: Array) -> Any:
        return (k == 0) | (k == 2)

    def facts(k: Array, u: Array, v: Array) -> Any:
        return ((k == 1) | (k == 3)) & (v > 0.1) & (v < 0.5) & (u > 0.2) & (u < 0.8) & (v * 30 % 1 < 0.5)

    return _box(
        (0.16, 0.055, 0.235),
        ground,
        (IVORY, lambda k, u, v: (k < 4) & (v > 0.80) & (v < 0.92)),
        (panel, lambda k, u, v: front(k) & (v > 0.83) & (v < 0.89) & (u > 0.12) & (u < 0.88) & (u * 8 % 1 < 0.72)),
        (bowl, lambda k, u, v: front(k) & _ellipse(u, v, (0.5, 0.36), (0.34, 0.23)) & (v < 0.40)),
        (IVORY, lambda k, u, v: front(k) & _ellipse(u, v, (0.5, 0.40), (0.34, 0.05))),
        (panel, facts),
    )


def _crockery(profile: ArrayLike) -> TexturedMesh:
    """Return ivory crockery of any shape, with a blue rim on an eighth of the surface."""
    return _lathe(profile, IVORY, (BLUE, lambda u, r, z, s: abs(s - 0.5) < 0.0625))


def _bowl() -> TexturedMesh:
    angles = np.radians(np.linspace(12, 88, 12))
    outside = np.stack([0.078 * np.sin(angles), 0.004 + 0.062 * (1 - np.cos(angles)) * 1.02], axis=1)
    inside = outside[::-1] * [0.96, 1.0] + [0, 0.003]
    return _crockery([(0, 0), (0.030, 0), (0.030, 0.006), *outside[3:], *inside, (0, 0.007)])


def _plate() -> TexturedMesh:
    outside = [(0, 0), (0.060, 0), (0.068, 0.006), (0.088, 0.014), (0.108, 0.020)]
    return _crockery([*outside, (0.108, 0.023), (0.087, 0.018), (0.066, 0.009), (0.058, 0.004), (0, 0.004)])


def _cup() -> TexturedMesh:
    return _crockery([(0, 0), (0.029, 0), (0.032, 0.003), (0.042, 0.105), (0.0395, 0.105), (0.0295, 0.006), (0, 0.005)])


RED_SHARE = 0.22
"""Red fraction of the surface of the two yellow objects."""


def _yellow_bottle() -> TexturedMesh:
    shoulder = _arc(0.030, 0, 62, 8) * [1, 1.2] + [0.014, 0.122]
    profile = [(0, 0), (0.040, 0), (0.044, 0.005), *shoulder]
    profile += [(0.017, 0.162), (0.017, 0.178), (0.008, 0.181), (0.005, 0.196), (0, 0.196)]
    bottle = _lathe(profile, YELLOW, (RED, lambda u, r, z, s: s > 1 - RED_SHARE))
    return bottle.transformed(np.diag([1.0, 0.68, 1.0, 1.0]))


def _yellow_box() -> TexturedMesh:
    x, y, z = 0.11, 0.045, 0.085
    band = RED_SHARE * (2 * x * y + 2 * (x + y) * z) / (2 * (x + y) * z)
    return _box((x, y, z), YELLOW, (RED, lambda k, u, v: (k < 4) & (v > 0.9 - band) & (v < 0.9)))


def _banana() -> TexturedMesh:
    arc = _arc(0.115, -48, 48, 25)
    path = np.stack([arc[:, 1], 0.115 - arc[:, 0], np.zeros(25)], axis=1)
    t = np.linspace(-1, 1, 25)
    size = 0.018 * np.sqrt(np.clip(1 - np.abs(t) ** 3.2, 0, 1))
    size[-4:-1] = np.maximum(size[-4:-1], 0.0048)
    ends: Mark = (BROWN, lambda u, t: (t < 0.035) | (t > 0.93))
    spot: Mark = (BROWN, lambda u, t: (abs(u - 0.3) < 0.02) & (abs(t - 0.45) < 0.06))
    return _sweep(path, np.stack([size, size], axis=1), (0, 0, 1), YELLOW, ends, spot, sides=12).standing()


def _apple() -> TexturedMesh:
    phi = np.radians(np.linspace(-90, 90, 33))
    r = 0.038 * np.cos(phi) * (1 + 0.06 * np.sin(phi))
    z = 0.035 * np.sin(phi) - 0.013 * np.exp(-((r / 0.014) ** 2)) * np.sign(phi) * np.where(phi > 0, 1.0, 0.6)
    top: Mark = (LIME, lambda u, r, z, s: s > 0.94 + 0.02 * np.sin(u * 4 * np.pi))
    cheek: Mark = (ORANGE, lambda u, r, z, s: _ellipse(u, s, (0.35, 0.6), (0.16, 0.22)))
    body = _lathe(np.stack([r.clip(0), z], axis=1), RED, top, cheek)
    line = np.array([[0, 0, 0.019], [0.001, 0, 0.026], [0.003, 0, 0.034], [0.006, 0, 0.041]])
    stem = _sweep(line, [[0.0022] * 2, [0.0022] * 2, [0.0022] * 2, [0.003] * 2], (0, 1, 0), BROWN, sides=8)
    return TexturedMesh.merged([body, stem]).standing()


def _tennis_ball() -> TexturedMesh:
    phi = np.radians(np.linspace(-90, 90, 33))
    profile = 0.0335 * np.stack([np.cos(phi).clip(0), np.sin(phi)], axis=1)
    seam: Mark = (IVORY, lambda u, r, z, s: abs(np.arctan2(z, r) - 0.75 * np.sin(4 * np.pi * u)) < 0.085)
    return _lathe(profile, LIME, seam).standing()


def _sponge() -> TexturedMesh:
    def holes(k: Array, u: Array, v: Array) -> Any:
        return (k != 4) & ((u * 9 + 0.5 * np.floor(v * 4)) % 1 < 0.16) & (v * 4 % 1 < 0.35) & (v < 0.66)

    scourer: Mark = (TEAL, lambda k, u, v: (k == 4) | ((k < 4) & (v > 0.70)))
    return _box((0.115, 0.070, 0.042), ORANGE, scourer, (BROWN, holes))


def _screwdriver() -> TexturedMesh:
    profile = [(0, 0), (0.011, 0.001), (0.0155, 0.010), (0.0155, 0.080), (0.010, 0.090), (0.013, 0.100)]
    profile += [(0.0035, 0.103), (0.0035, 0.205), (0.0015, 0.212), (0, 0.212)]
    handle: Mark = (RED, lambda u, r, z, s: z < 0.1015)
    grooves: Mark = (DARK, lambda u, r, z, s: (z > 0.012) & (z < 0.080) & (u * 6 % 1 < 0.4))
    collar: Mark = (DARK, lambda u, r, z, s: (z > 0.084) & (z < 0.1015))
    return _lathe(profile, STEEL, handle, grooves, collar).moved(axis="y", degrees=90).standing()


def _hammer() -> TexturedMesh:
    x = np.array([0, 0.004, 0.10, 0.12, 0.235])
    path = np.stack([x, np.zeros(5), np.zeros(5)], axis=1)
    radii = [[0.010, 0.013], [0.013, 0.016], [0.011, 0.014], [0.008, 0.010], [0.008, 0.010]]
    handle = _sweep(path, radii, (0, 0, 1), TAN, (ORANGE, lambda u, t: t < 0.45))
    profile = [(0, 0), (0.014, 0), (0.016, 0.004), (0.016, 0.022)]
    profile += [(0.011, 0.028), (0.011, 0.062), (0.004, 0.100), (0, 0.100)]
    head = _lathe(profile, STEEL, (DARK, lambda u, r, z, s: (z > 0.024) & (z < 0.066)))
    return TexturedMesh.merged([handle, head.moved((0.222, 0.045, 0), axis="x", degrees=90)]).standing()


def _wooden_spoon() -> TexturedMesh:
    x = np.concatenate([np.linspace(0, 0.165, 6), np.linspace(0.170, 0.24, 16)])
    bowl = np.clip((x - 0.165) / 0.075, 0, 1)
    z = 0.006 - 0.012 * np.sin(np.pi * bowl)
    half = np.where(bowl > 0, 0.0045 + 0.0205 * np.sqrt(np.clip(np.sin(np.pi * bowl**0.8), 0, 1)), 0.0055)
    thick = np.where(bowl > 0, 0.0045, 0.0055)
    path = np.stack([x, np.zeros_like(x), z], axis=1)
    hollow: Mark = (BROWN, lambda u, t: _ellipse(t, u, (0.855, 0.5), (0.105, 0.17)) | (t < 0.06))
    return _sweep(path, np.stack([thick, half], axis=1), (0, 1, 0), TAN, hollow).standing()


def builtin_objects() -> dict[str, TexturedMesh]:
    """Return new, always identical meshes of all objects by name; metres, z up, standing or lying on z = 0."""
    return {
        "soup_can_red": _soup_can(RED),
        "soup_can_green": _soup_can(GREEN),
        "mug_blue": _mug(BLUE, IVORY, ORANGE),
        "mug_white": _mug(IVORY, TAN, RED),
        "cereal_box_yellow": _cereal_box(YELLOW, RED, GREEN),
        "cereal_box_blue": _cereal_box(BLUE, TEAL, ORANGE),
        "white_bowl": _bowl(),
        "white_plate": _plate(),
        "white_cup": _cup(),
        "yellow_bottle": _yellow_bottle(),
        "yellow_box": _yellow_box(),
        "banana": _banana(),
        "apple": _apple(),
        "tennis_ball": _tennis_ball(),
        "sponge": _sponge(),
        "screwdriver": _screwdriver(),
        "hammer": _hammer(),
        "wooden_spoon": _wooden_spoon(),
    }
