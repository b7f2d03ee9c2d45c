"""Results on an accelerator equal those on a CPU. All other tests run on it too, as it is the default device of jax."""

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_clouds import NETWORK
from small_runs import untrained_embedding_run, with_surfaces

import thor2_jax as thor2
from benchmarks import run_gpu
from benchmarks.timing import time_calls
from thor2_jax.descriptor.looks import describe_looks
from thor2_jax.model.inference import infer
from thor2_jax.model.model import Model
from thor2_jax.networks.embedding import References
from thor2_jax.networks.networks import FEATURES

N_CLOUDS = 64


@pytest.fixture(scope="module")
def accelerator() -> jax.Device:
    device = jax.devices()[0]
    if device.platform == "cpu":
        pytest.skip("jax sees no accelerator")
    return device


@pytest.fixture(scope="module")
def clouds() -> thor2.PointClouds:
    """Rotated, coloured boxes with different numbers of points in front of the camera."""
    rng = np.random.default_rng(0)
    pairs = []
    for n in rng.integers(100, 2048, N_CLOUDS):
        points = rng.uniform(-1, 1, (n, 3)) * rng.uniform(0.03, 0.1, 3)
        turned = points @ Rotation.random(rng=rng).as_matrix().T + [0, 0, 0.8]
        pairs.append((turned.astype(np.float32), rng.integers(0, 256, (n, 3), dtype=np.uint8)))
    return thor2.PointClouds.pack(pairs, 2048)


def on_both(accelerator: jax.Device, function: Callable[..., Any], *arguments: Any) -> Iterator[Any]:
    """Return the results of a function on the accelerator and on a CPU."""
    return (function(*jax.device_put(arguments, device)) for device in (accelerator, jax.devices("cpu")[0]))


def assert_near_except_at_borders(
    actual: jax.Array, expected: jax.Array, median: float = 1e-5, limit: float = 1e-3
) -> None:
    """Assert equality up to rounding; in at most one cloud of twenty, a point at a border may change sides.

    Differences are the largest in each cloud, relative to its largest absolute value.
    """
    a, b = (np.asarray(x, np.float64).reshape(N_CLOUDS, -1) for x in (actual, expected))
    assert np.isfinite(a).all() and np.isfinite(b).all()
    difference = np.abs(a - b).max(axis=1) / np.abs(b).max(axis=1)
    assert np.median(difference) < median
    assert (difference > limit).mean() <= 0.05


@pytest.mark.gpu
@pytest.mark.parametrize("homology", ["closed_form", "gudhi"])
def test_descriptors_are_those_of_a_cpu(homology: str, accelerator: jax.Device, clouds: thor2.PointClouds) -> None:
    config = thor2.DescriptorConfig(homology=homology)
    describe = partial(thor2.describe, network=NETWORK, config=config)
    descriptors, expected = on_both(accelerator, describe, clouds)
    assert descriptors.images.devices() == {accelerator}
    assert_near_except_at_borders(descriptors.images, expected.images)
    assert_near_except_at_borders(descriptors.embeddings, expected.embeddings)


@pytest.mark.gpu
@pytest.mark.parametrize("homology", ["closed_form", "gudhi"])
def test_gradients_are_those_of_a_cpu(homology: str, accelerator: jax.Device, clouds: thor2.PointClouds) -> None:
    config = thor2.DescriptorConfig(homology=homology)

    def mass(points: jax.Array, clouds: thor2.PointClouds) -> jax.Array:
        return thor2.describe(dataclasses.replace(clouds, points=points), NETWORK, config).images.sum()

    gradient, expected = on_both(accelerator, jax.jit(jax.grad(mass)), clouds.points, clouds)
    assert_near_except_at_borders(gradient, expected, median=1e-3, limit=1e-2)


def products(traced: Any) -> Iterator[Any]:
    """Yield the precision of each product of a traced function and of the functions that it calls."""
    for equation in traced.eqns:
        if equation.primitive.name in ("dot_general", "conv_general_dilated"):
            yield equation.params["precision"]
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda value: hasattr(value, "eqns")):
            if hasattr(inner, "eqns"):
                yield from products(inner)


def test_products_of_recognition_are_float32_on_every_device(clouds: thor2.PointClouds) -> None:
    """TF32, the default of recent GPUs, changes confidences in the third digit."""
    run = with_surfaces(untrained_embedding_run("abc", FEATURES))
    views = References(np.ones((3, run.embedding.size), np.float16), np.arange(3, dtype=np.int32), run.classes)
    model = Model.of_run(dataclasses.replace(run, embedding=dataclasses.replace(run.embedding, references=views)))

    def inferred(clouds: thor2.PointClouds) -> Any:
        return infer(model, describe_looks(clouds, NETWORK, model.run.config, 4), clouds, embeds=True)

    few = jax.tree.map(lambda a: a[:4], clouds)
    precisions = set(products(jax.make_jaxpr(inferred)(few)))
    assert precisions == {(jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)}


@pytest.mark.parametrize("describes", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_benchmark_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], describes: bool
) -> None:
    """Runs on any device; its figures are not checked."""
    if not describes:  # but a function that compiles at once
        monkeypatch.setattr(thor2, "describe", lambda clouds, *_: clouds.points * 2)
    monkeypatch.setattr(sys, "argv", ["run_gpu", "--any-device", "--clouds", "4", "--out", str(tmp_path)])
    monkeypatch.setattr(run_gpu, "N_POINTS", 512)
    monkeypatch.setattr(run_gpu, "time_calls", partial(time_calls, seconds=0))
    run_gpu.main()
    table = [line.split() for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[0] for row in table] == ["closed_form", "gudhi"]
    rows = json.loads((tmp_path / "gpu.json").read_text())["rows"]
    for name, rate, *_ in table:
        assert rows[name]["clouds_per_s"] == pytest.approx(float(rate.replace(",", "")), abs=0.5)
        assert rows[name]["bytes"] > 0 and rows[name]["operations"] > 0
