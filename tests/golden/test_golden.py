"""Every stage against stage-by-stage outputs computed outside this project, on views of real scans."""

import functools
from pathlib import Path

import numpy as np
import pytest
import trimesh

import colornet
import thor2_jax as thor2

FILES = [
    f"{name}_{i}"
    for name in ("004_sugar_box", "006_mustard_bottle", "025_mug", "048_hammer", "055_baseball", "061_foam_brick")
    for i in range(4)
]
TOLERANCE = 1e-6
"""Largest difference of an image, a diagram or a colour matrix, and relative one of an embedding (float32 sums)."""

NEAR = 1e-7
"""A point so near to a slice or strip border, in scaled units, may be counted on either side of it."""

BACKENDS = ("gudhi", "closed_form")


def load(shared: Path, name: str) -> dict[str, np.ndarray]:
    with np.load(shared / "golden" / f"{name}.npz") as file:
        return dict(file)


@functools.cache
def described(shared: Path, config: thor2.DescriptorConfig) -> tuple[thor2.Descriptors, thor2.Strips, thor2.Diagrams]:
    """All views in one batch, in the released alignment, which is in scaled units as describe_aligned takes it."""
    golden = [load(shared, name) for name in FILES]
    aligned = thor2.PointClouds.pack([(view["aligned"], view["colors"]) for view in golden])
    network = colornet.load_default()
    return (
        thor2.describe_aligned(aligned, network, config),
        thor2.strips(aligned, network, config),
        thor2.diagrams(aligned, config),
    )


def normalized(golden: dict[str, np.ndarray]) -> tuple[thor2.PointClouds, np.ndarray]:
    config = thor2.DescriptorConfig()
    clouds = thor2.PointClouds.pack([(golden["points"] / np.float32(config.sigma_s), golden["colors"])])
    normal = thor2.view_normalize(clouds, config)
    return normal, np.asarray(normal.points[0, : len(golden["points"])], np.float64)


def test_no_point_lies_on_a_border(shared: Path) -> None:
    """So that every strip below can be compared, with no allowance for points that fall on the other side."""
    for name in FILES:
        points = load(shared, name)["aligned"].astype(np.float64)
        for axis, width in ((0, 0.025), (2, 0.1)):
            border = np.round(points[:, axis] / width) * width
            near = (np.abs(points[:, axis] - border) < NEAR) & (border > 0)
            assert not near.any(), name


@pytest.mark.parametrize("homology", BACKENDS)
@pytest.mark.parametrize("name", FILES)
def test_paper_convention(shared: Path, name: str, homology: str) -> None:
    golden, row = load(shared, name), FILES.index(name)
    found, strips, _ = described(shared, thor2.DescriptorConfig(homology=homology))
    np.testing.assert_allclose(found.images[row], golden["paper_images"], atol=TOLERANCE)
    embeddings = golden["paper_embedding"].transpose(0, 2, 1)
    np.testing.assert_allclose(found.embeddings[row], embeddings, rtol=TOLERANCE, atol=TOLERANCE)
    np.testing.assert_allclose(strips.color[row], golden["paper_color"], atol=TOLERANCE)
    assert int(found.overflow[row]) == 0


@pytest.mark.parametrize("homology", BACKENDS)
@pytest.mark.parametrize("name", FILES)
def test_released_convention(shared: Path, name: str, homology: str) -> None:
    golden, row = load(shared, name), FILES.index(name)
    found, strips, diagrams = described(shared, thor2.DescriptorConfig.released(homology=homology))
    np.testing.assert_allclose(found.images[row], golden["released_images"], atol=TOLERANCE)
    np.testing.assert_allclose(strips.color[row], golden["released_color"], atol=TOLERANCE)
    births, deaths, mask = (np.asarray(a[row]) for a in (diagrams.births, diagrams.deaths, diagrams.mask))
    pairs = np.stack([np.nonzero(mask)[0], births[mask], deaths[mask]], axis=1)
    np.testing.assert_allclose(pairs, golden["released_diagrams"], atol=TOLERANCE)
    assert int(found.overflow[row]) == 0


def test_boxes_are_no_larger_than_the_released_ones(shared: Path) -> None:
    ratios = []
    for name in FILES:
        golden = load(shared, name)
        ratios.append(np.prod(normalized(golden)[1].max(axis=0)) / np.prod(golden["box_extent"]))
    assert max(ratios) <= 1.05
    assert sum(ratio <= 1.0 for ratio in ratios) >= 20


def test_boxes_are_about_as_small_as_those_of_an_exhaustive_search(shared: Path) -> None:
    """The search of trimesh tries every face of the convex hull as a side of the box."""
    ratios = []
    for name in FILES:
        golden = load(shared, name)
        smallest = np.prod(trimesh.bounds.oriented_bounds(golden["points"].astype(np.float64))[1])
        ratios.append(np.prod(normalized(golden)[1].max(axis=0)) / smallest)
    assert np.median(ratios) <= 1.01
    assert max(ratios) <= 1.05


@pytest.mark.parametrize("name", FILES)
def test_normalization_is_a_rigid_motion_with_the_long_axis_first(shared: Path, name: str) -> None:
    golden = load(shared, name)
    normal, after = normalized(golden)
    before, n = golden["points"].astype(np.float64), len(golden["points"])
    motion, *_ = np.linalg.lstsq(before - before.mean(0), after - after.mean(0), rcond=None)
    np.testing.assert_allclose(motion @ motion.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(motion) == pytest.approx(1, abs=1e-4)  # a rotation, not a reflection
    np.testing.assert_allclose((before - before.mean(0)) @ motion, after - after.mean(0), atol=1e-5)
    extents = after.max(axis=0)
    assert (after.min(axis=0) == 0).all()
    assert extents[0] >= extents[1] >= extents[2]
    assert float(normal.camera[0, 2]) < extents[2] / 2
    assert int(normal.mask.sum()) == n
