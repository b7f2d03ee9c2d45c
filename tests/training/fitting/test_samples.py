"""Training samples against descriptors of the same views, computed one by one, and folds by view."""

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused
from slow_tier import slow
from small_clouds import CLOSED, NETWORK
from small_clouds import random_clouds as views

import thor2_jax as thor2
from training.fitting.samples import OF_EMBEDDING, Form, describe_batch, sample_views
from training.protocol import PAPER
from training.views.normalized_views import MemoryViews, SourceShard, fold_of_views

RELAXED = thor2.DescriptorConfig(n_slices=2, n_strips=6, relaxation=thor2.Relaxation())


@pytest.mark.parametrize("config", [CLOSED, *slow(thor2.DescriptorConfig.released(homology="closed_form"), RELAXED)])
def test_every_view_is_mirrored_in_four_ways(config: thor2.DescriptorConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("training.views.normalized_views.CLOUDS_PER_BATCH", 2)
    source = MemoryViews({"mug": views(0, (300, 299, 1)), "box": views(1, (40,))}, config)
    progress: list[tuple[int, ...]] = []
    samples, kept = sample_views(source, NETWORK, config, Form(PAPER.mirrors), progress=lambda *n: progress.append(n))
    assert kept == []
    assert progress == [(3, 4), (4, 4)]
    keys = list(zip(samples.label.tolist(), samples.view.tolist(), strict=True))
    assert sorted(keys) == sorted([(0, v) for v in range(3)] * 4 + [(1, 0)] * 4)
    if config is CLOSED:
        points = samples.take(np.arange(16), NETWORK, config).color.sum(axis=(1, 2, 3))
        assert points.tolist() == [{(0, 0): 300, (0, 1): 299, (0, 2): 1, (1, 0): 40}[key] for key in keys]
    batch = samples.take(np.arange(16), NETWORK, config)
    lowest = samples.take(np.arange(16), NETWORK, dataclasses.replace(config, n_slices=1))  # as THOR takes them
    np.testing.assert_array_equal(lowest.length, batch.length[:, :1])
    np.testing.assert_array_equal(lowest.color, batch.color[:, :1])
    descriptors = describe_batch(batch, NETWORK, config)
    for label in range(2):
        for number, cloud in enumerate(source.read(label).clouds()):
            rows = np.flatnonzero((samples.label == label) & (samples.view == number))
            normal = thor2.PointClouds.pack([cloud])
            for row, axes in zip(rows, PAPER.mirrors, strict=True):
                aligned = thor2.turn(thor2.mirror(normal, axes), config)
                expected = thor2.describe_aligned(aligned, NETWORK, config)
                # Relaxed strips are sums of many small numbers, whose order depends on the batch.
                tolerance = 1e-6 if config.relaxation is None else 1e-4
                np.testing.assert_allclose(descriptors.images[row], expected.images[0], atol=tolerance)
                np.testing.assert_allclose(descriptors.embeddings[row], expected.embeddings[0], rtol=1e-5, atol=1e-3)


def test_shards_of_a_class_and_copies_of_a_view() -> None:
    """Two shards of a mug, the first with two copies of view 7, and one of a box; a sample is small."""
    mugs, boxes = views(0, (300, 310, 320)), views(1, (330,))
    whole = MemoryViews({"mug": mugs, "box": boxes}, CLOSED)
    first, second = (MemoryViews({"mug": some}, CLOSED).read(0) for some in (mugs[:2], mugs[2:]))
    first = dataclasses.replace(first, view=np.array([7, 7], np.int32), copy=np.array([0, 1], np.int32))
    second = dataclasses.replace(second, view=np.array([9], np.int32))
    chunks = [first, second, dataclasses.replace(whole.read(1), view=second.view)]
    shards = [SourceShard(each.label, len(each)) for each in chunks]
    source: Any = SimpleNamespace(classes=whole.classes, shards=shards, read=chunks.__getitem__)
    samples, _ = sample_views(source, NETWORK, CLOSED)
    keys = zip(samples.label.tolist(), samples.view.tolist(), strict=True)
    assert sorted(keys) == sorted([(0, 7)] * 4 + [(0, 9)] * 2 + [(1, 9)] * 2)
    expected, _ = sample_views(whole, NETWORK, CLOSED)
    np.testing.assert_allclose(np.sort(samples.strips.data), np.sort(expected.strips.data), atol=1e-6)
    # A fifteenth of the TOPS2 descriptor.
    assert sum(array.nbytes for array in samples.arrays().values()) / len(samples) < 4 * 11942 / 15

    # Orientations differ between equal shards and between seeds: two shards of two clouds, two copies, two seeds.
    equal: Any = SimpleNamespace(shards=[shards[0]] * 2, read=lambda _: first)
    turned = [sample_views(equal, NETWORK, CLOSED, OF_EMBEDDING, seed)[0].strips.toarray() for seed in (0, 1)]
    assert len(np.unique(np.concatenate(turned), axis=0)) == 2 * 2 * 2 * 2

    held_out = {0: np.array([9]), 1: np.array([7])}  # the box has a view 9 and no view 7
    fitted, kept = sample_views(source, NETWORK, CLOSED, held_out=held_out)
    rest = samples.select(np.flatnonzero((samples.label == 1) | (samples.view == 7)))
    np.testing.assert_equal(fitted.arrays(), rest.arrays())
    ((label, (xyz, rgb)),) = kept
    assert label == 0 and np.array_equal(rgb, second.rgb)
    np.testing.assert_allclose(xyz * CLOSED.sigma_s, second.xyz - second.camera, atol=1e-6)


def test_the_digest_is_that_of_names_and_clouds() -> None:
    (one, two), other = views(0, (3, 4)), views(1, (5,))
    recolored = [(one[0], one[1] ^ 1), two]
    cases: list[dict[str, Any]] = [{"a": [one, two], "b": other}, {"b": [one, two], "a": other}]
    cases += [{"a": other, "b": [one, two]}, {"a": recolored, "b": other}]
    assert len({MemoryViews(clouds, CLOSED).digest for clouds in (*cases, cases[0])}) == 4


def fold_of(label: Sequence[int], view: Sequence[int], folds: int, seed: int) -> np.ndarray:
    return fold_of_views(np.array(label), np.array(view), ("a", "b"), folds, seed)


def test_samples_of_a_view_stay_together_and_folds_are_even() -> None:
    label = np.repeat([0, 1, 0], [52, 60, 52])
    view = np.concatenate([np.repeat(np.arange(n, m, s), 4) for n, m, s in ((0, 13, 1), (100, 130, 2), (0, 13, 1))])
    fold_numbers = fold_of(label, view, 5, 0)
    for name in (0, 1):
        folds = {v: set(fold_numbers[(label == name) & (view == v)]) for v in view[label == name]}
        assert all(len(fold) == 1 for fold in folds.values())
        counts = np.bincount([fold.pop() for fold in folds.values()], minlength=5)
        assert len(counts) == 5 and counts.max() - counts.min() <= 1
    np.testing.assert_array_equal(fold_numbers, fold_of(label, view, 5, 0))
    assert (fold_numbers != fold_of(label, view, 5, 1)).any()
    assert not fold_of(label, view, 1, 0).any()
    assert_refused("folds is 14", fold_of, label, view, 14, 0)
