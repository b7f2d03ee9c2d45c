"""Naming objects on the web page of a service that teaches."""

from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest
from page_actions import answered, assert_fits, changed_answers, upload
from playwright.sync_api import Page, Route, expect

Open = Callable[..., Page]
Files = dict[str, bytes]


@pytest.fixture
def open_teaching(open_page: Open, teaching_url: str) -> Iterator[Open]:
    """Open the page of a service that has no objects enrolled; afterwards, forget what was enrolled."""
    yield lambda *arguments, **options: open_page(*arguments, url=teaching_url, **options)
    for each in httpx.get(f"{teaching_url}/v1/objects").json()["objects"]:
        if not each["trained"]:
            httpx.delete(f"{teaching_url}/v1/objects/{each['name']}")


@changed_answers
def without_trained_classes(answer: Any) -> None:
    """Answer that objects of trained classes, whose weights are random, are unknown."""
    for one in answer["instances"]:
        if one["name"] in ("a", "b"):
            one.update(name=None, unrecognized="unknown: a confidence of 0.100, below 0.5")


def recognize(page: Page, files: Files) -> None:
    upload(page, files)
    expect(page.locator("#objects button")).to_have_count(4)


def name_object(page: Page, label: int, name: str) -> None:
    page.locator(f'#objects button[data-label="{label}"]').click()
    page.locator("#name").fill(name)
    page.get_by_role("button", name="Save name").click()


def test_names_and_further_views_are_known_until_undo(open_teaching: Open, files: Files, teaching_url: str) -> None:
    page = open_teaching(without_trained_classes, size=(1280, 900))
    recognize(page, files)
    invitations = page.locator("#objects .facts").filter(has_text="Name this object")
    expect(invitations).to_have_count(3)  # The fourth has too few points.
    page.locator('#objects button[data-label="200"]').click()
    expect(page.get_by_label("Name this object")).to_be_focused()
    page.keyboard.type("blue teapot")
    page.keyboard.press("Enter")

    chosen = page.locator('#objects button[aria-pressed="true"]')
    expect(chosen.locator(".name")).to_have_text("blue teapot")
    expect(chosen).to_have_attribute("data-label", "200")
    expect(page.locator("#details-title")).to_have_text("blue teapot")
    expect(page.locator("#notice-text")).to_contain_text("“blue teapot” is enrolled")
    expect(page.locator("#name-label")).to_have_text("Correct the name")
    expect(page.locator("#classes li").last).to_have_text("blue teapot")
    listed = httpx.get(f"{teaching_url}/v1/objects").json()["objects"]
    assert [(each["name"], each["views"]) for each in listed][2:] == [("blue teapot", 1)]

    page.get_by_role("button", name="Undo").click()
    expect(page.locator("#notice-text")).to_contain_text("taken back")
    expect(page.get_by_role("button", name="Undo")).to_be_hidden()
    expect(invitations).to_have_count(3)
    expect(page.locator("#classes li")).to_have_count(2)

    for label, message in ((200, "is enrolled"), (7, "“teapot” has 2 views")):
        name_object(page, label, "teapot")
        expect(page.locator("#notice-text")).to_contain_text(message)
    page.get_by_role("button", name="Undo").click()
    expect(page.locator("#notice-text")).to_contain_text("taken back")
    listed = httpx.get(f"{teaching_url}/v1/objects").json()["objects"]
    assert [(each["name"], each["views"]) for each in listed][2:] == [("teapot", 1)]
    name_object(page, 7, "teapot")
    expect(page.locator("#notice-text")).to_contain_text("“teapot” has 2 views")
    httpx.delete(f"{teaching_url}/v1/objects/teapot")
    page.get_by_role("button", name="Undo").click()
    expect(page.locator("#notice-text")).to_contain_text("Another change")
    expect(page.get_by_role("button", name="Undo")).to_be_hidden()


def test_what_is_typed_while_the_frame_is_recognized_again_stays(open_teaching: Open, files: Files) -> None:
    waiting: list[Route] = []
    page = open_teaching()
    recognize(page, files)
    page.route("**/v1/explain*", lambda route: waiting.append(route), times=1)  # noqa: PLW0108 -- a built-in cannot be a handler
    name_object(page, 200, "teapot")
    expect(page.locator("#status")).to_contain_text("Recognizing")
    page.locator('#objects button[data-label="7"]').click()
    page.locator("#name").fill("cup")
    waiting.pop().continue_()
    expect(page.locator("#status")).not_to_contain_text("Recognizing")
    expect(page.locator('#objects button[aria-pressed="true"]')).to_have_attribute("data-label", "7")
    expect(page.locator("#name")).to_have_value("cup")


def test_problems_of_a_name_appear_beside_it(open_teaching: Open, files: Files) -> None:
    page = open_teaching()
    recognize(page, files)
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


def test_errors_of_the_gallery_are_shown(open_teaching: Open, files: Files) -> None:
    problem = {"field": None, "message": "The gallery cannot be written; it is as before."}
    page = open_teaching(answered("/v1/objects", status=507, json=problem))
    recognize(page, files)
    name_object(page, 200, "mug")
    expect(page.locator("#name-error")).to_have_text("The gallery cannot be written; it is as before.")
    expect(page.locator("#objects button").first).to_be_visible()
