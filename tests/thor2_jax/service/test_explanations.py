"""The evidence of /v1/explain, compared with the library on the same run."""

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
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.model.inference import Inference
from thor2_jax.service.answers import explained_frame
from thor2_jax.service.engine import CloudResult
from thor2_jax.service.preparation import MAX_LABEL_RUNS, PreparedRequest, prepare_frame
from thor2_jax.service.schemas import LabelMap
from thor2_jax.service.settings import MAX_EXPLAINED

Files = dict[str, bytes]


def decoded(label_map: LabelMap) -> np.ndarray:
    return np.repeat(label_map.labels, label_map.lengths).reshape(label_map.height, label_map.width)


def test_explain_returns_the_answers_and_the_details_behind_them(
    http: httpx.Client, files: Files, frame: thor2.RGBDFrame, run_dir: Path
) -> None:
    answer = http.post("/v1/explain", files=files).json()
    np.testing.assert_array_equal(decoded(LabelMap(**answer["label_map"])), frame.labels)
    plain = http.post("/v1/recognize", files=files).json()["instances"]
    for one, other in zip(answer["instances"], plain, strict=True):
        assert one.keys() == other.keys() | {"details"}
        assert [one[name] for name in ("label", "name", "unrecognized")] == [
            other[name] for name in ("label", "name", "unrecognized")
        ]
        assert (one["details"] is None) == (one["name"] is None)

    described = thor2.Recognizer.load(run_dir).describe(frame)
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
        all_points = np.asarray(aligned.points[row])[: len(instance.points)]
        distance = np.abs(points[:, None] - all_points[None]).max(axis=2)
        assert distance.min(axis=1).max() < 1e-3
        assert (rgb == instance.colors[distance.argmin(axis=1)]).all(axis=1).mean() > 0.99
        borders = np.array(details["slice_borders"])
        np.testing.assert_allclose(borders, 0.1 * np.column_stack([np.arange(7), np.arange(1, 8)]), atol=1e-9)


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


def explained(count: int, config: thor2.DescriptorConfig, z: np.ndarray) -> Any:
    """Return the answer for `count` identical instances."""
    aligned, colors = np.column_stack([z, z, z]).astype(np.float32), np.zeros((len(z), 3), np.uint8)
    images, strip_colors = np.zeros((7, 32, 32), np.float32), np.zeros((7, 31, 22), np.float32)
    result = CloudResult(images, np.zeros((7, 22, 31), np.float32), aligned, strip_colors, Inference(0, {}))
    instances = [PreparedInstance(k, aligned, colors, np.zeros(len(z), bool)) for k in range(count)]
    recognitions = [thor2.Recognition(label=k, name="a") for k in range(count)]
    prepared = PreparedRequest(instances, {}, LabelMap(width=1, height=1, labels=[0], lengths=[1]))
    return explained_frame(prepared, recognitions, [result] * count, [None] * count, config, {})


def test_details_are_limited_to_the_first_instances() -> None:
    many = explained(MAX_EXPLAINED + 2, thor2.DescriptorConfig(), np.zeros(2000))
    assert [one.details is None for one in many.instances] == [False] * MAX_EXPLAINED + [True] * 2
    details = many.instances[0].details
    assert details.image_peak == 0 and not np.any([piece.image for piece in details.slices])
    assert all(piece.strips == [] for piece in details.slices)
    assert len(json.dumps(many.model_dump())) < 4e6


def test_released_slices_are_the_occurring_levels() -> None:
    (one,) = explained(1, thor2.DescriptorConfig.released(), np.array([0.02, 0.11, 0.32])).instances  # levels 0, 1, 3
    np.testing.assert_allclose(one.details.slice_borders, [(-0.05, 0.05), (0.05, 0.15), (0.25, 0.35)], atol=1e-9)
