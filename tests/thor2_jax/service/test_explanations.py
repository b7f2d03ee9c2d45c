"""The evidence of /v1/explain, compared with the library on the same run."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from helpers import encode_image

import colornet
import thor2_jax as thor2
from thor2_jax.descriptor.describe import strips
from thor2_jax.model.classifier import RunClassifiers
from thor2_jax.model.confidence import Calibration
from thor2_jax.model.inference import Inference
from thor2_jax.model.recognition import DescribedFrame
from thor2_jax.service.answers import explained_frame
from thor2_jax.service.engine import CloudResult, InferenceEngine
from thor2_jax.service.preparation import MAX_LABEL_RUNS, PreparedRequest, prepare_frame
from thor2_jax.service.schemas import LabelMap
from thor2_jax.service.settings import MAX_EXPLAINED, Settings

Files = dict[str, bytes]


@pytest.fixture(scope="module")
def described(run_dir: Path, frame: thor2.RGBDFrame) -> DescribedFrame:
    return thor2.Recognizer.load(run_dir).describe(frame)


@pytest.fixture
def answer(http: httpx.Client, files: Files) -> Any:
    response = http.post("/v1/explain", files=files)
    assert response.status_code == 200, response.text
    return response.json()


def decoded(label_map: LabelMap) -> np.ndarray:
    return np.repeat(label_map.labels, label_map.lengths).reshape(label_map.height, label_map.width)


def test_explain_returns_the_names_of_recognize(http: httpx.Client, files: Files, answer: Any) -> None:
    plain = http.post("/v1/recognize", files=files).json()["instances"]
    explained = [{name: value for name, value in one.items() if name != "details"} for one in answer["instances"]]
    for one, other in zip(explained, plain, strict=True):
        assert one == pytest.approx(other, abs=1e-5) if "top" not in one else one.keys() == other.keys()
        assert (one["label"], one["name"], one["unrecognized"]) == (
            other["label"],
            other["name"],
            other["unrecognized"],
        )
    assert [one["details"] is None for one in answer["instances"]] == [one["name"] is None for one in plain]


def test_details_match_the_library(answer: Any, described: DescribedFrame) -> None:
    config, network = thor2.DescriptorConfig(homology="closed_form"), colornet.load_default()
    aligned = thor2.align(described.packed, config)
    colors = np.asarray(strips(aligned, network, config).color)
    named = [one for one in answer["instances"] if one["details"] is not None]
    assert len(named) == len(described.usable) == 3
    for row, one in enumerate(named):
        details, instance = one["details"], described.usable[row]
        images = np.asarray(described.descriptors.images[row])
        assert details["image_peak"] == pytest.approx(images.max(), rel=1e-4)
        shown = np.array([piece["image"] for piece in details["slices"]])
        assert shown.shape == images.shape and shown.max() == 255 and shown.min() >= 0
        np.testing.assert_allclose(shown / 255 * details["image_peak"], images, atol=0.6 / 255 * details["image_peak"])

        shown_colors = np.zeros_like(colors[row])
        for number, piece in enumerate(details["slices"]):
            for strip in piece["strips"]:
                shown_colors[number, strip["strip"], strip["regions"]] = strip["weights"]
        np.testing.assert_allclose(shown_colors, colors[row], atol=1e-3)

        points, rgb = np.array(details["points"]), np.array(details["colors"])
        assert len(points) == len(rgb) == min(1000, len(instance.points))
        for all_points, all_colors in [(np.asarray(aligned.points[row])[: len(instance.points)], instance.colors)]:
            distance = np.abs(points[:, None] - all_points[None]).max(axis=2)
            assert distance.min(axis=1).max() < 1e-3
            assert (rgb == all_colors[distance.argmin(axis=1)]).all(axis=1).mean() > 0.99
        borders = np.array(details["slice_borders"])
        np.testing.assert_allclose(borders, 0.1 * np.column_stack([np.arange(7), np.arange(1, 8)]), atol=1e-9)


def test_calibrated_confidence_uses_the_temperatures(run_dir: Path) -> None:
    rng = np.random.default_rng(0)
    engine = InferenceEngine(Settings(run_dir))
    shape = len(engine.run.classes)
    probabilities = {name: rng.dirichlet(np.full(shape, 0.1)).astype(np.float32) for name in ("tops", "tops2")}
    empty = np.zeros(0, np.float32)
    result = CloudResult(empty, empty, empty, empty, Inference(0, probabilities))
    assert engine.calibrated_confidences([result]) == [None] and engine.calibrated_confidences([]) == []
    engine.run.record["temperatures"] = {"tops": 2.0, "tops2": 3.0}
    (confidence,) = engine.calibrated_confidences([result])
    logits = np.log(probabilities["tops"]) / 2 + np.log(probabilities["tops2"]) / 3
    expected = np.exp(logits / 2) / np.exp(logits / 2).sum()
    assert confidence == pytest.approx(expected[np.prod(list(probabilities.values()), axis=0).argmax()], rel=1e-4)


def test_confidence_of_a_calibrated_run_is_calibrated(run_dir: Path) -> None:
    engine = InferenceEngine(Settings(run_dir))
    record = {"calibration": dataclasses.asdict(Calibration(0.0, 1.0, 1.0, 0.5, 0.2))}
    run = dataclasses.replace(engine.run, record=record)
    classifiers = RunClassifiers({**engine.model.classifiers, "embedding": lambda oriented: oriented})
    engine._recognizer.model = dataclasses.replace(engine.model, run=run, classifiers=classifiers)
    names = engine.model.classifiers.default
    probabilities = {name: np.array([0.7, 0.2, 0.1], np.float32)[: len(engine.run.classes)] for name in names}
    empty = np.zeros(0, np.float32)
    (confidence,) = engine.calibrated_confidences(
        [CloudResult(empty, empty, empty, empty, Inference(0, probabilities))]
    )
    rows = {name: values[None] for name, values in probabilities.items()}
    assert confidence == pytest.approx(float(engine.model.fused(rows).max()))


def test_label_map_decodes_to_the_label_image(answer: Any, frame: thor2.RGBDFrame) -> None:
    np.testing.assert_array_equal(decoded(LabelMap(**answer["label_map"])), frame.labels)
    assert set(answer["timings"]) >= {"upload", "decode", "clouds", "device", "total"}


def test_label_map_with_many_runs_is_subsampled(files: Files) -> None:
    labels = np.random.default_rng(0).integers(0, 3, (240, 320)).astype(np.uint8)  # 51,000 runs
    assert (np.diff(labels.ravel()) != 0).sum() > MAX_LABEL_RUNS
    label_map = prepare_frame(files | {"labels": encode_image(labels)}, 2.5, True, None).label_map
    assert label_map is not None and len(label_map.labels) <= MAX_LABEL_RUNS
    np.testing.assert_array_equal(decoded(label_map), labels[::2, ::2])
    for shape in ((1, 1), (1, 3)):
        one = files | {name: encode_image(np.ones(shape, kind)) for name, kind in (("labels", "u1"), ("depth", "u2"))}
        one["color"] = encode_image(np.zeros((*shape, 3), np.uint8))
        small = prepare_frame(one, 2.5, True, None).label_map
        assert small is not None and (small.labels, small.lengths) == ([1], [shape[1]])
    assert prepare_frame(files, 2.5, False, None).label_map is None


def explained(instance: Any, count: int, config: thor2.DescriptorConfig, z: np.ndarray) -> Any:
    """Return the answer for `count` identical instances."""
    result = CloudResult(
        np.zeros((7, 32, 32), np.float32),
        np.zeros((7, 22, 31), np.float32),
        np.column_stack([z, z, z]).astype(np.float32),
        np.zeros((7, 31, 22), np.float32),
        Inference(0, {}),
    )
    empty = LabelMap(width=1, height=1, labels=[0], lengths=[1])
    instances = [dataclasses.replace(instance, label=k) for k in range(count)]
    recognitions = [thor2.Recognition(label=k, name="a") for k in range(count)]
    return explained_frame(
        PreparedRequest(instances, {}, empty), recognitions, [result] * count, [None] * count, config, {}
    )


def test_details_are_limited_to_the_first_instances(described: DescribedFrame) -> None:
    instance = described.usable[0]
    many = explained(instance, MAX_EXPLAINED + 2, thor2.DescriptorConfig(), np.zeros(len(instance.points)))
    assert [one.details is None for one in many.instances] == [False] * MAX_EXPLAINED + [True] * 2
    details = many.instances[0].details
    assert details.image_peak == 0 and not np.any([piece.image for piece in details.slices])
    assert all(piece.strips == [] for piece in details.slices)
    assert len(json.dumps(many.model_dump())) < 4e6


def test_released_slices_are_the_occurring_levels(described: DescribedFrame) -> None:
    instance = described.usable[0]
    z = np.resize([0.02, 0.11, 0.32], len(instance.points))  # levels 0, 1, 3
    (one,) = explained(instance, 1, thor2.DescriptorConfig.released(), z).instances
    np.testing.assert_allclose(one.details.slice_borders, [(-0.05, 0.05), (0.05, 0.15), (0.25, 0.35)], atol=1e-9)


def test_explain_errors_name_the_field(http: httpx.Client, files: Files) -> None:
    for field, status in (("color", 422), ("depth", 422), ("labels", 422), ("intrinsics", 422)):
        response = http.post("/v1/explain", files=files | {field: b"damaged"})
        assert response.status_code == status and response.json()["field"] == field
    assert http.post("/v1/explain", content=b"x").status_code == 415


def test_explain_compiles_nothing(http: httpx.Client, files: Files) -> None:
    assert http.post("/v1/explain", files=files).status_code == 200
    assert "thor2_compilations_after_warm_up_total 0.0" in http.get("/metrics").text.splitlines()
