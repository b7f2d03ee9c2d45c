"""Labelled instances as views, against the normalization that recognition computes."""

import dataclasses

import jax
import numpy as np
import pytest
from refusals import assert_refused
from small_clouds import CLOSED

from thor2_jax.descriptor.view_normalization import view_normalize
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.gallery.enrollment import augmented_view
from training.objects.builtin_objects import builtin_objects
from training.objects.surfaces import surfaces_of
from training.views.labelled_views import FIRST_VIEW, LabelledInstances, WithLabelledViews
from training.views.normalized_views import MemoryViews, WithoutClasses


def instance(seed: int, n: int = 50) -> PreparedInstance:
    """Return a cloud in a box; the left end is occluded in every second one."""
    rng = np.random.default_rng(seed)
    points = (rng.random((n, 3)) * (0.2, 0.1, 0.05) + (0.1, -0.3, 0.6)).astype(np.float32)
    boundary = (points[:, 0] < 0.13) & bool(seed % 2)
    return PreparedInstance(1, points, rng.integers(0, 256, (n, 3), np.uint8), boundary, bool(seed % 2))


def rendered(bowls: int = 30) -> MemoryViews:
    clouds = [(view.points, view.colors) for view in map(instance, range(bowls + 3))]
    return MemoryViews({"bowl": clouds[:bowls], "mug": clouds[bowls:]}, CLOSED)


def test_labelled_instances_join_the_rendered_views() -> None:
    """The largest class has 30 clouds: 4 mugs get 30 // 4 - 1 copies, 40 pens none, and 2 boxes the most of 8."""
    instances = {"mug": 4, "pen": 40, "box": 2}
    views = {name: [instance(100 + k) for k in range(n)] for name, n in instances.items()}
    crops = {"mug": [(np.full((4, 4, 3), k, np.uint8), np.full((4, 4, 3), -k, np.int8)) for k in range(4)]}
    source = WithLabelledViews(LabelledInstances(views, ["too few points"], crops), CLOSED, rendered())
    assert source.classes == ("bowl", "mug", "pen", "box")
    shards = [(shard.label, shard.views) for shard in source.shards]
    assert shards == [(0, 30), (1, 3), (1, 4 * 7), (2, 40), (3, 2 * 9)]
    record, digest = source.record["frames"], LabelledInstances(views).digest
    assert (source.record["digest"], source.record["views"]) == (source.digest, 30 + 3 + 28 + 40 + 18)
    assert (record["digest"], record["instances"], record["skipped"]) == (digest, instances, ["too few points"])
    assert record["copies"] == {"mug": 6, "pen": 0, "box": 8}
    mugs = source.read(2)
    assert (mugs.label, len(mugs)) == (1, 28)
    assert mugs.view.tolist() == [FIRST_VIEW + k for k in range(4) for _ in range(7)]
    assert mugs.copy.tolist() == list(range(7)) * 4
    of_mugs, of_views = source.read_crops(2, 2), (mugs.view - FIRST_VIEW)[:, None, None, None]
    assert (of_mugs.color == of_views).all() and (of_mugs.normals == -of_views).all()
    np.testing.assert_array_equal(source.read(1).xyz, rendered().read(1).xyz)
    only = WithoutClasses(source, ["bowl", "pen"])
    assert only.classes == ("mug", "box") and only.record["views"] == 3 + 28 + 18
    assert only.record["digest"] == only.digest != WithoutClasses(source, ["bowl"]).digest
    assert [only.read(k).label for k in range(3)] == [0, 0, 1] and only.read(1).view.tolist() == mugs.view.tolist()


def test_surfaces_need_a_mesh_of_every_class() -> None:
    bowl_and_mug = rendered()
    both = bowl_and_mug.surfaces = surfaces_of(builtin_objects()[name] for name in ("white_bowl", "mug_blue"))
    for name, left_out, expected in (("mug", "", both), ("pen", "", None), ("pen", "pen", both)):
        labelled = LabelledInstances({name: [instance(100)]}, left_out=[left_out])
        source = WithLabelledViews(labelled, CLOSED, bowl_and_mug)
        jax.tree.map(np.testing.assert_array_equal, source.surfaces, expected)
    assert WithLabelledViews(labelled, CLOSED).surfaces is None
    mug = WithoutClasses(source, ["bowl", "pen"]).surfaces
    jax.tree.map(np.testing.assert_array_equal, mug, jax.tree.map(lambda a: a[1:], both))
    assert WithoutClasses(rendered(), ["bowl"]).surfaces is None


def test_instances_are_normalized_as_recognition_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clouds with an occlusion boundary may take another half turn than the same points without one."""
    monkeypatch.setattr("training.views.labelled_views.CLOUDS", 18)
    views = [instance(seed, 40 + seed) for seed in range(6)]
    source = WithLabelledViews(LabelledInstances({"mug": views}), CLOSED)
    assert source.classes == ("mug",) and [shard.views for shard in source.shards] == [18]
    flat = [each for view in views for each in (view, *(augmented_view(view, k) for k in (0, 1)))]
    normal = view_normalize(pack_instances(flat, len(flat)), CLOSED)
    expected = np.asarray(normal.points)[np.asarray(normal.mask)]
    read = source.read(0)
    assert read.counts.tolist() == [len(each.points) for each in flat]
    np.testing.assert_allclose(read.xyz, expected, atol=2**-15 + 1e-6)
    np.testing.assert_array_equal(read.rgb, np.concatenate([each.colors for each in flat]))
    bare = [dataclasses.replace(view, boundary=np.zeros_like(view.boundary)) for view in views]
    assert np.abs(WithLabelledViews(LabelledInstances({"mug": bare}), CLOSED).read(0).xyz - read.xyz).max() > 0.01


def test_the_digest_depends_on_everything_that_is_read() -> None:
    def digest(*seeds: int, name: str = "mug", bowls: int = 30, **changes: np.ndarray) -> str:
        views = [dataclasses.replace(instance(seed), **changes) for seed in seeds]
        return WithLabelledViews(LabelledInstances({name: views}), CLOSED, rendered(bowls) if bowls else None).digest

    colors, boundary = np.zeros((50, 3), np.uint8), np.ones(50, bool)
    digests = [digest(1, 2), digest(2, 1), digest(1), digest(1, 2, name="cup")]
    digests += [digest(1, 2, bowls=29), digest(1, 2, bowls=0)]
    digests += [digest(1, 2, colors=colors), digest(1, 2, boundary=boundary)]
    assert len(set(digests)) == len(digests) and digest(1, 2) == digests[0]


def test_an_instance_that_is_too_long_is_refused() -> None:
    long = dataclasses.replace(instance(0), points=instance(0).points * np.float32(20))
    source = WithLabelledViews(LabelledInstances({"mug": [long]}), CLOSED)
    assert_refused("frames: 'mug': .*depth scale", source.read, 0)
