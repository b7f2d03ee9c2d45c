"""Masks of frames without labels on the web page: they are dropped, merged and split by clicks."""

import io
from collections.abc import Callable

import numpy as np
import pytest
from page_actions import assert_fits, changed_answers, upload, wait_for_answer
from PIL import Image
from playwright.sync_api import Page, Route, expect

import thor2_jax as thor2
from thor2_jax.segmentation.table import segment_table

Open = Callable[..., Page]
Files = dict[str, bytes]


class SentLabels:
    """Route that keeps the label images that the page sends to be recognized."""

    def __init__(self) -> None:
        self.images: list[np.ndarray] = []

    def __call__(self, route: Route) -> None:
        body = route.request.post_data_buffer or b""
        _, found, after = body.partition(b'name="labels"')
        if found:
            image = Image.open(io.BytesIO(after[after.index(b"\x89PNG") :]))
            self.images.append(np.asarray(image))
        route.continue_()


@pytest.fixture
def labels(scene: thor2.RGBDFrame) -> np.ndarray:
    return segment_table(scene)


def click(page: Page, x: float, y: float) -> None:
    """Click at a position in pixels of the frame."""
    scale = page.evaluate("overlay.clientWidth") / 320
    page.locator("#overlay").click(position={"x": x * scale, "y": y * scale})


def count(page: Page, objects: int) -> None:
    wait_for_answer(page)
    expect(page.locator("#objects button")).to_have_count(objects)


def select(page: Page, label: int) -> None:
    page.locator(f'#objects button[data-label="{label}"]').click()


def test_pieces_are_dropped_restored_and_merged(open_page: Open, unlabelled: Files, labels: np.ndarray) -> None:
    sent = SentLabels()
    page = open_page(sent)
    upload(page, unlabelled)
    count(page, 3)
    expect(page.locator("#masks-title")).to_contain_text("table")
    expect(page.locator("#undo-mask")).to_be_disabled()
    select(page, 2)
    page.get_by_role("button", name="Drop").click()
    count(page, 2)
    np.testing.assert_array_equal(sent.images[-1], np.where(labels == 2, 0, labels))
    page.get_by_role("button", name="Undo correction").click()
    count(page, 3)
    np.testing.assert_array_equal(sent.images[-1], labels)
    expect(page.locator("#undo-mask")).to_be_disabled()
    select(page, 3)
    page.get_by_role("button", name="Merge").click()
    expect(page.locator("#merge")).to_have_attribute("aria-pressed", "true")
    y, x = np.argwhere(labels == 1).mean(axis=0)
    click(page, x, y)
    count(page, 2)
    np.testing.assert_array_equal(sent.images[-1], np.where(labels == 1, 3, labels))
    expect(page.locator('#objects button[aria-pressed="true"]')).to_have_attribute("data-label", "3")
    page.get_by_role("button", name="Merge").click()
    select(page, 2)  # The list is reached by keyboard, too.
    count(page, 1)
    page.get_by_role("button", name="Split").click()
    assert_fits(page, 360)


def test_a_piece_is_split_along_a_cut(open_page: Open, unlabelled: Files, labels: np.ndarray) -> None:
    sent = SentLabels()
    page = open_page(sent, size=(1280, 900))
    upload(page, unlabelled)
    count(page, 3)
    label = 1
    rows, columns = np.nonzero(labels == label)
    middle = float(np.median(columns))
    select(page, label)
    page.get_by_role("button", name="Split").click()
    for y in (rows.min(), rows.max()):
        click(page, columns.max() + 9, float(y))  # beside the piece
    expect(page.locator("#masks-hint")).to_contain_text("does not divide")
    for y in (rows.min() - 3, rows.max() + 3):
        click(page, middle, float(y))
    count(page, 4)
    image = sent.images[-1]
    columns_of = {part: np.nonzero(image == part)[1] for part in (label, 4)}
    lower, upper = sorted(columns_of.values(), key=np.mean)
    assert lower.max() <= middle + 1 and upper.min() >= middle - 1 and min(len(lower), len(upper)) > 0.3 * len(columns)
    np.testing.assert_array_equal(np.where(image == 4, label, image), labels)
    page.get_by_role("button", name="Split").click()
    page.keyboard.press("Escape")
    expect(page.locator("#split")).to_have_attribute("aria-pressed", "false")


def test_labels_are_required_where_the_service_does_not_segment(open_page: Open, unlabelled: Files) -> None:
    page = open_page(changed_answers(lambda model: model.update(segmenter=None), "/v1/model"))
    upload(page, unlabelled)
    expect(page.locator("#labels-error")).to_have_text("Choose a file.")
    expect(page.locator("#labels-hint")).not_to_contain_text("segmented")
