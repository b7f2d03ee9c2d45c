"""Corrections on the web page: masks of frames without labels are dropped, merged and split; objects are named."""

import functools
import io
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from page_actions import answered, assert_fits, changed_answers, upload, wait_for_answer, wait_until
from PIL import Image
from playwright.sync_api import Page, Route, expect
from processes import HANG

import thor2_jax as thor2
from thor2_jax.segmentation.table import segment_table
from thor2_jax.service.pipeline import Service

from .conftest import Files, Open, remove_gallery


def select(page: Page, label: int) -> None:
    page.locator(f'#objects button[data-label="{label}"]').click()


def keep_labels(images: list[np.ndarray]) -> Callable[[Route], None]:
    """Return a route that keeps the label images that the page sends to be recognized."""

    def handle(route: Route) -> None:
        _, found, after = (route.request.post_data_buffer or b"").partition(b'name="labels"')
        if found:
            images.append(np.asarray(Image.open(io.BytesIO(after[after.index(b"\x89PNG") :]))))
        route.continue_()

    return handle


def click(page: Page, x: float, y: float) -> None:
    """Click at a position in pixels of the frame."""
    scale = page.evaluate("overlay.clientWidth") / 320
    page.locator("#overlay").click(position={"x": x * scale, "y": y * scale})


def count(page: Page, objects: int) -> None:
    wait_for_answer(page)
    expect(page.locator("#objects button")).to_have_count(objects)


def test_pieces_are_dropped_restored_and_merged(open_page: Open, unlabelled: Files, scene: thor2.RGBDFrame) -> None:
    sent, labels = list[np.ndarray](), segment_table(scene)
    page = open_page(keep_labels(sent), files=unlabelled)
    count(page, 3)
    expect(page.locator("#masks-title")).to_contain_text("table")
    expect(page.locator("#undo-mask")).to_be_disabled()
    select(page, 2)
    page.get_by_role("button", name="Drop").click()
    count(page, 2)
    np.testing.assert_array_equal(sent[-1], np.where(labels == 2, 0, labels))
    page.get_by_role("button", name="Undo correction").click()
    count(page, 3)
    np.testing.assert_array_equal(sent[-1], labels)
    expect(page.locator("#undo-mask")).to_be_disabled()
    select(page, 3)
    page.get_by_role("button", name="Merge").click()
    expect(page.locator("#merge")).to_have_attribute("aria-pressed", "true")
    y, x = np.argwhere(labels == 1).mean(axis=0)
    click(page, x, y)
    count(page, 2)
    np.testing.assert_array_equal(sent[-1], np.where(labels == 1, 3, labels))
    expect(page.locator('#objects button[aria-pressed="true"]')).to_have_attribute("data-label", "3")
    page.get_by_role("button", name="Merge").click()
    select(page, 2)  # The list is reached by keyboard, too.
    count(page, 1)
    page.get_by_role("button", name="Split").click()
    assert_fits(page, 360)


def test_a_piece_is_split_along_a_cut(open_page: Open, unlabelled: Files, scene: thor2.RGBDFrame) -> None:
    sent, labels = list[np.ndarray](), segment_table(scene)
    page = open_page(keep_labels(sent), size=(1280, 900), files=unlabelled)
    count(page, 3)
    rows, columns = np.nonzero(labels == 1)
    middle = float(np.median(columns))
    select(page, 1)
    page.get_by_role("button", name="Split").click()
    for y in (rows.min(), rows.max()):
        click(page, columns.max() + 9, float(y))  # beside the piece
    expect(page.locator("#masks-hint")).to_contain_text("does not divide")
    for y in (rows.min() - 3, rows.max() + 3):
        click(page, middle, float(y))
    count(page, 4)
    lower, upper = sorted((np.nonzero(sent[-1] == part)[1] for part in (1, 4)), key=np.mean)
    assert lower.max() <= middle + 1 and upper.min() >= middle - 1 and min(len(lower), len(upper)) > 0.3 * len(columns)
    np.testing.assert_array_equal(np.where(sent[-1] == 4, 1, sent[-1]), labels)
    page.get_by_role("button", name="Split").click()
    page.keyboard.press("Escape")
    expect(page.locator("#split")).to_have_attribute("aria-pressed", "false")


def test_labels_are_required_where_the_service_does_not_segment(open_page: Open, unlabelled: Files) -> None:
    page = open_page(changed_answers(lambda model: model.update(segmenter=None), "/v1/model"), files=unlabelled)
    expect(page.locator("#labels-error")).to_have_text("Choose a file.")
    expect(page.locator("#labels-hint")).not_to_contain_text("segmented")


@pytest.fixture
def open_teaching(open_page: Open, teaching_url: str, service: Service) -> Iterator[Open]:
    """Open the page of a service that has no objects enrolled; afterwards, forget what was enrolled."""
    yield functools.partial(open_page, url=teaching_url)
    remove_gallery(service)


@changed_answers
def without_trained_classes(answer: Any) -> None:
    """Answer that objects of trained classes, whose weights are random, are unknown."""
    for one in answer["instances"]:
        if one["name"] in ("a", "b"):
            one.update(name=None, unrecognized="unknown: a confidence of 0.100, below 0.5")


def name_object(page: Page, label: int, name: str) -> None:
    select(page, label)
    page.locator("#name").fill(name)
    page.get_by_role("button", name="Save name").click()


def test_names_and_further_views_are_known_until_undo(open_teaching: Open, files: Files, teaching_url: str) -> None:
    page = open_teaching(without_trained_classes, size=(1280, 900), files=files)
    invitations = page.locator("#objects .facts").filter(has_text="Name this object")
    expect(invitations).to_have_count(3)  # The fourth has too few points.
    select(page, 200)
    expect(page.get_by_label("Name this object")).to_be_focused()
    page.keyboard.type("blue teapot")
    page.keyboard.press("Enter")

    chosen = page.locator('#objects button[aria-pressed="true"]')
    expect(chosen.locator(".name")).to_have_text("blue teapot")
    expect(chosen).to_have_attribute("data-label", "200")
    expect(page.locator("#details-title")).to_have_text("blue teapot")
    expect(page.locator("#notice-text")).to_contain_text("“blue teapot” is enrolled")
    expect(page.locator("#confidence-help")).to_contain_text("enrolled object is the answer if its score is high")
    expect(page.locator("#name-label")).to_have_text("Correct the name")
    expect(page.locator("#classes li").last).to_have_text("blue teapot")

    page.get_by_role("button", name="Undo").click()
    expect(page.locator("#notice-text")).to_contain_text("taken back")
    expect(page.locator("#notice-text")).to_be_focused()
    expect(page.get_by_role("button", name="Undo")).to_be_hidden()
    expect(invitations).to_have_count(3)
    expect(page.locator("#classes li")).to_have_count(2)

    for label, message in ((200, "is enrolled"), (7, "“teapot” has 2 views")):
        name_object(page, label, "teapot")
        expect(page.locator("#notice-text")).to_contain_text(message)
    page.get_by_role("button", name="Undo").click()
    expect(page.locator("#notice-text")).to_contain_text("taken back")
    name_object(page, 7, "teapot")
    expect(page.locator("#notice-text")).to_contain_text("“teapot” has 2 views")
    httpx.delete(f"{teaching_url}/v1/objects/teapot", timeout=HANG)
    page.get_by_role("button", name="Undo").click()
    expect(page.locator("#notice-text")).to_contain_text("Another change")
    expect(page.get_by_role("button", name="Undo")).to_be_hidden()
    upload(page, {})  # The same frame again, by a model without the object.
    expect(page.locator("#status")).to_contain_text("recognizes 2 objects: a, b. Click an object")


def test_what_is_typed_while_the_frame_is_recognized_again_stays(open_teaching: Open, files: Files) -> None:
    waiting: list[Route] = []
    page = open_teaching(files=files)
    page.route("**/v1/explain*", lambda route: waiting.append(route), times=1)  # noqa: PLW0108 -- a built-in cannot be a handler
    name_object(page, 200, "teapot")
    expect(page.locator("#status")).to_contain_text("Recognizing")
    select(page, 7)
    page.locator("#name").fill("cup")
    waiting.pop().continue_()
    expect(page.locator("#status")).not_to_contain_text("Recognizing")
    expect(page.locator('#objects button[aria-pressed="true"]')).to_have_attribute("data-label", "7")
    expect(page.locator("#name")).to_have_value("cup")


def test_naming_does_not_drop_a_frame_that_is_being_recognized(open_teaching: Open, files: Files) -> None:
    waiting: list[Route] = []
    page = open_teaching(files=files)
    page.route("**/v1/*", lambda route: waiting.append(route) if len(waiting) < 2 else route.continue_())
    name_object(page, 200, "teapot")
    page.locator("#samples button").first.click()
    wait_until(page, lambda: len(waiting) == 2)
    waiting[0].continue_()
    expect(page.locator("#notice-text")).to_contain_text("is enrolled")
    waiting[1].continue_()
    expect(page.locator("#status")).to_contain_text(page.locator("#samples button").first.inner_text() + ":")


def test_problems_of_a_name_appear_beside_it(open_teaching: Open, files: Files) -> None:
    page = open_teaching(files=files)
    for name, message in (("  ", "Enter a name."), ("mug\u202egpj", "printable")):
        name_object(page, 200, name)
        expect(page.locator("#name-error")).to_contain_text(message)
        expect(page.locator("#name")).to_have_attribute("aria-invalid", "true")
        expect(page.locator("#name")).to_be_focused()
        expect(page.locator("#notice")).to_be_hidden()
    long = "an_object_with_a_long_name_that_has_no_spaces_and_does_not_end_soon_" + "x" * 60
    name_object(page, 200, long)
    expect(page.locator("#notice-text")).to_contain_text(f"“{long}” is enrolled")
    expect(page.locator("#name-error")).to_be_empty()
    assert_fits(page, 360)
    problem = {"field": None, "message": "The gallery cannot be written; it is as before."}
    page.route("**/v1/objects", answered("/v1/objects", status=507, json=problem), times=1)
    name_object(page, 200, "mug")
    expect(page.locator("#name-error")).to_have_text(problem["message"])
    expect(page.locator("#objects button").first).to_be_visible()
