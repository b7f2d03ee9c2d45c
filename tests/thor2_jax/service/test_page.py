"""The web page in headless Chromium."""

import json
import re
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from page_actions import FIELDS, RECORD_TEXTS, answered, changed_answers, pixels, upload, wait_for_answer, wait_until
from PIL import Image
from playwright.sync_api import Page, Route, expect

from thor2_jax.frames.frames import encode_image

from .conftest import CLASSES, SAMPLE_INDEX, Files, Open


def choose_sample(page: Page) -> np.ndarray:
    """Recognize the first sample and return its labels."""
    page.locator("#samples button").first.click()
    wait_for_answer(page)
    expect(page.locator("#objects button").first).to_be_visible()
    folder = json.loads(SAMPLE_INDEX.read_text())[0]["folder"]
    return np.asarray(Image.open(SAMPLE_INDEX.parent / folder / "labels.png"))


def test_sample_is_outlined_and_named_with_details(open_page: Open) -> None:
    """Details are visible without scrolling, and those of another object after a click on it."""
    page = open_page(size=(1280, 800))
    expect(page.locator("#ready")).to_have_text("Ready")
    page.evaluate(RECORD_TEXTS)
    labels = choose_sample(page)
    assert page.evaluate("scrollY") == 0
    for selector in ("#overlay", "#details-facts", "#cloud", "#classifiers"):
        expect(page.locator(selector)).to_be_in_viewport(ratio=1)
    assert set(page.evaluate("[...window.texts]")) == {"0", "30", "birth (cm)", "persistence (cm)"}
    buttons, count = page.locator("#objects button"), len(np.unique(labels)) - 1
    expect(buttons).to_have_count(count)
    expect(page.get_by_role("status")).to_contain_text(f"{count} objects")
    names = page.locator("#objects .name bdi").all_inner_texts()
    assert set(names) <= set(CLASSES) and len(names) == count
    assert re.search("\u2068.+\u2069 [<>]?[0-9.]+\u00a0%", " ".join(tag[0] for tag in page.evaluate("window.tags")))
    overlay = page.locator("#overlay")
    drawn = pixels(overlay)
    across = drawn.shape[1] / labels.shape[1]
    assert drawn.shape[0] == pytest.approx(labels.shape[0] * across, abs=2)
    for button in buttons.all():
        swatch = button.locator(".swatch")
        color = swatch.evaluate("one => getComputedStyle(one).backgroundColor.match(/\\d+/g).map(Number)")
        painted = np.argwhere((np.abs(drawn - color) < 12).all(axis=2)) / across
        inside = np.argwhere(labels == int(button.get_attribute("data-label") or 0))
        low, high = inside.min(axis=0) - 4, inside.max(axis=0) + 5
        around = ((painted >= low) & (painted <= high)).all(axis=1).sum() * across**2
        assert around > 2 * (high - low).max(), f"{button} has no outline"
    scale = page.evaluate("overlay.clientWidth") / labels.shape[1]
    chosen = page.locator('#objects button[aria-pressed="true"]')
    for label in (4, 6):
        inside = np.argwhere(labels == label)
        y, x = inside[np.abs(inside - inside.mean(axis=0)).sum(axis=1).argmin()]
        overlay.click(position={"x": float((x + 0.5) * scale), "y": float((y + 0.5) * scale)})
        expect(chosen).to_have_attribute("data-label", str(label))
        expect(page.locator("#details-facts")).to_contain_text(f"Label {label} ")
        expect(page.locator("#details-title")).to_have_text(chosen.locator(".name").inner_text())
    overlay.click(position={"x": 2, "y": 2})  # background
    expect(chosen).to_have_attribute("data-label", "6")

    assert len(np.unique(pixels(page.locator("#cloud")).reshape(-1, 3), axis=0)) > 20
    slices = page.locator("#slices li").count()
    assert 0 < slices < 7
    expect(page.locator("#empty-slices")).to_contain_text("6")
    for kind in (".image", ".strips"):
        canvases = page.locator(f"#slices {kind}")
        expect(canvases).to_have_count(slices)
        assert pixels(canvases.first).std() > 1
        assert all(text.endswith(".") for text in canvases.evaluate_all("all => all.map(one => one.ariaLabel)"))
    tables = page.locator("#classifiers table")
    expect(tables).to_have_count(2)
    for table in tables.all():
        shares = [float(text.strip("<>%\xa0")) for text in table.locator("tr:not(.bar) td").all_inner_texts()]
        assert len(shares) == 5 and shares == sorted(shares, reverse=True)
    expect(page.locator(".badge")).to_have_text("higher probability")
    expect(page.locator("#help")).to_contain_text("Higher probability")


def test_keyboard_navigation(open_page: Open) -> None:
    page = open_page()

    def tab_to(selector: str) -> None:
        for _ in range(30):
            page.keyboard.press("Tab")
            if page.evaluate("selector => document.activeElement.matches(selector)", selector):
                style = "getComputedStyle(document.activeElement)"
                assert page.evaluate(f"{style}.outlineStyle == 'solid' && parseFloat({style}.outlineWidth) >= 2")
                return
        raise AssertionError(f"{selector} cannot be reached by keyboard")

    tab_to("#samples button:nth-child(2)")
    page.keyboard.press("Enter")
    wait_for_answer(page)
    expect(page.locator("#objects button").first).to_be_visible()
    tab_to("#objects li:nth-child(3) button")
    page.keyboard.press("Space")
    expect(page.locator("#objects li:nth-child(3) button")).to_have_attribute("aria-pressed", "true")
    page.reload()
    tab_to("#model-title")
    page.keyboard.press("Enter")
    expect(page.locator("#classes li")).to_have_count(len(CLASSES))


def test_uploaded_frame(open_page: Open, files: Files) -> None:
    def rename(answer: Any) -> None:
        for one in answer["instances"]:
            one["name"] = one["name"] and "mug\u202egpj"

    page = open_page(changed_answers(rename))
    upload(page, files, color_name="<b>x</b>\u202e.png")
    expect(page.get_by_role("status")).to_contain_text("<b>x</b>\\u202e.png: 4 objects, 1 of them unknown.")
    expect(page.locator("#objects .name").first).to_have_text("mug\\u202egpj")
    assert "\u202e" not in page.content()
    expect(page.locator('#samples button[aria-pressed="true"]')).to_have_count(0)
    assert "...." not in page.get_by_role("status").inner_text()  # the list of names ends in dots itself
    small = page.locator('#objects button[data-label="5"]')
    expect(small).to_contain_text("unknown object")
    small.click()
    expect(page.locator("#details-reason")).to_contain_text("30")
    expect(page.locator("#evidence")).to_be_hidden()
    page.locator('#objects button[data-label="7"]').click()
    expect(page.locator("#evidence")).to_be_visible()
    expect(page.locator("#masks")).to_be_hidden()  # The frame came with masks.
    expect(page.locator("#naming")).to_be_hidden()  # The service does not teach.
    expect(page.locator("#objects")).not_to_contain_text("Name this object")


def test_errors_appear_beside_their_fields(open_page: Open, http: httpx.Client, files: Files) -> None:
    page = open_page()
    upload(page, {})
    for field in FIELDS.keys() - {"labels"}:  # A frame without labels is segmented.
        expect(page.locator(f"#{field}-error")).to_have_text("Choose a file.")
    expect(page.locator("#color")).to_be_focused()

    for field in FIELDS:
        bad = files | {field: files["depth" if field == "color" else "color"]}
        upload(page, bad)
        problem = http.post("/v1/explain", files=bad).json()
        assert problem["field"] == field
        expect(page.locator(f"#{field}-error")).to_have_text(problem["message"])
        expect(page.locator(f"#{field}")).to_have_attribute("aria-invalid", "true")
        expect(page.locator(f"#{field}")).to_be_focused()
        assert f"{field}-error" in (page.locator(f"#{field}").get_attribute("aria-describedby") or "")
        expect(page.locator(".error:not(:empty)")).to_have_count(1)
        expect(page.locator("#result")).to_be_hidden()
    upload(page, files | {"color": b"damaged", "depth": files["color"], "intrinsics": b"{}"})
    for field in ("color", "depth", "intrinsics"):
        expect(page.locator(f"#{field}-error")).to_contain_text(field)
    expect(page.locator("#labels-error")).to_be_empty()
    expect(page.locator("#color")).to_be_focused()
    upload(page, files)
    expect(page.locator("#objects button")).to_have_count(4)
    expect(page.locator(".error:not(:empty), [aria-invalid]")).to_have_count(0)


def test_samples_need_a_model_that_knows_their_objects(open_page: Open) -> None:
    def with_classes(*names: str) -> Callable[[Route], None]:
        changes = {"classes": names, "knows": f"{len(names)} objects"}
        return changed_answers(lambda model: model.update(changes), "/v1/model")

    page = open_page(with_classes("camera", "lamp"), samples=0)
    expect(page.locator("#no-samples")).to_be_visible()
    expect(page.locator("#model-title")).to_contain_text("2 objects")
    expect(page.locator("#classes li")).to_have_text(["camera", "lamp"])
    expect(page.locator("#upload-form")).to_be_visible()
    page = open_page(with_classes(*(name for name in CLASSES if name != "hammer")), samples=2)
    expect(page.locator("#no-samples")).to_be_hidden()


def test_page_retries_while_the_service_starts(open_page: Open) -> None:
    unready, held = ["model", "model", "explain"], []
    message = "The service is starting: compiling 3 of 9."

    def starting(route: Route) -> None:
        name = route.request.url.rpartition("/")[2]
        if name in unready:
            unready.remove(name)
            route.fulfill(status=503, headers={"Retry-After": "1"}, json={"field": None, "message": message})
        elif name == "explain":
            held.append(route)
        else:
            route.continue_()

    page = open_page(starting)
    page.locator("#samples button").first.click()
    expect(page.get_by_role("status")).to_contain_text("3 of 9")
    expect(page.get_by_role("alert")).to_be_hidden()
    wait_until(page, lambda: bool(held))  # the retry is held, so that the message stays for the checks
    held.pop().continue_()
    wait_for_answer(page)
    expect(page.locator("#objects button").first).to_be_visible()
    assert unready == held == []


def test_label_images_with_many_lost_and_no_objects(open_page: Open, files: Files) -> None:
    page = open_page()
    rows, columns = np.indices((240, 320))
    upload(page, files | {"labels": encode_image((4 * (rows // 60) + columns // 80 + 1).astype(np.uint8))})
    expect(page.locator("#objects button")).to_have_count(16)
    script = "all => all.map(one => one.style.backgroundColor)"
    assert len(set(page.locator("#objects .swatch").evaluate_all(script))) == 16
    # The label map of this image is subsampled so that the second object disappears.
    upload(page, files | {"labels": encode_image(np.tile(np.array([1, 2], np.uint8), (240, 160)))})
    expect(page.locator("#objects button")).to_have_count(2)
    page.locator('#objects button[data-label="2"]').click()
    expect(page.locator("#details-facts")).to_contain_text("Label 2 ")
    upload(page, files | {"labels": encode_image(np.zeros((240, 320), np.uint8))})
    expect(page.get_by_role("status")).to_contain_text("no objects")
    expect(page.locator("#details")).to_be_hidden()


def test_confidence_is_calibrated_or_said_not_to_be(open_page: Open) -> None:
    calibrated: list[float | None] = [None, 0.87, None, 0.5]  # the last two by an embedding alone

    def change(answer: Any) -> None:
        for one in answer["instances"]:
            one["confidence"], one["details"]["calibrated_confidence"] = 0.99999, calibrated[0]
            if len(calibrated) <= 2:
                one["top"], one["classifier"] = {"embedding": one["top"]["tops"]}, "embedding"
        del calibrated[0]

    page = open_page(changed_answers(change))
    for confidence, remark in ((">99.9\xa0%", " (not calibrated)"), ("87\xa0%", "")):
        choose_sample(page)
        expect(page.locator("#details-facts")).to_contain_text(confidence + remark)
        expect(page.locator("#objects .confidence").first).to_have_text(confidence)
    page.get_by_text("How to read this").click()
    for words in ("calibrated", "geometric mean"):
        expect(page.locator("#confidence-help")).to_contain_text(words)
    for text in ("highest probability; divided by", "highest probability. The embedding"):
        choose_sample(page)
        expect(page.locator("#classifiers h3")).to_have_text(["Embedding: shape and colour"])
        expect(page.locator("#confidence-help")).to_contain_text(text)


def test_page_asks_for_the_token(open_page: Open) -> None:
    problem = {"field": "Authorization", "message": "The bearer token is missing or wrong."}

    def guard(route: Route) -> None:
        has_token = route.request.headers.get("authorization") == "Bearer secret"
        route.continue_() if has_token else route.fulfill(status=401, json=problem)

    page = open_page(guard, samples=0)
    field, error = page.get_by_label("Bearer token"), page.locator("#token-error")
    expect(field).to_be_focused()
    expect(error).to_be_empty()
    for wrong in ("wrong", "“secret”"):  # a header cannot have the second one
        field.fill(wrong)
        field.press("Enter")
        expect(error).to_have_text(problem["message"])
        error.evaluate("one => one.replaceChildren()")
    field.fill("secret")
    page.get_by_role("button", name="Use token").click()
    expect(field).to_be_hidden()
    expect(page.locator("#model-title")).to_be_focused()
    choose_sample(page)


def test_states_and_errors_of_a_ready_service_are_shown(open_page: Open) -> None:
    page = open_page()
    expect(page.locator("#ready")).to_have_text("Ready")
    stopping = {"field": None, "message": "The service is stopping."}
    page.route("**/readyz", answered("/readyz", status=503, json=stopping))
    expect(page.locator("#ready")).to_have_text("Stopping")
    page.unroute("**/readyz")
    expect(page.locator("#ready")).to_have_text("Ready")
    busy = {"field": None, "message": "Too many wait."}
    for answer, message in (
        ({"status": 429, "headers": {"Retry-After": "1"}, "json": busy}, "Too many wait. Try again in a moment."),
        ({"status": 502, "body": "<html>"}, "The service answered with status 502."),
        ({"status": 413, "json": {"field": "body", "message": "The body is too large."}}, "The body is too large."),
    ):
        page.route("**/v1/explain*", answered("/v1/explain", **answer), times=1)
        page.locator("#samples button").first.click()
        expect(page.get_by_role("alert")).to_have_text(message)
        expect(page.locator("#result")).to_be_hidden()
    choose_sample(page)
    expect(page.get_by_role("alert")).to_be_hidden()
