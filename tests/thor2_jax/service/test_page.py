"""The web page in headless Chromium."""

import io
import json
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from image_files import encode_image
from page_actions import FIELDS, answered, assert_fits, changed_answers, upload, wait_for_answer, wait_until
from PIL import Image
from playwright.sync_api import Locator, Page, Route, expect

from .conftest import CLASSES, SAMPLE_INDEX, Files, Open


def choose_sample(page: Page) -> np.ndarray:
    """Recognize the first sample and return its labels."""
    page.locator("#samples button").first.click()
    wait_for_answer(page)
    expect(page.locator("#objects button").first).to_be_visible()
    folder = json.loads(SAMPLE_INDEX.read_text())[0]["folder"]
    return np.asarray(Image.open(SAMPLE_INDEX.parent / folder / "labels.png"))


def pixels(canvas: Locator) -> np.ndarray:
    """Return the pixels of a canvas, [H, W, 3]."""
    canvas.scroll_into_view_if_needed()
    return np.asarray(Image.open(io.BytesIO(canvas.screenshot())).convert("RGB")).astype(int)


RECORD_TEXTS = """() => {
  const { drawImage, roundRect, fillText } = CanvasRenderingContext2D.prototype;
  const recorded = (draw, note) => function (...args) {
    if (this.canvas.id === "overlay") note(args);
    return draw.apply(this, args);
  };
  let box;
  window.texts = new Set();
  Object.assign(CanvasRenderingContext2D.prototype, {
    drawImage: recorded(drawImage, () => { window.tags = []; }),
    roundRect: recorded(roundRect, ([x, y, width, height]) => { box = [x, y, x + width, y + height]; }),
    fillText: function (text, ...args) {
      if (this.canvas.id === "overlay") window.tags.push([text, ...box]);
      if (this.canvas.className === "image") window.texts.add(`${text}`);
      return fillText.call(this, text, ...args);
    },
  });
}"""


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
    assert set(page.locator("#objects .name").all_inner_texts()) <= set(CLASSES)
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
    choose_sample(page)


def test_the_page_shows_that_a_ready_service_has_stopped(open_page: Open) -> None:
    page = open_page()
    expect(page.locator("#ready")).to_have_text("Ready")
    stopping = {"field": None, "message": "The service is stopping."}
    page.route("**/readyz", answered("/readyz", status=503, json=stopping))
    expect(page.locator("#ready")).to_have_text("Stopping")
    page.unroute("**/readyz")
    expect(page.locator("#ready")).to_have_text("Ready")


def test_error_responses_are_shown(open_page: Open) -> None:
    page = open_page()
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


def test_a_phone_shows_all_and_keeps_the_picture(open_page: Open, files: Files) -> None:
    page = open_page(size=(360, 740), phone=True)
    upload(page, {})  # Errors are shown.
    assert_fits(page, 360)
    upload(page, files)
    expect(page.locator("#objects button")).to_have_count(4)
    expect(page.locator("#status")).to_be_in_viewport()
    page.locator('#objects button[data-label="200"]').tap()
    expect(page.locator("#details-title")).to_be_in_viewport()
    expect(page.locator("#details-facts")).to_be_in_viewport(ratio=1)
    expect(page.locator("#answer")).to_contain_text(page.locator("#details-title").inner_text())
    page.evaluate("scrollTo(0, document.documentElement.scrollHeight)")
    for selector in ("#overlay", "#answer"):
        expect(page.locator(selector)).to_be_in_viewport(ratio=1)
    expect(page.locator("#cloud, #classifiers, #slices").first).to_be_hidden()
    assert_fits(page, 360)
    for summary in page.locator("#evidence .fold > summary").all():  # The details are folded on a phone.
        summary.tap()
    expect(page.locator("#slices li").first).to_be_visible()
    assert len(np.unique(pixels(page.locator("#cloud")).reshape(-1, 3), axis=0)) > 20
    assert_fits(page, 360)


def tags_of(page: Page) -> list[tuple[str, np.ndarray]]:
    """Return texts and boxes (left, top, right, bottom) of the overlay's tags, and check that none overlap."""
    tags = page.evaluate("window.tags")
    size = page.evaluate("[overlay.clientWidth, overlay.clientHeight]")
    boxes = np.array([box for _, *box in tags])
    assert (boxes[:, :2] >= 0).all() and (boxes[:, 2:] <= size).all()
    for k, one in enumerate(boxes):
        others = np.delete(boxes, k, axis=0)
        covered = np.minimum(one[2:], others[:, 2:]) - np.maximum(one[:2], others[:, :2])
        assert not (covered > 0).all(axis=1).any(), f"{tags[k][0]} overlaps another tag"
    return [(text, box) for (text, *_), box in zip(tags, boxes, strict=True)]


LONG = "extra_large_clamp"


def test_tags_neither_overlap_nor_hide_small_objects(open_page: Open, files: Files) -> None:
    def with_long_names(answer: Any) -> None:
        for one in answer["instances"]:
            one["name"] = one["name"] and LONG

    page = open_page(changed_answers(with_long_names), size=(360, 740), phone=True)
    page.evaluate(RECORD_TEXTS)
    rows, columns = np.indices((240, 320))
    number = 8 * (rows // 40) + columns // 40 + 1
    is_inside = (abs(rows % 40 - 19.5) < 15) & (abs(columns % 40 - 19.5) < 15)
    upload(page, files | {"labels": encode_image((number * is_inside).astype(np.uint8))})
    expect(page.locator("#objects button")).to_have_count(48)
    tags = tags_of(page)
    numbers = [tag for tag in tags if tag[0].isdigit()]
    assert len(tags) == 48 and len(numbers) > 24 and LONG in {text for text, _ in tags}
    for label, (left, top, right, bottom) in numbers[::10]:
        page.locator("#overlay").tap(position={"x": (left + right) / 2, "y": (top + bottom) / 2})
        chosen = page.locator('#objects button[aria-pressed="true"]')
        expect(chosen).to_have_attribute("data-label", label)
        expect(chosen.locator(".swatch")).to_have_text(label)

    labels = np.zeros((240, 320), np.uint8)
    places = {1: (20, 20), 2: (20, 150), 3: (100, 60), 4: (100, 230), 5: (180, 150)}
    for small, (y, x) in places.items():
        labels[y : y + 16, x : x + 20] = small
    page.unroute("**/v1/**")
    upload(page, files | {"labels": encode_image(labels)})
    expect(page.locator("#objects button")).to_have_count(5)
    tags = tags_of(page)
    assert len(tags) == 5
    for y, x in places.values():
        region = np.array([x, y, x + 20, y + 16]) * page.evaluate("overlay.clientWidth") / 320
        for text, box in tags:
            sides = np.minimum(box[2:], region[2:]) - np.maximum(box[:2], region[:2])
            covered = np.clip(sides, 0, None).prod() / (region[2:] - region[:2]).prod()
            assert covered <= 0.34, f"{text} hides an object"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_contrast_in_both_color_schemes(open_page: Open, scheme: str) -> None:
    page = open_page(scheme=scheme)

    def luminance(name: str) -> float:
        value = page.evaluate(f"getComputedStyle(document.documentElement).getPropertyValue('--{name}').trim()")
        channels = np.array([int(value[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
        return float(linear @ (0.2126, 0.7152, 0.0722))

    assert (luminance("page") > 0.5) == (scheme == "light")
    grounds = {"text": "page card chosen", "muted": "page card chosen", "accent": "card chosen", "on-accent": "accent"}
    for ink, names in {**grounds, "error": "chosen card error-well"}.items():
        for ground in names.split():
            high, low = sorted((luminance(ink), luminance(ground)), reverse=True)
            assert (high + 0.05) / (low + 0.05) >= 4.5, (ink, ground)
