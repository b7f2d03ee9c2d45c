"""Augmentations of training views against channel ratios, occluded shares and SciPy's masks."""

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused
from rendered_objects import full_image
from scipy.ndimage import binary_dilation, distance_transform_cdt
from scipy.special import ndtr

from thor2_jax.files import json_digest
from thor2_jax.frames.frames import backproject
from training.augmentation import augmentations as module
from training.augmentation.augmentations import KINDS, Augmentations, Base, Occlusion, Segmentation, augment
from training.augmentation.sensing import Illumination, Registration
from training.objects.builtin_objects import builtin_objects
from training.rendering.camera import TRAINING_CAMERA, RayCaster, RenderedView, camera_pose
from training.views.mesh_views import cloud_of

from .conftest import augmented_view, flat_view, wall

OBJECTS = builtin_objects()
AUGMENTATIONS: dict[str, Any] = {name: kind() for name, (kind, _) in KINDS.items()} | {"base": Base(missing=1)}
NO_LIGHT = Illumination(gamma=(1, 1), gain=(1, 1), cast=0, shading=(0, 0), saturation=(1, 1), veil=(0, 0), noise=(0, 0))


def view_of(name: str = "mug_blue", azimuth: float = 0.6, polar: float = 1.1) -> RenderedView:
    mesh = OBJECTS[name]
    return RayCaster([mesh]).render(camera_pose(azimuth, polar, mesh.centre))


MUG = view_of()


def same(one: RenderedView, other: RenderedView) -> bool:
    parts = [(v.color.tobytes(), v.depth.tobytes(), v.intrinsics, v.corner, id(v.pose)) for v in (one, other)]
    return parts[0] == parts[1]


# All augmentations.


def test_the_record_is_json_and_no_augmentation_changes_nothing() -> None:
    off, on = Augmentations(), Augmentations(illumination=Illumination(), copies=3)
    assert on and not off and same(augment(MUG, off, np.random.default_rng(0)), MUG)
    record = on.record()
    assert record == json.loads(json.dumps(record)) and set(record) == {*AUGMENTATIONS, "copies"}
    assert record["sensor"] is None and record["copies"] == 3 and record["illumination"]["gain"] == [0.4, 1.7]
    # With other defaults, views and trainings that users have could not be resumed.
    assert json_digest(Augmentations.of_names(KINDS).record())[:16] == "8e559ff909f28997"
    for copies in (0, 1001):
        assert_refused(f"^copies is {copies}", Augmentations, copies=copies)


each_and_all = pytest.mark.parametrize("on", [*({name: on} for name, on in AUGMENTATIONS.items()), AUGMENTATIONS])


@each_and_all
def test_a_pure_function_of_its_arguments(on: dict[str, Any]) -> None:
    before = MUG.color.copy(), MUG.depth.copy()
    results, again = ([augmented_view(MUG, seed, **on) for seed in range(8)] for _ in range(2))
    assert all(same(one, other) for one, other in zip(results, again, strict=True))
    assert sum(not same(result, MUG) for result in results) >= 4
    assert sum(not same(results[0], other) for other in results[1:]) >= 4
    assert np.array_equal(MUG.color, before[0]) and np.array_equal(MUG.depth, before[1])
    for result in results:
        assert result.color.dtype == np.uint8 and result.depth.dtype == np.uint16
        assert result.color.shape == (*result.depth.shape, 3)
        assert not result.color[result.depth == 0].any()
        assert len(cloud_of(result)[0]) > 30
        full_image(result, TRAINING_CAMERA)  # it lies inside


@each_and_all
def test_empty_views_and_a_single_pixel(on: dict[str, Any]) -> None:
    nothing = flat_view(np.zeros((5, 7), np.uint16))
    pixel = np.zeros((5, 7), np.uint16)
    pixel[0, 6] = 1500
    for seed in range(40):
        assert same(augmented_view(nothing, seed, **on), nothing)
        for view in (flat_view(pixel), flat_view(pixel[:1, 6:])):
            augmented = augmented_view(view, seed, **on)
            assert (augmented.depth > 0).sum() <= 41  # dilated by 6 mm, four pixels


def test_all_objects_from_all_sides() -> None:
    """Includes thin objects, views along an axis, and objects that fill their crop of the image."""
    rng, augmentations = np.random.default_rng(0), Augmentations(**AUGMENTATIONS)
    for mesh in OBJECTS.values():
        caster = RayCaster([mesh])
        for polar in (0.0, np.pi / 2, 2.5):
            view = caster.render(camera_pose(0.0, polar, mesh.centre))
            shares = [(augment(view, augmentations, rng).depth > 0).sum() / (view.depth > 0).sum() for _ in range(5)]
            # A fifth is visible, half of it in the eroded mask, .6 of that above the base, .8 of that outside of
            # patches, and .7 of the edges have depth.
            assert 0.2 * 0.5 * 0.6 * 0.8 * 0.7 < min(shares) <= max(shares) < 1.7


def test_a_view_most_of_whose_pixels_fly_keeps_them() -> None:
    steep = flat_view(np.tile(1000 + 40 * np.arange(60, dtype=np.uint16), (60, 1)))
    assert same(augmented_view(steep, 0, segmentation=Segmentation(pixels=(0, 0))), steep)
    step = flat_view(np.tile(np.array([1000, 1000, 1000, 1000, 1030, 1060, 1060, 1060], np.uint16), (60, 1)))
    kept = augmented_view(step, 0, segmentation=Segmentation(pixels=(0, 0))).depth > 0
    assert not kept[:, 4:6].any() and kept[:, [0, 1, 2, 3, 6, 7]].all()


# Illumination.


def test_gain_and_cast() -> None:
    """Repeats the draws: the gain is the second of six numbers before the cast of each channel."""
    view, light = flat_view(wall(), (120, 100, 80)), dataclasses.replace(NO_LIGHT, gain=(0.4, 1.6), cast=0.1)
    for seed in range(100):
        rng = np.random.default_rng(seed)
        color = (0.4 + 1.2 * rng.random(6)[1]) * rng.uniform(0.9, 1.1, 3) * (120, 100, 80)
        augmented = augmented_view(view, seed, illumination=light).color
        np.testing.assert_allclose(augmented, np.broadcast_to(color, augmented.shape), atol=0.51)


def test_the_order_of_illumination_steps() -> None:
    """All steps together equal the same steps one after the other."""
    light = dataclasses.replace(NO_LIGHT, gamma=(1.3,) * 2, gain=(0.8,) * 2, saturation=(1.4,) * 2, veil=(0.05,) * 2)
    augmented = augmented_view(MUG, 0, illumination=light)
    values = 0.8 * (MUG.color[MUG.depth > 0] / 255) ** 1.3
    luma = values @ [0.299, 0.587, 0.114]
    values = luma[:, None] + 1.4 * (values - luma[:, None])
    values = (0.05 + 0.95 * values).clip(0, 1)
    np.testing.assert_allclose(augmented.color[MUG.depth > 0], 255 * values, atol=0.51)
    assert np.array_equal(augmented.depth, MUG.depth)


def test_noise_of_colour() -> None:
    light = dataclasses.replace(NO_LIGHT, noise=(0.02, 0.02))
    color = augmented_view(flat_view(wall(size=200)), 1, illumination=light).color.astype(float)
    assert color.mean() == pytest.approx(100, abs=0.1)
    assert color.std() == pytest.approx(np.hypot(0.02 * 255, 1 / np.sqrt(12)), rel=0.02)


def test_shading_follows_normals() -> None:
    """Each side of a roof has one shade, up to a step, in the ratio that Lambert's law predicts for the light."""
    light = dataclasses.replace(NO_LIGHT, shading=(1, 1))
    rise = 0.8 * 1500 / 1099 * np.abs(np.arange(120) - 59.5)
    depth = np.rint(np.tile(1500 + rise + 300 * (np.arange(120) > 59), (100, 1))).astype(np.uint16)
    normals = np.array([[-0.8, 0, -1], [0.8, 0, -1]]) / np.hypot(0.8, 1)
    for seed in range(20):
        color = augmented_view(flat_view(depth), seed, illumination=light).color[:, :, 0].astype(float) / 100
        left, right = color[10:-10, 10:50].mean(), color[10:-10, 70:110].mean()
        assert color.mean() == pytest.approx(1, abs=0.01)
        assert color[10:-10, 10:58].std() < 0.02
        # Repeats the draws before the direction of light: six numbers and three of the colour cast.
        rng = np.random.default_rng(seed)
        rng.uniform(size=9)
        direction = rng.standard_normal(3)
        direction[2] = -abs(direction[2])
        lit = (normals @ (direction / np.linalg.norm(direction))).clip(0)
        assert left - right == pytest.approx(lit[0] - lit[1], abs=0.08)


# Occlusion.


@pytest.mark.parametrize("straight", [0.0, 1.0])
def test_occluded_share(straight: float) -> None:
    occlusion = Occlusion(share=(0.1, 0.6), none=0.0, straight=straight)
    for name in ("cereal_box_blue", "mug_blue", "wooden_spoon"):
        view = view_of(name)
        shares = []
        for seed in range(60):
            augmented = augmented_view(view, seed, occlusion=occlusion)
            visible = augmented.depth > 0
            assert np.array_equal(augmented.depth[visible], view.depth[visible])
            assert np.array_equal(augmented.color[visible], view.color[visible])
            shares.append(1 - visible.sum() / (view.depth > 0).sum())
        assert 0.099 < min(shares) < 0.2 and 0.5 < max(shares) <= 0.6
        assert np.mean(shares) == pytest.approx(0.35, abs=0.06)


def test_edges_are_straight_or_outlines(monkeypatch: pytest.MonkeyPatch) -> None:
    """A half-plane separates occluded from visible pixels by a line, and a silhouette keeps its shape."""
    disc = np.hypot(*(np.indices((161, 161)) - 80)) < 78
    view = flat_view(np.where(disc, 1500, 0).astype(np.uint16))
    places = np.argwhere(disc) - 80.0
    for seed in range(20):
        augmented = augmented_view(view, seed, occlusion=Occlusion(share=(0.3, 0.4), none=0, straight=1))
        hidden = augmented.depth[disc] == 0
        direction = places[hidden].mean(axis=0)
        along = places @ direction / np.linalg.norm(direction)
        assert along[hidden].min() > along[~hidden].max() - 3
    monkeypatch.setattr("training.augmentation.augmentations._silhouettes", lambda: [disc[::3, ::3]])
    occluded = augmented_view(view, 0, occlusion=Occlusion((0.33, 0.35), none=0, straight=0, nearer=(1.2, 1.2)))
    spread = np.linalg.eigvalsh(np.cov(places[occluded.depth[disc] == 0].T)) ** 0.5
    assert spread == pytest.approx([1.2 * 26 * 2 / 1.365 / 2] * 2, rel=0.05)  # a disc of 26 pixels of 2 mm, nearer


def test_silhouettes_are_those_of_the_built_in_objects() -> None:
    bank = module._silhouettes()
    assert len(bank) == 4 * len(OBJECTS) and bank is module._silhouettes()
    for silhouette in bank:
        assert silhouette.any() and not silhouette[[0, -1]].any() and not silhouette[:, [0, -1]].any()
    # Those of a ball are discs of its size, in pixels of 2 mm.
    first, radius = 4 * list(OBJECTS).index("tennis_ball"), np.ptp(OBJECTS["tennis_ball"].vertices[:, 0]) / 2 / 0.002
    assert [ball.sum() for ball in bank[first : first + 4]] == pytest.approx([np.pi * radius**2] * 4, rel=0.05)


# Segmentation.


@pytest.mark.parametrize("steps", [1, 2, 8])
@pytest.mark.parametrize("name", ["mug_blue", "cereal_box_blue", "hammer"])
def test_erosion(name: str, steps: int) -> None:
    view = view_of(name)
    visible = view.depth > 0
    pixels = -steps * 1.5 / 1.099  # pixels of a view are 1.36 times as wide as those of a frame
    augmented = augmented_view(view, 0, segmentation=Segmentation(pixels=(pixels, pixels)))
    expected = distance_transform_cdt(np.pad(visible, 1), "taxicab")[1:-1, 1:-1] > steps
    remaining = augmented.depth > 0
    if expected.sum() >= visible.sum() / 2:
        # Pixels behind a step within the object are removed as well.
        assert not (remaining & ~expected).any() and remaining.sum() > 0.97 * expected.sum()
    else:
        assert 0.45 * visible.sum() < remaining.sum()
    assert np.array_equal(augmented.depth[remaining], view.depth[remaining])


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_dilation(steps: int) -> None:
    """A dilated mask on a touching background is filled with one colour, also beyond the border of the view."""
    view = dataclasses.replace(flat_view(wall(size=40)), corner=(steps - 1, 300))  # near the border of the image
    pixels = steps * 1.5 / 1.099
    augmented = augmented_view(view, 3, segmentation=Segmentation(pixels=(pixels, pixels), tilt=(0, 0), touching=1))
    expected = binary_dilation(np.pad(wall(size=40) > 0, steps), iterations=steps)[1:]
    assert np.array_equal(augmented.depth > 0, expected) and set(np.unique(augmented.depth)) == {0, 1500}
    assert augmented.corner == (0, 300 - steps)
    added = augmented.color[expected & ~np.pad(wall(size=40) > 0, steps)[1:]]
    assert len(np.unique(added, axis=0)) == 1 and (added != 100).all()
    # Points of the object do not move.
    at = [backproject(v.depth / 1000, v.intrinsics) for v in (view, augmented)]
    np.testing.assert_allclose(at[1][steps - 1 : -steps, steps:-steps], at[0], atol=1e-12)
    # Background within 2 cm remains; what is farther away is removed, as recognition does.
    for gap, remaining in ((0.018, expected.sum()), (0.022, 40 * 40)):
        settings = Segmentation(pixels=(pixels, pixels), tilt=(0, 0), touching=0, gap=(gap, gap))
        assert (augmented_view(view, 3, segmentation=settings).depth > 0).sum() == remaining


def test_the_background_is_a_plane_behind_the_object() -> None:
    view = view_of("soup_can_red", polar=1.0)
    for seed in range(20):
        augmented = augmented_view(view, seed, segmentation=Segmentation(pixels=(5, 5), touching=1))
        k, (top, left) = augmented.intrinsics, (a - b for a, b in zip(view.corner, augmented.corner, strict=True))
        old = np.zeros(augmented.depth.shape, bool)
        old[top : top + view.depth.shape[0], left : left + view.depth.shape[1]] = view.depth > 0
        points = backproject(augmented.depth / 1000, k)
        added = points[~old & (augmented.depth > 0)]
        if len(added) < 10:
            continue
        middle = added.mean(axis=0)
        normal = np.linalg.svd(added - middle)[2][2]
        normal *= -np.sign(normal[2])
        assert np.abs((added - middle) @ normal).max() < 0.001
        assert ((points[old & (augmented.depth > 0)] - middle) @ normal).min() > -0.004


# Registration of colour and depth.


def test_colors_are_shifted_and_the_background_shows_at_the_outline() -> None:
    view = flat_view(wall(margin=4), f=1500.0)  # pixels are 1 mm wide, as in a real frame
    view.color[4:-4, 34:-4] = (200, 50, 25)
    shifts, colors = set(), []
    for seed in range(60):
        result = augmented_view(view, seed, registration=Registration(shifted=1, shift=4, blur=(0, 0), chroma=(0, 0)))
        assert np.array_equal(result.depth, view.depth)
        shifts.add(np.flatnonzero((result.color[34, 14:54] == (200, 50, 25)).all(axis=1))[0] - 20)
        colors.append(np.unique(result.color[view.depth > 0], axis=0))
        assert 2 <= len(colors[-1]) <= 3
    assert shifts == set(range(-4, 5)) and len(np.unique(np.concatenate(colors), axis=0)) > 50


def test_blur_keeps_a_uniform_color() -> None:
    view = flat_view(wall(margin=9), (160, 80, 100), f=1500.0)
    result = augmented_view(view, 0, registration=Registration(shifted=0, blur=(3, 3)))
    np.testing.assert_allclose(result.color, view.color, atol=1)
    view.color[39, 39] = 255
    result = augmented_view(view, 0, registration=Registration(shifted=0, blur=(3, 3)))
    assert 80 < result.color[39, 39, 1] < 90


def test_colour_differences_are_blurred_and_luma_stays() -> None:
    view = flat_view(wall(), f=750.0)  # pixels are 2 mm wide, twice as wide as in a real frame
    view.color[:, :30], view.color[:, 30:] = (160, 80, 100), (80, 130, 60)
    result = augmented_view(view, 0, registration=Registration(shifted=0, blur=(0, 0), chroma=(8, 8)))
    luma = np.array([0.299, 0.587, 0.114])
    np.testing.assert_allclose(result.color @ luma, view.color @ luma, atol=1)
    left, right, *blurred = (color - color @ luma for color in (*view.color[0, [0, -1]], *result.color[30, 24:36]))
    share = ndtr((np.arange(24, 36)[:, None] - 29.5) / 4)
    np.testing.assert_allclose(blurred, (1 - share) * left + share * right, atol=1.5)
    np.testing.assert_allclose(result.color[:, [0, -1]], view.color[:, [0, -1]], atol=1)


# Base.


def test_the_lowest_1_cm_is_removed() -> None:
    result = augmented_view(MUG, 0, base=Base(missing=1, height=(0.01, 0.01), upright=1))
    points = backproject(MUG.depth / 1000, MUG.intrinsics) @ MUG.pose[:3, :3].T + MUG.pose[:3, 3]
    z = points[..., 2] - points[..., 2][MUG.depth > 0].min()
    # The depth is rounded to 1 mm.
    assert not result.depth[(z < 0.008) & (MUG.depth > 0)].any()
    kept = (z > 0.012) & (MUG.depth > 0)
    assert np.array_equal(result.depth[kept], MUG.depth[kept])
