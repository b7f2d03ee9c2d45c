"""TOPS and TOPS2 of clouds: by steps, in chunks, as a stream, on several devices; compilations; bad input."""

import dataclasses
import logging
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.sharding import Mesh
from processes import finish_programs, free_port, start_program
from refusals import assert_refused
from slow_tier import slow
from small_clouds import CLOSED, NETWORK, aligned_cloud, random_clouds
from small_runs import SMALL_CONFIG

import colornet
import thor2_jax as thor2
from thor2_jax.descriptor import describe
from thor2_jax.descriptor.describe import batch_mesh, shard_clouds
from thor2_jax.types import Cloud


def test_describe_equals_its_steps_and_its_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    clouds = thor2.PointClouds.pack(random_clouds(0, [900] * 3))
    whole = thor2.describe(clouds, NETWORK, CLOSED)

    def mass(points: jax.Array) -> tuple[jax.Array, jax.Array]:
        described = thor2.describe(dataclasses.replace(clouds, points=points), NETWORK, CLOSED)
        return described.images.sum(), described.tops2

    gradient = np.asarray(jax.grad(mass, has_aux=True)(clouds.points)[0])
    assert (np.abs(gradient).max(axis=(1, 2)) > 0.1).all()
    monkeypatch.setattr(describe, "MAX_CHUNK_CLOUDS", 2)
    monkeypatch.setattr(describe, "CHUNKS_PER_STEP", 1)
    in_chunks, tops2 = jax.grad(mass, has_aux=True)(clouds.points)
    np.testing.assert_allclose(tops2, whole.tops2, atol=1e-6)
    np.testing.assert_allclose(in_chunks, gradient, atol=1e-4)
    aligned = thor2.align(clouds, CLOSED)
    np.testing.assert_array_equal(thor2.describe_aligned(aligned, NETWORK, CLOSED).tops2, whole.tops2)
    strips = thor2.strips(aligned, NETWORK, CLOSED)
    np.testing.assert_array_equal(thor2.describe_strips(strips, NETWORK, CLOSED).tops2, whole.tops2)


def test_describe_with_jax_enable_x64() -> None:
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        clouds = thor2.PointClouds.pack(random_clouds(1, [60] * 4))
        tops2 = thor2.describe(clouds, NETWORK, CLOSED).tops2
    expected = thor2.describe(clouds, NETWORK, CLOSED).tops2
    np.testing.assert_allclose(tops2, expected, atol=1e-4, strict=True)


def test_arguments_of_other_types_are_named() -> None:
    packed = thor2.PointClouds.pack([aligned_cloud(0, 5)])
    one, batches = jax.tree.map(lambda a: a[0], packed), jax.tree.map(lambda a: a[None], packed)
    exchanged = "network is of type DescriptorConfig; expected a ColorNetwork"
    for function in (thor2.describe, thor2.describe_aligned, thor2.strips, describe.describe_sharded):
        assert_refused("clouds is ndarray", function, np.zeros((1, 5, 3)), NETWORK, CLOSED)
        assert_refused(r"points \[512, 3\]", function, one, NETWORK, CLOSED)
        assert_refused(r"points \[1, 1, 512, 3\]", function, batches, NETWORK, CLOSED)
        assert_refused(exchanged, function, packed, CLOSED, NETWORK)
        assert_refused("config is of type NoneType; expected a DescriptorConfig", function, packed, NETWORK, None)
    for without_network in (thor2.align, thor2.view_normalize, thor2.turn, thor2.diagrams):
        assert_refused("clouds is list", without_network, [], CLOSED)
        assert_refused("config is of type ColorNetwork", without_network, packed, NETWORK)
    assert_refused("clouds is list", thor2.mirror, [], "x")
    assert_refused("strips is of type PointClouds; expected a Strips", thor2.describe_strips, packed, NETWORK, CLOSED)
    assert_refused("parameters is of type dict; expected a Parameters", thor2.describe, packed, NETWORK, CLOSED, {})
    assert_refused(exchanged, thor2.Parameters.of, CLOSED, NETWORK)


def test_fields_that_do_not_fit_a_batch_are_named() -> None:
    packed = thor2.PointClouds.pack(random_clouds(1, [60, 50]))
    fields = {
        "colors": [np.zeros((2, 512, 3), np.uint8), packed.colors[:1]],
        "points": [packed.points.astype(int), np.zeros((2, 512, 4), np.float32), np.zeros((2, 512, 3), ">f4")],
        "mask": [packed.mask[:, :1]],
        "camera": [packed.camera[0]],
        "boundary": [None],
    }
    for name, values in fields.items():
        for value in values:
            changed = dataclasses.replace(packed, **{name: value})
            assert_refused(rf"clouds\.{name} is ", thor2.describe, changed, NETWORK, CLOSED)
    empty = jax.tree.map(lambda a: a[:0], packed)
    assert_refused(r"clouds\.points is float32 \[0, 512, 3\]", thor2.describe, empty, NETWORK, CLOSED)


def test_compiles_once_per_bucket(caplog: pytest.LogCaptureFixture) -> None:
    """Clouds of all sizes with the same bucket and batch size, and all parameters, share one compilation."""
    config = thor2.DescriptorConfig(homology="closed_form", alpha=0.7)  # used by no other test

    def compiled(*sizes: int, network: colornet.ColorNetwork = NETWORK, **given: thor2.Parameters) -> list[str]:
        caplog.clear()
        packed = thor2.PointClouds.pack([(np.random.default_rng(n).random((n, 3)), np.zeros((n, 3))) for n in sizes])
        with jax.log_compiles(), caplog.at_level(logging.WARNING):
            jax.block_until_ready(thor2.describe(packed, network, config, **given))
        lines = [record.getMessage() for record in caplog.records]
        names = [line.split()[4] for line in lines if line.startswith("Finished XLA compilation of")]
        return [name for name in names if "convert_element_type" not in name]  # compiled for each dtype and shape

    first = compiled(5, 512)
    assert first and len(first) == len(set(first)), first
    assert compiled(0, 1) == compiled(512, 400) == []
    assert compiled(512, 5, network=colornet.load(Path(colornet.__file__).with_name("data") / "network.npz")) == []
    larger = compiled(513, 2)
    assert larger and len(larger) == len(set(larger))
    assert compiled(1024, 900) == []
    others = jax.tree.map(lambda a: 1.1 * a, thor2.Parameters.of(NETWORK, config))
    assert compiled(5, 512, parameters=others) == []


def clouds_of(count: int, capacity: int) -> thor2.PointClouds:
    """Return clouds, the k-th of which lies at x = k."""
    points = np.zeros((count, capacity, 3), np.float32)
    points[:, :, 0] = np.arange(count)[:, None]
    return thor2.PointClouds.pack([(cloud, np.zeros((capacity, 3), np.uint8)) for cloud in points], capacity)


@pytest.mark.parametrize(("capacity", "size"), [(1, 64), (512, 64), (2048, 64), (4096, 32), (8192, 16), (2**18, 1)])
def test_chunks_have_few_points_except_on_a_gpu(capacity: int, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert describe.chunk_size(clouds_of(2, capacity)) == size
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert describe.chunk_size(clouds_of(300, 1)) == 300


@pytest.mark.parametrize("count", [1, 16, 17, 63, 64, 65, 127, 128, 150])
def test_results_of_chunks_are_those_of_the_whole_batch(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    sizes: list[int] = []

    def mean_x(chunk: thor2.PointClouds) -> dict[str, jax.Array]:
        sizes.append(len(chunk.mask))
        return {"x": chunk.points[:, :, 0].mean(axis=1), "points": chunk.points}

    clouds = clouds_of(count, 8192)  # chunks of 16
    results = jax.jit(lambda clouds: describe.map_chunks(mean_x, clouds))(clouds)
    assert max(sizes) <= 16 and len(sizes) <= 2 * describe.CHUNKS_PER_STEP
    np.testing.assert_array_equal(results["x"], np.arange(count))
    np.testing.assert_array_equal(results["points"], clouds.points)


def stream(count: int) -> list[Cloud]:
    return random_clouds(0, np.random.default_rng(0).integers(1, 300, count))


@pytest.mark.parametrize("count", [8, *slow(1, 4, 9)])
def test_a_stream_against_one_batch(count: int) -> None:
    batches = list(describe.describe_stream(stream(count), NETWORK, CLOSED, capacity=512, batch=4))
    assert [len(p.overflow) for p in batches] == [4] * (count // 4) + ([count % 4] if count % 4 else [])
    whole = thor2.describe(thor2.PointClouds.pack(stream(count), 512), NETWORK, CLOSED)
    np.testing.assert_allclose(np.concatenate([p.tops2 for p in batches]), whole.tops2, atol=1e-5)
    np.testing.assert_array_equal(np.concatenate([p.overflow for p in batches]), whole.overflow)


def test_a_stream_is_read_two_batches_ahead_at_most() -> None:
    read: list[Cloud] = []

    def recorded() -> Iterator[Cloud]:
        for cloud in stream(40):
            read.append(cloud)
            yield cloud

    batches = describe.describe_stream(recorded(), NETWORK, CLOSED, capacity=512, batch=4)
    assert len(read) == 0
    for done in range(1, 6):
        next(batches)
        assert len(read) == 4 * (done + 1)


def test_bad_input_of_a_stream() -> None:
    for batch in (0, 2.5):
        assert_refused(f"batch is {batch}", describe.describe_stream, stream(2), NETWORK, CLOSED, batch=batch)
    bad = [*stream(2), (np.full((3, 3), np.nan), np.zeros((3, 3), np.uint8))]
    assert_refused("2", list, describe.describe_stream(bad, NETWORK, CLOSED, capacity=512, batch=4))


# Several devices


PROGRAM = """
import sys
import jax
import numpy as np
from small_clouds import random_clouds
import colornet
import thor2_jax as thor2
from thor2_jax.descriptor.describe import batch_mesh, describe_sharded, shard_clouds

port, rank, homology, folder = sys.argv[1], int(sys.argv[2]), *sys.argv[3:]
jax.distributed.initialize(f"localhost:{port}", 2, rank)
clouds = thor2.PointClouds.pack(random_clouds(rank, range(100, 260, 20)), 512)
config = thor2.DescriptorConfig(homology=homology)
descriptors = describe_sharded(shard_clouds(clouds, batch_mesh()), colornet.load_default(), config)
assert descriptors.images.shape[0] == 16 and len(descriptors.images.sharding.device_set) == 8
for name in ("tops2", "overflow"):
    shards = getattr(descriptors, name).addressable_shards
    np.save(f"{folder}/{name}{rank}.npy", np.concatenate([np.asarray(shard.data) for shard in shards]))
"""


def test_each_device_describes_its_clouds(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a function that compiles at once in place of `describe`, and one device."""
    monkeypatch.setattr(describe, "describe", lambda clouds, network, config: (clouds.points * config.alpha, clouds))
    config = dataclasses.replace(SMALL_CONFIG, alpha=0.3)  # of no other test
    packed = thor2.PointClouds.pack([aligned_cloud(k, 100) for k in range(3)])
    turned, clouds = describe.describe_sharded(shard_clouds(packed, batch_mesh()), NETWORK, config)
    np.testing.assert_allclose(turned, packed.points * config.alpha)
    jax.tree.map(np.testing.assert_array_equal, clouds, packed)
    assert_refused("shard_clouds", describe.describe_sharded, packed, NETWORK, config)
    assert_refused("multiple of 2", shard_clouds, packed, Mesh(np.array(jax.devices() * 2), ("batch",)))


@pytest.mark.slow
@pytest.mark.parametrize("homology", ["gudhi", "closed_form"])
def test_two_processes_with_four_devices_equal_one_device(homology: str, tmp_path: Path) -> None:
    port = free_port()
    finish_programs(*(start_program(PROGRAM, port, rank, homology, tmp_path, devices=4) for rank in range(2)))
    clouds = thor2.PointClouds.pack([cloud for rank in range(2) for cloud in random_clouds(rank, range(100, 260, 20))])
    expected = thor2.describe(clouds, NETWORK, thor2.DescriptorConfig(homology=homology))
    for name in ("tops2", "overflow"):
        sharded = np.concatenate([np.load(tmp_path / f"{name}{rank}.npy") for rank in range(2)])
        np.testing.assert_allclose(sharded, getattr(expected, name), atol=1e-6)
