"""Training samples against descriptors of the same views, computed one by one."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
from helpers import random_clouds as views

import colornet
import thor2_jax as thor2
from thor2_jax.descriptor.color_membership import region_sets
from thor2_jax.types import Cloud
from training.fitting import samples as module
from training.fitting.samples import PAPER_MIRRORS, Samples, build_samples, expand
from training.views.normalized_views import MemoryViews, NormalizedViews

NETWORK = colornet.load_default()
CONFIG = thor2.DescriptorConfig(homology="closed_form")


expand_batch = jax.jit(lambda batch, config: expand(batch, region_sets(NETWORK).weights, config), static_argnums=1)


def expanded(samples: Samples, rows: Any, config: thor2.DescriptorConfig = CONFIG) -> thor2.Strips:
    return expand_batch(samples.take(np.asarray(rows)), config)


@pytest.mark.parametrize(
    "config",
    [
        CONFIG,
        pytest.param(thor2.DescriptorConfig.released(homology="closed_form"), marks=pytest.mark.slow),
        pytest.param(
            thor2.DescriptorConfig(n_slices=2, n_strips=6, relaxation=thor2.Relaxation()), marks=pytest.mark.slow
        ),
    ],
    ids=["paper", "released", "relaxed"],
)
def test_every_view_is_used_mirrored_in_four_ways(
    config: thor2.DescriptorConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "VIEWS_PER_BATCH", 2)
    source = MemoryViews({"mug": views(0, (300, 299, 1)), "box": views(1, (40,))}, config)
    progress: list[tuple[int, ...]] = []
    samples = build_samples(source, NETWORK, config, lambda *done: progress.append(done), PAPER_MIRRORS)
    assert samples.classes == ("mug", "box") and len(samples) == 16
    assert progress == [(2, 4), (3, 4), (4, 4)]
    assert sorted(zip(samples.label.tolist(), samples.view.tolist(), strict=True)) == sorted(
        [(0, v) for v in range(3)] * 4 + [(1, 0)] * 4
    )
    descriptors = thor2.describe_strips(expanded(samples, np.arange(16), config), NETWORK, config)
    for label in range(2):
        for number, cloud in enumerate(source.read(label).clouds()):
            rows = np.flatnonzero((samples.label == label) & (samples.view == number))
            normal = thor2.PointClouds.pack([cloud])
            for row, axes in zip(rows, PAPER_MIRRORS, strict=True):
                aligned = thor2.turn(thor2.mirror(normal, axes), config)
                expected = thor2.describe_aligned(aligned, NETWORK, config)
                # Relaxed strips are sums of many small numbers, whose order depends on the batch.
                tolerance = 1e-6 if config.relaxation is None else 1e-4
                np.testing.assert_allclose(descriptors.images[row], expected.images[0], atol=tolerance)
                np.testing.assert_allclose(descriptors.embeddings[row], expected.embeddings[0], rtol=1e-5, atol=1e-3)


def test_counts_are_integers_that_sum_to_the_points() -> None:
    sizes = (300, 40, 1)
    samples = build_samples(MemoryViews({"a": views(0, sizes), "b": views(1, (5,))}, CONFIG), NETWORK, CONFIG)
    assert samples.color_count.dtype == np.float32 and (samples.color_count % 1 == 0).all()
    points = np.add.reduceat(samples.color_count, samples.color_start[:-1])
    assert points.tolist() == [*sizes * 2, *[5] * 2]


def test_any_rows_in_any_order_and_none() -> None:
    samples = build_samples(MemoryViews({"a": views(0, (300, 20)), "b": views(1, (5,))}, CONFIG), NETWORK, CONFIG)
    everything = expanded(samples, np.arange(6))
    for rows in ([5, 0, 5, 2], []):
        batch = samples.take(np.array(rows, int))
        assert [a.shape[1:] for a in batch] == [a.shape[1:] for a in samples.take(np.array([0]))]
        np.testing.assert_array_equal(batch.label, samples.label[rows])
        some = jax.tree.leaves(expanded(samples, np.array(rows, int)))
        for one, every in zip(some, jax.tree.leaves(everything), strict=True):
            np.testing.assert_array_equal(one, np.asarray(every)[rows])


def test_a_sample_is_small() -> None:
    """A sample takes less than a fifteenth of its TOPS2 descriptor."""
    samples = build_samples(MemoryViews({"a": views(0, (300,)), "b": views(1, (300,))}, CONFIG), NETWORK, CONFIG)
    fields = [getattr(samples, f.name) for f in dataclasses.fields(samples) if f.name != "classes"]
    assert sum(a.nbytes for a in fields) / len(samples) < 4 * 11942 / 15


@dataclasses.dataclass
class Shard:
    label: int
    views: int


class Shards:
    """A source with two shards of one class, the first with two copies of one view, and one shard of another class."""

    classes = ("mug", "box")
    digest = "d"
    record: dict[str, Any] = {}

    def __init__(self, whole: MemoryViews) -> None:
        mug, box = whole.read(0), whole.read(1)
        cut = int(mug.counts[:2].sum())
        numbers = {"view": np.array([7, 7], np.int32), "copy": np.array([0, 1], np.int32)}
        first = dataclasses.replace(mug, xyz=mug.xyz[:cut], rgb=mug.rgb[:cut], counts=mug.counts[:2], **numbers)
        numbers = {"view": np.array([9], np.int32), "copy": np.array([0], np.int32)}
        second = dataclasses.replace(mug, xyz=mug.xyz[cut:], rgb=mug.rgb[cut:], counts=mug.counts[2:], **numbers)
        self._chunks = [first, second, box]
        self.shards = [Shard(views.label, len(views)) for views in self._chunks]

    def read(self, index: int) -> NormalizedViews:
        return self._chunks[index]


def test_shards_of_a_class_and_copies_of_a_view() -> None:
    whole = MemoryViews({"mug": views(0, (30, 31, 32)), "box": views(1, (33,))}, CONFIG)
    samples = build_samples(Shards(whole), NETWORK, CONFIG)
    assert sorted(zip(samples.label.tolist(), samples.view.tolist(), strict=True)) == sorted(
        [(0, 7)] * 4 + [(0, 9)] * 2 + [(1, 0)] * 2
    )
    expected = build_samples(whole, NETWORK, CONFIG)
    np.testing.assert_array_equal(np.sort(samples.color_count), np.sort(expected.color_count))
    np.testing.assert_allclose(np.sort(samples.length), np.sort(expected.length), atol=1e-6)


def test_the_digest_is_that_of_the_views() -> None:
    def digest(**clouds: list[Cloud]) -> str:
        return MemoryViews(clouds, CONFIG).digest

    one, two = views(0, (3, 4)), views(1, (5,))
    other = [(one[0][0], one[0][1] ^ 1), one[1]]
    digests = [digest(a=one, b=two), digest(b=one, a=two), digest(a=two, b=one), digest(a=other, b=two)]
    assert len(set(digests)) == 4
    assert digest(a=views(0, (3, 4)), b=two) == digests[0]


def test_bad_views_are_refused() -> None:
    def build(clouds: dict[str, list[Cloud]]) -> Samples:
        return build_samples(MemoryViews(clouds, CONFIG), NETWORK, CONFIG)

    with pytest.raises(thor2.InputError, match="views of 0 classes"):
        build({})
    with pytest.raises(thor2.InputError, match="views of 1 classes"):
        build({"mug": views(0, (5,))})
    with pytest.raises(thor2.InputError, match="class 'mug' has no views"):
        build({"box": views(0, (5,)), "mug": []})
    with pytest.raises(thor2.InputError, match="9000 points"):
        build({"a": [(np.zeros((9000, 3), np.float32), np.zeros((9000, 3), np.uint8))], "b": views(0, (5,))})
