"""Every stage against stage-by-stage outputs computed outside this project, on views of real scans."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import colornet
import thor2_jax as thor2

FILES = [
    f"{name}_{i}"
    for name in ("004_sugar_box", "006_mustard_bottle", "025_mug", "048_hammer", "055_baseball", "061_foam_brick")
    for i in range(4)
]
TOLERANCE = 1e-5
BORDER = 1e-6
BACKENDS = ("gudhi", "closed_form")


def load(shared: Path, name: str) -> dict[str, np.ndarray]:
    with np.load(shared / "golden" / f"{name}.npz") as file:
        return dict(file)


def pack_scaled(points: np.ndarray, colors: np.ndarray) -> thor2.PointClouds:
    """Golden clouds are in scaled units already; describe_aligned takes those."""
    return thor2.PointClouds.pack([(points, colors)])


def touched_slices(golden: dict[str, np.ndarray]) -> tuple[set[int], int]:
    """Slices with a point within BORDER of a slice or strip border, and how many strips those points touch."""
    points = golden["aligned"].astype(np.float64)
    z, x = points[:, 2] / 0.1, points[:, 0] / 0.025
    near = (np.abs(z - np.round(z)) * 0.1 < BORDER) | (np.abs(x - np.round(x)) * 0.025 < BORDER)
    near &= (z > 0.5) | (np.abs(x - np.round(x)) * 0.025 < BORDER)
    near &= points[:, 2] > 0  # the octant's own faces are borders of nothing
    near &= points[:, 0] > 0
    strips = {(int(np.round(a)), int(np.round(b))) for a, b in zip(z[near], x[near], strict=True)}
    return {s for s, _ in strips} | {s - 1 for s, _ in strips}, len(strips)


@pytest.mark.parametrize("homology", BACKENDS)
@pytest.mark.parametrize("name", FILES)
def test_paper_images_and_embeddings(shared: Path, name: str, homology: str) -> None:
    golden = load(shared, name)
    aligned = pack_scaled(golden["aligned"], golden["colors"])
    found = thor2.describe_aligned(aligned, colornet.load_default(), thor2.DescriptorConfig(homology=homology))
    _, n_touched = touched_slices(golden)
    assert n_touched <= 2
    wrong_images = np.abs(np.asarray(found.images[0]) - golden["paper_images"]).max(axis=(1, 2)) > TOLERANCE
    expected = golden["paper_embedding"].transpose(0, 2, 1)
    wrong_strips = (
        np.abs(np.asarray(found.embeddings[0]) - expected) > TOLERANCE * np.maximum(1, np.abs(expected))
    ).any(axis=1)
    assert wrong_strips.sum() <= 2 * n_touched
    assert wrong_images.sum() <= 2 * n_touched
    assert int(found.overflow[0]) == 0


@pytest.mark.parametrize("homology", BACKENDS)
@pytest.mark.parametrize("name", FILES)
def test_released_preset(shared: Path, name: str, homology: str) -> None:
    golden = load(shared, name)
    config = thor2.DescriptorConfig.released(homology=homology)
    aligned = pack_scaled(golden["aligned"], golden["colors"])
    found = thor2.describe_aligned(aligned, colornet.load_default(), config)
    np.testing.assert_allclose(found.images[0], golden["released_images"], atol=TOLERANCE)
    color = thor2.strips(aligned, colornet.load_default(), config).color[0]
    np.testing.assert_allclose(color, golden["released_color"], atol=TOLERANCE)
    diagrams = thor2.diagrams(aligned, config)
    mask = np.asarray(diagrams.mask[0])
    rows = np.stack(
        [np.nonzero(mask)[0], np.asarray(diagrams.births[0])[mask], np.asarray(diagrams.deaths[0])[mask]], axis=1
    )
    np.testing.assert_allclose(rows, golden["released_diagrams"], atol=TOLERANCE)


@pytest.mark.parametrize("name", FILES)
def test_colour_matrices(shared: Path, name: str) -> None:
    golden = load(shared, name)
    aligned = pack_scaled(golden["aligned"], golden["colors"])
    color = thor2.strips(aligned, colornet.load_default(), thor2.DescriptorConfig()).color[0]
    _, n_touched = touched_slices(golden)
    wrong = (np.abs(np.asarray(color) - golden["paper_color"]) > TOLERANCE * np.maximum(1, golden["paper_color"])).any(
        -1
    )
    assert wrong.sum() <= 2 * n_touched


def normalized_volumes(shared: Path) -> np.ndarray:
    config, ratios = thor2.DescriptorConfig(), []
    for name in FILES:
        golden = load(shared, name)
        normal = thor2.view_normalize(
            thor2.PointClouds.pack([(golden["points"] / config.sigma_s, golden["colors"])]), config
        )
        extents = np.asarray(normal.points[0])[np.asarray(normal.mask[0])].max(axis=0)
        ratios.append(np.prod(extents.astype(np.float64)) / np.prod(golden["box_extent"].astype(np.float64)))
    return np.array(ratios)


def test_box_volume(shared: Path) -> None:
    ratios = normalized_volumes(shared)
    assert ratios.max() <= 1.05
    assert (ratios <= 1.0).sum() >= 20


@pytest.mark.parametrize("name", FILES)
def test_normalization_is_a_rigid_motion_with_the_long_axis_first(shared: Path, name: str) -> None:
    golden, config = load(shared, name), thor2.DescriptorConfig()
    clouds = thor2.PointClouds.pack([(golden["points"] / config.sigma_s, golden["colors"])])
    normal = thor2.view_normalize(clouds, config)
    n = len(golden["points"])
    before, after = golden["points"].astype(np.float64), np.asarray(normal.points[0, :n], np.float64)
    rng = np.random.default_rng(0)
    i, j = rng.integers(0, n, (2, 500))
    distances = np.linalg.norm(before[i] - before[j], axis=1)
    np.testing.assert_allclose(np.linalg.norm(after[i] - after[j], axis=1), distances, atol=1e-5)
    motion, *_ = np.linalg.lstsq(before - before.mean(0), after - after.mean(0), rcond=None)
    assert np.linalg.det(motion) == pytest.approx(1, abs=1e-4)  # a rotation, not a reflection
    extents = after.max(axis=0)
    assert (after.min(axis=0) == 0).all()
    assert extents[0] >= extents[1] >= extents[2]
    assert float(normal.camera[0, 2]) < extents[2] / 2
    assert jnp.asarray(normal.mask).sum() == n
