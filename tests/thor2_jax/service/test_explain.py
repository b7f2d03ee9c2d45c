"""What /v1/explain adds to the names, against the library on the same run."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import colornet
import thor2_jax as thor2
from thor2_jax.descriptor.describe import strips
from thor2_jax.recognition.recognizer import DescribedFrame
from thor2_jax.service.answers import explained_frame
from thor2_jax.service.engine import Row
from thor2_jax.service.preparing import Prepared, prepare_frame
from thor2_jax.service.schemas import LabelMap
from thor2_jax.service.settings import MAX_DETAILED, MAX_RUNS

Files = dict[str, bytes]


@pytest.fixture(scope="module")
def described(run_folder: Path, frame: thor2.RGBDFrame) -> DescribedFrame:
    return thor2.Recognizer.load(run_folder).describe(frame)


@pytest.fixture
def answer(ask: httpx.Client, files: Files) -> Any:
    found = ask.post("/v1/explain", files=files)
    assert found.status_code == 200, found.text
    return found.json()


def unpacked(label_map: LabelMap) -> np.ndarray:
    return np.repeat(label_map.labels, label_map.lengths).reshape(label_map.height, label_map.width)


def test_the_names_are_those_of_recognize(ask: httpx.Client, files: Files, answer: Any) -> None:
    plain = ask.post("/v1/recognize", files=files).json()["instances"]
    given = [{name: value for name, value in one.items() if name != "details"} for one in answer["instances"]]
    for one, other in zip(given, plain, strict=True):
        assert one == pytest.approx(other, abs=1e-5) if "top" not in one else one.keys() == other.keys()
        assert (one["label"], one["name"], one["unrecognized"]) == (
            other["label"],
            other["name"],
            other["unrecognized"],
        )
    assert [one["details"] is None for one in answer["instances"]] == [one["name"] is None for one in plain]


def test_the_details_are_those_of_the_library(answer: Any, described: DescribedFrame) -> None:
    config, network = thor2.DescriptorConfig(homology="closed_form"), colornet.load_default()
    aligned = thor2.align(described.packed, config)
    colors = np.asarray(strips(aligned, network, config).color)
    named = [one for one in answer["instances"] if one["details"] is not None]
    assert len(named) == len(described.usable) == 3
    for row, one in enumerate(named):
        details, part = one["details"], described.usable[row]
        images = np.asarray(described.descriptors.images[row])
        assert details["image_peak"] == pytest.approx(images.max(), rel=1e-4)
        shown = np.array([piece["image"] for piece in details["slices"]])
        assert shown.shape == images.shape and shown.max() == 255 and shown.min() >= 0
        np.testing.assert_allclose(shown / 255 * details["image_peak"], images, atol=0.6 / 255 * details["image_peak"])

        found = np.zeros_like(colors[row])
        for number, piece in enumerate(details["slices"]):
            for strip in piece["strips"]:
                found[number, strip["strip"], strip["regions"]] = strip["weights"]
        np.testing.assert_allclose(found, colors[row], atol=1e-3)

        points, rgb = np.array(details["points"]), np.array(details["colors"])
        assert len(points) == len(rgb) == min(1000, len(part.points))
        for all_points, all_colors in [(np.asarray(aligned.points[row])[: len(part.points)], part.colors)]:
            distance = np.abs(points[:, None] - all_points[None]).max(axis=2)
            assert distance.min(axis=1).max() < 1e-3
            assert (rgb == all_colors[distance.argmin(axis=1)]).all(axis=1).mean() > 0.99
        borders = np.array(details["slice_borders"])
        np.testing.assert_allclose(borders, 0.1 * np.column_stack([np.arange(7), np.arange(1, 8)]), atol=1e-9)


def test_the_label_map_is_the_label_image(answer: Any, frame: thor2.RGBDFrame) -> None:
    np.testing.assert_array_equal(unpacked(LabelMap(**answer["label_map"])), frame.labels)
    assert set(answer["timings"]) >= {"upload", "decode", "clouds", "device", "total"}


def test_a_ragged_label_map_is_made_coarser(files: Files, encode: Callable[..., bytes]) -> None:
    labels = np.random.default_rng(0).integers(0, 3, (240, 320)).astype(np.uint8)  # 51,000 runs
    assert (np.diff(labels.ravel()) != 0).sum() > MAX_RUNS
    found = prepare_frame(files | {"labels": encode(labels)}, 2.5, True).label_map
    assert found is not None and len(found.labels) <= MAX_RUNS
    np.testing.assert_array_equal(unpacked(found), labels[::2, ::2])
    for shape in ((1, 1), (1, 3)):
        one = files | {name: encode(np.ones(shape, kind)) for name, kind in (("labels", "u1"), ("depth", "u2"))}
        one["color"] = encode(np.zeros((*shape, 3), np.uint8))
        small = prepare_frame(one, 2.5, True).label_map
        assert small is not None and (small.labels, small.lengths) == ([1], [shape[1]])
    assert prepare_frame(files, 2.5, False).label_map is None


def explained(part: Any, count: int, config: thor2.DescriptorConfig, z: np.ndarray) -> Any:
    """The answer for `count` instances that are all alike."""
    row = Row(
        np.zeros((7, 32, 32), np.float32),
        np.zeros((7, 22, 31), np.float32),
        0,
        {},
        np.column_stack([z, z, z]).astype(np.float32),
        np.zeros((7, 31, 22), np.float32),
    )
    empty = LabelMap(width=1, height=1, labels=[0], lengths=[1])
    instances = [dataclasses.replace(part, label=k) for k in range(count)]
    found = [thor2.Recognition(label=k, name="a") for k in range(count)]
    return explained_frame(Prepared(instances, {}, empty), found, [row] * count, config, {})


def test_past_the_first_instances_there_are_no_details(described: DescribedFrame) -> None:
    part = described.usable[0]
    many = explained(part, MAX_DETAILED + 2, thor2.DescriptorConfig(), np.zeros(len(part.points)))
    assert [one.details is None for one in many.instances] == [False] * MAX_DETAILED + [True] * 2
    details = many.instances[0].details
    assert details.image_peak == 0 and not np.any([piece.image for piece in details.slices])
    assert all(piece.strips == [] for piece in details.slices)
    assert len(json.dumps(many.model_dump())) < 4e6


def test_slices_of_the_released_convention_are_the_levels_that_occur(described: DescribedFrame) -> None:
    part = described.usable[0]
    z = np.resize([0.02, 0.11, 0.32], len(part.points))  # levels 0, 1, 3
    (one,) = explained(part, 1, thor2.DescriptorConfig.released(), z).instances
    np.testing.assert_allclose(one.details.slice_borders, [(-0.05, 0.05), (0.05, 0.15), (0.25, 0.35)], atol=1e-9)


def test_problems_are_those_of_recognize(ask: httpx.Client, files: Files) -> None:
    for field, status in (("color", 422), ("depth", 422), ("labels", 422), ("intrinsics", 422)):
        found = ask.post("/v1/explain", files=files | {field: b"nothing"})
        assert found.status_code == status and found.json()["field"] == field
    assert ask.post("/v1/explain", content=b"x").status_code == 415


def test_nothing_was_compiled_to_explain(ask: httpx.Client, files: Files) -> None:
    assert ask.post("/v1/explain", files=files).status_code == 200
    assert "thor2_compilations_after_warm_up_total 0.0" in ask.get("/metrics").text.splitlines()
