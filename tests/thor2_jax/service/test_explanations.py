"""Explanations of frames and of one object, over HTTP, compared with the library, and on the web page."""

import base64
import dataclasses
import io
import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import numpy as np
import pytest
from page_actions import answered, assert_fits, wait_until
from PIL import Image
from playwright.sync_api import Route, expect
from processes import HANG
from service_requests import check_refused
from small_clouds import CLOSED, NETWORK
from small_runs import untrained_run

import thor2_jax as thor2
from thor2_jax.descriptor.describe import strips
from thor2_jax.frames.frames import encode_image
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.model.inference import Inference
from thor2_jax.model.model import Model
from thor2_jax.service import pipeline
from thor2_jax.service.answers import explained_frame
from thor2_jax.service.engine import CloudResult
from thor2_jax.service.pipeline import Service
from thor2_jax.service.preparation import MAX_LABEL_RUNS, PreparedRequest, prepare_frame
from thor2_jax.service.schemas import MAX_EXPLAINED, LabelMap

from .conftest import Files, Open


def decoded(label_map: LabelMap) -> np.ndarray:
    return np.repeat(label_map.labels, label_map.lengths).reshape(label_map.height, label_map.width)


def test_explain_returns_the_answers_and_the_details_behind_them(
    http: httpx.Client, files: Files, frame: thor2.RGBDFrame, run_dir: Path
) -> None:
    answer = http.post("/v1/explain", files=files).json()
    np.testing.assert_array_equal(decoded(LabelMap(**answer["label_map"])), frame.labels)
    plain = http.post("/v1/recognize", files=files).json()["instances"]
    for one, other in zip(answer["instances"], plain, strict=True):
        assert one.keys() == other.keys() | {"details"} and (one["details"] is None) == (one["name"] is None)
        assert all(one[name] == other[name] for name in ("label", "name", "unrecognized"))

    described = thor2.Recognizer.load(run_dir).describe(frame)
    aligned = thor2.align(described.packed, CLOSED)
    colors = np.asarray(strips(aligned, NETWORK, CLOSED).color)
    shown = [one["details"] for one in answer["instances"] if one["details"] is not None]
    assert len(shown) == 3
    for row, (details, instance) in enumerate(zip(shown, described.usable, strict=True)):
        images = np.asarray(described.descriptors.images[row])
        assert details["image_peak"] == pytest.approx(images.max(), rel=1e-4)
        levels = np.array([piece["image"] for piece in details["slices"]])
        np.testing.assert_allclose(levels / 255 * details["image_peak"], images, atol=0.6 / 255 * details["image_peak"])

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
    label_map = prepare_frame(files | {"labels": encode_image(labels)}, thor2.DescriptorConfig(), True, None).label_map
    assert label_map is not None and len(label_map.labels) <= MAX_LABEL_RUNS
    np.testing.assert_array_equal(decoded(label_map), labels[::2, ::2])
    for shape in ((1, 1), (1, 3)):
        one = files | {name: encode_image(np.ones(shape, kind)) for name, kind in (("labels", "u1"), ("depth", "u2"))}
        one["color"] = encode_image(np.zeros((*shape, 3), np.uint8))
        small = prepare_frame(one, thor2.DescriptorConfig(), True, None).label_map
        assert small is not None and (small.labels, small.lengths) == ([1], [shape[1]])
    assert prepare_frame(files, thor2.DescriptorConfig(), False, None).label_map is None


def explained(count: int, config: thor2.DescriptorConfig, z: np.ndarray, reason: str | None = None) -> Any:
    """Return the answer for `count` instances, which are identical except for the reason of the first one."""
    aligned, colors = np.column_stack([z, z, z]).astype(np.float32), np.zeros((len(z), 3), np.uint8)
    images, strip_colors = np.zeros((7, 32, 32), np.float32), np.zeros((7, 31, 22), np.float32)
    result = CloudResult(images, np.zeros((7, 22, 31), np.float32), aligned, strip_colors, Inference(0, {}))
    instances = [PreparedInstance(k, aligned, colors, np.zeros(len(z), bool)) for k in range(count)]
    instances[0] = dataclasses.replace(instances[0], reason=reason)
    recognitions = [thor2.Recognition(label=k, name="a") for k in range(count)]
    prepared = PreparedRequest(instances, {}, LabelMap(width=1, height=1, labels=[0], lengths=[1]))
    run = untrained_run(("a",), (), config)
    return explained_frame(Model.of_run(run), prepared, [result] * count, recognitions, {})


def test_details_are_limited_to_the_first_usable_instances() -> None:
    many = explained(MAX_EXPLAINED + 3, thor2.DescriptorConfig(), np.zeros(2000), "too few points")
    assert [one.details is None for one in many.instances] == [True] + [False] * MAX_EXPLAINED + [True] * 2
    details = many.instances[1].details
    assert details.image_peak == 0 and not np.any([piece.image for piece in details.slices])
    assert all(piece.strips == [] for piece in details.slices)
    assert len(json.dumps(many.model_dump())) < 4e6


def test_released_slices_are_the_occurring_levels() -> None:
    (one,) = explained(1, thor2.DescriptorConfig.released(), np.array([0.02, 0.11, 0.32])).instances  # levels 0, 1, 3
    np.testing.assert_allclose(one.details.slice_borders, [(-0.05, 0.05), (0.05, 0.15), (0.25, 0.35)], atol=1e-9)


BLANK = [base64.b64encode(encode_image(np.zeros((200, width), np.uint8))).decode() for width in (600, 300)]
ANSWER = {
    **{"label": 3, "name": "a", "explained_name": "a", "unit": "log-odds", "margin": -0.04, "timings": {}},
    **{"loss_without_most_attributed_tenth": 1.25, "mean_loss_without_random_tenth": -0.1},
    "changes": ["red +20, green +0, blue -3 (of 255): b"],
    "pictures": [{"title": "What decided", "caption": "Orange speaks for a.", "png": png} for png in BLANK],
}


def ask(url: str, files: Files) -> httpx.Response:
    return httpx.post(f"{url}/v1/why", files=files, data={"instance": "3"}, timeout=HANG)


def test_why_is_503_until_explanations_are_compiled(
    service: Service, teaching_url: str, files: Files, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    is_compiled, compiled = threading.Event(), []

    def compile_explanations(_: Model, n_points: int, by_classifiers: bool, is_stopped: Callable[[], bool]) -> None:
        assert is_compiled.wait(HANG) and not is_stopped()
        compiled.append((n_points, by_classifiers))
        raise thor2.InputError("the error is left to requests, which compile what is missing")

    monkeypatch.setattr(service, "_compiled", {})
    monkeypatch.setattr(pipeline, "compile_explanations", compile_explanations)
    monkeypatch.setattr(pipeline, "explain_instance", Mock(side_effect=thor2.InputError("instance is explained")))
    for _ in range(2):
        response = ask(teaching_url, files)
        check_refused(response, 503, None, "compiled")
        assert int(response.headers["retry-after"]) >= 1
    assert httpx.post(f"{teaching_url}/v1/recognize", files=files, timeout=HANG).status_code == 200
    is_compiled.set()
    next(iter(service._compiled.values())).result(HANG)
    check_refused(ask(teaching_url, files), 422, "instance", "is explained")
    assert compiled == service.engine.explanation_programs() and "are compiled" not in caplog.text


def test_compiled_explanations_are_logged_unless_the_service_stops(
    service: Service, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    monkeypatch.setattr(pipeline, "compile_explanations", Mock())
    for state, size in (("ready", 4096), ("stopping", 2048)):
        monkeypatch.setattr(service, "state", state)
        monkeypatch.setattr(service, "_compiled", {})
        service._compile_explanations((size, True)).result(HANG)
        assert (f"clouds of {size} points are compiled (classifiers)" in caplog.text) == (state == "ready")


@pytest.mark.slow
def test_why_returns_pictures(
    service: Service, teaching_url: str, files: Files, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Almost all programs of an explanation are compiled before the first one."""
    monkeypatch.setattr("thor2_jax.capacity.MIN_BATCH_POINTS", 512)
    service._compile_explanations(*service.engine.explanation_programs()).result(HANG)
    before = service.metrics.compilations._value.get()
    answer = ask(teaching_url, files).json()
    assert service.metrics.compilations._value.get() - before < 30  # of about 290
    assert answer["label"] == 3 and answer["explained_name"] in ("a", "b") and answer["unit"] == "log-odds"
    assert set(answer["timings"]) >= {"upload", "decode", "clouds", "explain", "total"}
    assert len(answer["pictures"]) >= 2
    for one in answer["pictures"]:
        with Image.open(io.BytesIO(base64.b64decode(one["png"]))) as image:
            assert image.format == "PNG" and min(image.size) > 200
        assert one["title"] and one["caption"].endswith(".")


def test_page_waits_for_an_explanation_and_shows_it(open_page: Open, teaching_url: str, files: Files) -> None:
    requests: list[Route] = []

    def compile_first(route: Route) -> None:
        requests.append(route)
        if len(requests) == 1:
            problem = {"field": None, "message": "Explanations are still being compiled."}
            route.fulfill(status=503, json=problem, headers={"Retry-After": "1"})

    def ask_why(label: int) -> None:
        page.locator(f'#objects button[data-label="{label}"]').click()
        page.get_by_role("button", name="Why?").click()

    page = open_page(url=teaching_url, files=files)
    page.route("**/v1/why", compile_first, times=2)
    ask_why(3)
    expect(page.locator("#why-status")).to_contain_text("still being compiled")
    expect(page.get_by_role("button", name="Why?")).to_be_disabled()
    wait_until(page, lambda: len(requests) == 2)  # the message stays until it is answered
    assert b'name="instance"\r\n\r\n3\r\n' in (requests[1].request.post_data_buffer or b"")
    requests[1].fulfill(json=ANSWER)
    for text in (": 0.0. ", "red +20", "rises by 0.10"):
        expect(page.locator("#why-status")).to_contain_text(text)
    shown = page.locator("#why-pictures canvas")
    expect(shown).to_have_count(2)
    assert [shown.nth(k).evaluate("canvas => canvas.width") for k in (0, 1)] == [600, 300]
    expect(shown.first).to_have_attribute("aria-label", "What decided. Orange speaks for a.")
    for width in (1280, 390):
        assert_fits(page, width)
    problem = {"field": "instance", "message": "instance 7 cannot be explained."}
    page.route("**/v1/why", answered("/v1/why", status=422, json=problem))
    page.locator('#objects button[data-label="7"]').click()  # The explanation belonged to the other object.
    expect(shown).to_have_count(0)
    expect(page.locator("#why-status")).to_have_text("")
    ask_why(7)
    expect(page.locator("#why-status")).to_have_text(problem["message"])
    expect(page.get_by_role("button", name="Why?")).to_be_enabled()
    page.locator('#objects button[data-label="5"]').click()  # It has too few points to be described.
    expect(page.locator("#why")).to_be_hidden()
