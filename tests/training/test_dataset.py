"""Training samples against the same views described one at a time."""

import jax
import numpy as np
import pytest

import colornet
import thor2_jax as thor2
from training import dataset as module
from training.dataset import MIRRORS, Cloud, build_dataset

NETWORK = colornet.load_default()
CONFIG = thor2.DescriptorConfig(homology="closed_form")


def views(seed: int, sizes: tuple[int, ...]) -> list[Cloud]:
    rng = np.random.default_rng(seed)
    return [
        (
            (rng.random((n, 3)) * [0.2, 0.1, 0.05] + [0, 0, 0.5]).astype(np.float32),
            rng.integers(0, 256, (n, 3), np.uint8),
        )
        for n in sizes
    ]


def test_every_view_is_used_mirrored_in_four_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CHUNK", 2)
    given = {"mug": views(0, (300, 299, 1)), "box": views(1, (40,))}
    told: list[int] = []
    found = build_dataset(given, NETWORK, CONFIG, progress=told.append)
    assert found.classes == ("mug", "box") and len(found) == 16
    assert told == [2, 1, 1]
    assert sorted(zip(found.labels.tolist(), found.view.tolist(), strict=True)) == sorted(
        [(0, v) for v in range(3)] * 4 + [(1, 0)] * 4
    )
    assert all(isinstance(a, np.ndarray) for a in jax.tree.leaves(found.strips))

    for label, clouds in enumerate(given.values()):
        for number, cloud in enumerate(clouds):
            rows = np.flatnonzero((found.labels == label) & (found.view == number))
            normal = thor2.view_normalize(thor2.PointClouds.pack([cloud]), CONFIG)
            for row, axes in zip(rows, MIRRORS, strict=True):
                expected = thor2.strips(thor2.turn(thor2.mirror(normal, axes), CONFIG), NETWORK, CONFIG)
                sample = jax.tree.map(lambda a, row=row: a[row], found.strips)
                np.testing.assert_allclose(sample.low, expected.low[0], atol=2e-6)
                np.testing.assert_allclose(sample.high, expected.high[0], atol=2e-6)
                np.testing.assert_allclose(sample.color.sum(), len(cloud[0]) - int(sample.overflow), rtol=1e-5)
                np.testing.assert_allclose(sample.color, expected.color[0], atol=1e-5)


def test_bad_views_are_refused() -> None:
    with pytest.raises(thor2.InputError, match="views is empty"):
        build_dataset({}, NETWORK, CONFIG)
    with pytest.raises(thor2.InputError, match="class 'mug' has no views"):
        build_dataset({"mug": []}, NETWORK, CONFIG)
    with pytest.raises(thor2.InputError, match="9000 points"):
        build_dataset({"mug": [(np.zeros((9000, 3), np.float32), np.zeros((9000, 3), np.uint8))]}, NETWORK, CONFIG)
