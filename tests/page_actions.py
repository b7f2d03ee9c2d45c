"""Actions on the web page of the service that several test files use."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import processes
from PIL import Image
from playwright.sync_api import Locator, Page, Route

FIELDS = {"color": "image/png", "depth": "image/png", "labels": "image/png", "intrinsics": "application/json"}

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
"""Script that records the tags on the overlay (text and box), `tags`, and the texts in images, `texts`."""


def changed_answers(change: Callable[[Any], None], path: str = "/v1/explain") -> Callable[[Route], None]:
    """Return a route that changes the answers of a path."""

    def handle(route: Route) -> None:
        if path not in route.request.url:
            route.continue_()
            return
        response = route.fetch()
        answer = response.json()
        change(answer)
        route.fulfill(response=response, json=answer)

    return handle


def answered(path: str, **answer: Any) -> Callable[[Route], None]:
    """Return a route that answers the requests of a path in place of the service."""
    return lambda route: route.fulfill(**answer) if route.request.url.endswith(path) else route.continue_()


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


def pixels(canvas: Locator) -> np.ndarray:
    """Return the pixels of a canvas, [H, W, 3]."""
    canvas.scroll_into_view_if_needed()
    return np.asarray(Image.open(io.BytesIO(canvas.screenshot())).convert("RGB")).astype(int)


def assert_fits(page: Page, width: int) -> None:
    """Assert that nothing is wider than a page of some width, and that fingers can hit what can be pressed."""
    page.set_viewport_size({"width": width, "height": 740})
    widest, lefts, rights, heights = page.evaluate(
        """() => {
          const boxes = all => [...document.querySelectorAll(all)].map(one => one.getBoundingClientRect());
          const shown = boxes("button, input, canvas, td, p, #notice");
          const heights = boxes("button, input, summary").map(box => box.height).filter(Boolean);
          const { scrollWidth } = document.documentElement;
          return [scrollWidth, shown.map(box => box.left), shown.map(box => box.right), heights];
        }"""
    )
    assert widest <= width and min(lefts) >= 0 and max(rights) <= width and min(heights) >= 24
