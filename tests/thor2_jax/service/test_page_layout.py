"""Layout and colours of the web page in headless Chromium: telephones, tags of the objects, contrast of texts."""

from typing import Any

import numpy as np
import pytest
from image_files import label_image
from page_actions import RECORD_TEXTS, assert_fits, changed_answers, pixels, upload
from playwright.sync_api import Page, expect

from thor2_jax.frames.frames import encode_image

from .conftest import Files, Open


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

    places = {1: (20, 20), 2: (20, 150), 3: (100, 60), 4: (100, 230), 5: (180, 150)}
    labels = label_image(*((small, y, y + 16, x, x + 20) for small, (y, x) in places.items()))
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
    page = open_page()
    page.emulate_media(color_scheme=scheme)

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
