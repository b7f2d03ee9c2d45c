"""Explanations of one object over HTTP and on the web page."""

import base64
import io
from collections.abc import Callable

import httpx
import pytest
from page_actions import upload
from PIL import Image
from playwright.sync_api import Page, Route, expect

from thor2_jax.explanation import class_scores

Open = Callable[..., Page]
Files = dict[str, bytes]


@pytest.fixture(autouse=True)
def small_clouds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(class_scores, "MIN_CAPACITY", 512)


def picture(width: int) -> str:
    stream = io.BytesIO()
    Image.new("RGB", (width, 200), "white").save(stream, format="PNG")
    return base64.b64encode(stream.getvalue()).decode()


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


@pytest.mark.slow
def test_why_returns_pictures(teaching_url: str, files: Files) -> None:
    response = httpx.post(f"{teaching_url}/v1/why", files=files, data={"instance": "3"}, timeout=120)
    assert response.status_code == 200
    answer = response.json()
    assert answer["label"] == 3 and answer["explained_name"] in ("a", "b") and answer["unit"] == "log-odds"
    assert set(answer["timings"]) >= {"upload", "decode", "clouds", "explain", "total"}
    assert len(answer["pictures"]) >= 2
    for one in answer["pictures"]:
        with Image.open(io.BytesIO(base64.b64decode(one["png"]))) as image:
            assert image.format == "PNG" and min(image.size) > 200
        assert one["title"] and one["caption"].endswith(".")


def test_why_errors_name_the_field(teaching_url: str, files: Files) -> None:
    for data, field in (
        ({"instance": "4"}, "instance"),
        ({"instance": "5"}, "instance"),
        ({"instance": "x"}, "instance"),
    ):
        response = httpx.post(f"{teaching_url}/v1/why", files=files, data=data, timeout=60)
        assert response.status_code == 422 and response.json()["field"] == field
    damaged = files | {"depth": b"damaged"}
    response = httpx.post(f"{teaching_url}/v1/why", files=damaged, data={"instance": "3"}, timeout=60)
    assert response.status_code == 422 and response.json()["field"] == "depth"


@pytest.mark.parametrize("width", [1280, 390])
def test_page_shows_why(open_page: Open, teaching_url: str, files: Files, width: int) -> None:
    forms = []

    def answer_why(route: Route) -> None:
        if not route.request.url.endswith("/v1/why"):
            route.continue_()
            return
        forms.append(route.request.post_data_buffer)
        route.fulfill(json=ANSWER)

    page = open_page(answer_why, url=teaching_url, viewport={"width": width, "height": 900})
    upload(page, files)
    page.locator('#objects button[data-label="3"]').click()
    page.get_by_role("button", name="Why?").click()
    expect(page.locator("#why-status")).to_contain_text("2.5")
    expect(page.locator("#why-status")).to_contain_text("red +20")
    shown = page.locator("#why-pictures canvas")
    expect(shown).to_have_count(2)
    assert [shown.nth(k).evaluate("canvas => canvas.width") for k in (0, 1)] == [600, 300]
    expect(shown.first).to_have_attribute("aria-label", "What decided, on the photo. Orange speaks for a.")
    assert b'name="instance"\r\n\r\n3\r\n' in forms[0]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.locator('#objects button[data-label="7"]').click()  # the explanation belonged to the other object
    expect(shown).to_have_count(0)
    expect(page.locator("#why-status")).to_have_text("")


def test_page_shows_why_there_is_no_explanation(open_page: Open, teaching_url: str, files: Files) -> None:
    def refuse(route: Route) -> None:
        if route.request.url.endswith("/v1/why"):
            route.fulfill(status=422, json={"field": "instance", "message": "instance 3 cannot be explained."})
        else:
            route.continue_()

    page = open_page(refuse, url=teaching_url)
    upload(page, files)
    page.locator('#objects button[data-label="3"]').click()
    page.get_by_role("button", name="Why?").click()
    expect(page.locator("#why-status")).to_have_text("instance 3 cannot be explained.")
    expect(page.get_by_role("button", name="Why?")).to_be_enabled()
    page.locator('#objects button[data-label="5"]').click()  # too few points to be described
    expect(page.locator("#why")).to_be_hidden()
