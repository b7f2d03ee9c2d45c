"""Actions on the web page of the service that several test files use."""

from collections.abc import Callable

import processes
from playwright.sync_api import Page

FIELDS = {"color": "image/png", "depth": "image/png", "labels": "image/png", "intrinsics": "application/json"}


def upload(page: Page, files: dict[str, bytes], color_name: str = "color.png") -> None:
    """Upload a frame, which may lack labels, have it recognized, and wait for the answer."""
    if not page.locator("#upload-form").is_visible():
        page.get_by_text("Upload your own frame").click()
    for field, content in files.items():
        name = color_name if field == "color" else field
        page.locator(f"#{field}").set_input_files({"name": name, "mimeType": FIELDS[field], "buffer": content})
    page.get_by_role("button", name="Recognize", exact=True).click()
    wait_for_answer(page)


def wait_for_answer(page: Page) -> None:
    """Wait until no frame is being recognized; expectations look only after 0.1, 0.35, 0.85 and 1.85 seconds."""
    page.wait_for_function("() => !document.querySelector('#status[data-busy]')")


def wait_until(page: Page, condition: Callable[[], bool]) -> None:
    """Wait for something that the handler of a request does."""
    processes.wait_until(condition, pause=lambda seconds: page.wait_for_timeout(1000 * seconds))
