"""Exported recognizers."""

import dataclasses
from pathlib import Path

import jax.export
import numpy as np
import pytest
from processes import finish_programs, start_program
from refusals import assert_refused
from small_clouds import random_clouds
from small_runs import SMALL_CONFIG, class_probabilities, untrained_embedding_run, untrained_run, with_surfaces

import thor2_jax as thor2
from thor2_jax.descriptor.looks import describe_looks
from thor2_jax.export import export_recognizer
from thor2_jax.model.inference import infer
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.networks import FEATURES

CONFIG = dataclasses.replace(SMALL_CONFIG, homology="gudhi", looks=4)


@pytest.fixture(scope="module")
def run() -> TrainedRun:
    return with_surfaces(untrained_embedding_run("abc", FEATURES, CONFIG))


LOADER = """
import sys
import jax, jax.export, numpy as np
exported = jax.export.deserialize(bytearray(open(sys.argv[1], "rb").read()))
fields = np.load(sys.argv[2])
outputs = exported.call(*(fields[name] for name in ("points", "colors", "mask", "camera", "boundary", "rim")))
assert not any(name.split(".")[0] in ("thor2_jax", "colornet", "flax", "gudhi") for name in sys.modules)
np.savez(sys.argv[3], **outputs)
"""


@pytest.mark.slow
def test_an_exported_recognizer_runs_without_this_package(run: TrainedRun, tmp_path: Path) -> None:
    clouds = random_clouds(0, (500, 31, 0))
    rims = [points[:, 0] < 0.3 * points[:, 0].max(initial=0) for points, _ in clouds]
    packed = thor2.PointClouds.pack([*clouds, clouds[0]], 512, rim=[*rims, None])
    blob = export_recognizer(run, n_points=512, n_clouds=4)
    paths = [tmp_path / name for name in ("recognizer.jax", "clouds.npz", "outputs.npz")]
    paths[0].write_bytes(blob)
    np.savez(paths[1], **{field.name: getattr(packed, field.name) for field in dataclasses.fields(packed)})
    finish_programs(start_program(LOADER, *paths))
    outputs = np.load(paths[2])
    assert set(outputs) == {*FEATURES, "embedding", "overflow"}

    described = describe_looks(packed, run.network, CONFIG)  # gudhi: the other backend
    np.testing.assert_array_equal(outputs["overflow"], described.first.overflow)
    expected = infer(thor2.Recognizer(run).model, described, packed, (*FEATURES, "embedding")).probabilities
    for name, probabilities in expected.items():
        np.testing.assert_allclose(outputs[name], probabilities, rtol=0, atol=1e-5)
        assert np.abs(outputs[name][0] - outputs[name][3]).max() > 1e-4  # without its rim, the cloud is another one
    for name in FEATURES:
        np.testing.assert_allclose(outputs[name].sum(axis=1), 1, atol=1e-5)
    assert (outputs["embedding"].sum(axis=1) < 1).all()


def test_an_embedding_of_other_classes_is_not_exported() -> None:
    run = untrained_embedding_run("abc", ("tops",), dataclasses.replace(SMALL_CONFIG, looks=1))
    other = dataclasses.replace(run, embedding=dataclasses.replace(run.embedding, classes=("a",)))
    exported = jax.export.deserialize(bytearray(export_recognizer(other, n_points=512, n_clouds=1)))
    ((points, colors),) = random_clouds(0, [300])
    packed = thor2.PointClouds.pack([(points, colors)], 512, rim=[points[:, 0] < 0.05])
    packed = jax.device_put(packed, jax.devices("cpu")[0])
    outputs = exported.call(*(getattr(packed, field.name) for field in dataclasses.fields(packed)[:6]))
    assert set(outputs) == {"tops", "overflow"}
    described = describe_looks(packed, run.network, run.config)
    expected = class_probabilities(thor2.Recognizer(run), described, ("tops",))["tops"]
    np.testing.assert_allclose(outputs["tops"], expected, atol=1e-5)
    np.testing.assert_array_equal(outputs["overflow"], described.first.overflow)


def test_invalid_runs_sizes_and_platforms_are_refused(run: TrainedRun) -> None:
    assert_refused("n_points is 500", export_recognizer, run, n_points=500, n_clouds=1)
    assert_refused("n_clouds is 3", export_recognizer, run, n_points=512, n_clouds=3)
    for given, message in (("run", "run is of type str"), (untrained_run((), ()), "run has no classes")):
        assert_refused(message, export_recognizer, given, n_points=512, n_clouds=1)
    for platforms in (("abacus",), ()):
        assert_refused("platforms is", export_recognizer, run, n_points=512, n_clouds=1, platforms=platforms)
