"""Explanations of one object over HTTP and on the web page."""

import base64
import io
import threading
from collections.abc import Callable

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from helpers import encode_image
from page_actions import assert_fits, upload, wait_until
from PIL import Image
from playwright.sync_api import Page, Route, expect
from processes import HANG
from service_requests import check_refused

from thor2_jax.errors import InputError
from thor2_jax.explanation import class_scores
from thor2_jax.model.model import Model
from thor2_jax.service import pipeline

Open = Callable[..., Page]
Files = dict[str, bytes]


@pytest.fixture(autouse=True)
def small_clouds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(class_scores, "MIN_CAPACITY", 512)


def picture(width: int) -> str:
    return base64.b64encode(encode_image(np.zeros((200, width), np.uint8))).decode()


ANSWER = {
    "label": 3,
    "name": "a",
    "explained_name": "a",
    "unit": "log-odds",
    "margin": 2.5,
    "loss_without_most_attributed_tenth": 1.25,
    "mean_loss_without_random_tenth": 0.125,
    "changes": ["red +20, green +0, blue -3 (of 255): b"],
    "pictures": [
        {"title": "What decided, on the photo", "caption": "Orange speaks for a.", "png": picture(600)},
        {"title": "What decided, on the points", "caption": "The same.", "png": picture(300)},
    ],
    "timings": {},
}


def ask(url: str, files: Files, instance: object) -> httpx.Response:
    return httpx.post(f"{url}/v1/why", files=files, data={"instance": str(instance)}, timeout=HANG)


def test_why_is_503_until_explanations_are_compiled(
    teaching_url: str, teaching_app: FastAPI, files: Files, monkeypatch: pytest.MonkeyPatch
) -> None:
    service, is_compiled, compiled = teaching_app.state.service, threading.Event(), []

    def compile_explanations(_: Model, n_points: int, by_classifiers: bool, is_stopped: Callable[[], bool]) -> None:
        assert is_compiled.wait(300) and not is_stopped()
        compiled.append((n_points, by_classifiers))

    def explain(*_: object) -> None:
        raise InputError("instance is explained")

    monkeypatch.setattr(service, "_compiled", {})
    monkeypatch.setattr(pipeline, "compile_explanations", compile_explanations)
    monkeypatch.setattr(pipeline, "explain_instance", explain)
    for _ in range(2):
        response = ask(teaching_url, files, 3)
        check_refused(response, 503, None, "compiled")
        assert int(response.headers["retry-after"]) >= 1
    assert httpx.post(f"{teaching_url}/v1/recognize", files=files, timeout=60).status_code == 200
    is_compiled.set()
    (future,) = service._compiled.values()
    future.result(300)
    check_refused(ask(teaching_url, files, 3), 422, "instance", "is explained")
    assert compiled == service.engine.explanation_programs()


def test_failed_compilation_leaves_the_error_to_requests(
    teaching_url: str, teaching_app: FastAPI, files: Files, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise InputError("explanations need a convention")

    service = teaching_app.state.service
    monkeypatch.setattr(service, "_compiled", {})
    monkeypatch.setattr(pipeline, "compile_explanations", fail)
    monkeypatch.setattr(pipeline, "explain_instance", fail)
    service._compile_explanations(*service.engine.explanation_programs()).result(300)
    check_refused(ask(teaching_url, files, 3), 422, "instance", "convention")


@pytest.mark.slow
def test_why_returns_pictures(teaching_url: str, teaching_app: FastAPI, files: Files) -> None:
    """Almost all programs of an explanation are compiled before the first one."""
    service = teaching_app.state.service
    service._compile_explanations(*service.engine.explanation_programs()).result(600)
    before = service.metrics.compilations._value.get()
    response = ask(teaching_url, files, 3)
    assert response.status_code == 200
    assert service.metrics.compilations._value.get() - before < 30  # of about 290
    answer = response.json()
    assert answer["label"] == 3 and answer["explained_name"] in ("a", "b") and answer["unit"] == "log-odds"
    assert set(answer["timings"]) >= {"upload", "decode", "clouds", "explain", "total"}
    assert len(answer["pictures"]) >= 2
    for one in answer["pictures"]:
        with Image.open(io.BytesIO(base64.b64decode(one["png"]))) as image:
            assert image.format == "PNG" and min(image.size) > 200
        assert one["title"] and one["caption"].endswith(".")


def test_why_errors_name_the_field(teaching_url: str, files: Files) -> None:
    damaged = files | {"depth": b"damaged"}
    for sent, instance, field in ((files, 4, "instance"), (files, "x", "instance"), (damaged, 3, "depth")):
        check_refused(ask(teaching_url, sent, instance), 422, field)


def ask_why(open_page: Open, url: str, files: Files, answer: Callable[[Route], None]) -> Page:
    """Open the page, whose requests for explanations `answer` answers, and click on "Why?" for object 3."""
    page = open_page(url=url)
    page.route("**/v1/why", answer)
    upload(page, files)
    page.locator('#objects button[data-label="3"]').click()
    page.get_by_role("button", name="Why?").click()
    return page


def test_page_waits_for_an_explanation_and_shows_it(open_page: Open, teaching_url: str, files: Files) -> None:
    requests: list[Route] = []

    def compile_first(route: Route) -> None:
        requests.append(route)
        if len(requests) == 1:
            problem = {"field": None, "message": "Explanations are still being compiled."}
            route.fulfill(status=503, json=problem, headers={"Retry-After": "1"})

    page = ask_why(open_page, teaching_url, files, compile_first)
    expect(page.locator("#why-status")).to_contain_text("still being compiled")
    expect(page.get_by_role("button", name="Why?")).to_be_disabled()
    wait_until(page, lambda: len(requests) == 2)  # the message stays until it is answered
    assert b'name="instance"\r\n\r\n3\r\n' in (requests[1].request.post_data_buffer or b"")
    requests[1].fulfill(json=ANSWER)
    for text in ("2.5", "red +20"):
        expect(page.locator("#why-status")).to_contain_text(text)
    shown = page.locator("#why-pictures canvas")
    expect(shown).to_have_count(2)
    assert [shown.nth(k).evaluate("canvas => canvas.width") for k in (0, 1)] == [600, 300]
    expect(shown.first).to_have_attribute("aria-label", "What decided, on the photo. Orange speaks for a.")
    for width in (1280, 390):
        assert_fits(page, width)
    page.locator('#objects button[data-label="7"]').click()  # the explanation belonged to the other object
    expect(shown).to_have_count(0)
    expect(page.locator("#why-status")).to_have_text("")


def test_page_shows_why_there_is_no_explanation(open_page: Open, teaching_url: str, files: Files) -> None:
    problem = {"field": "instance", "message": "instance 3 cannot be explained."}
    page = ask_why(open_page, teaching_url, files, lambda route: route.fulfill(status=422, json=problem))
    expect(page.locator("#why-status")).to_have_text("instance 3 cannot be explained.")
    expect(page.get_by_role("button", name="Why?")).to_be_enabled()
    page.locator('#objects button[data-label="5"]').click()  # too few points to be described
    expect(page.locator("#why")).to_be_hidden()
