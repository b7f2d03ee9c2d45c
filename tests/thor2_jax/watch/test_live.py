"""The live view: pacing, messages, server and page, with a recognizer that knows its answers."""

import base64
import dataclasses
import io
import json
import threading
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, expect
from processes import HANG
from recording_files import table_frame
from refusals import assert_refused

import thor2_jax as thor2
from thor2_jax.errors import InputError
from thor2_jax.frames.frames import RecordedFrame
from thor2_jax.model.recognition import Recognition
from thor2_jax.segmentation.table import segment_table
from thor2_jax.tracking.tracker import TrackedRecognition
from thor2_jax.watch import live
from thor2_jax.watch.live import LONGEST_PAUSE, Broadcast, LiveView, paced, serve_live

SECOND = 10**9


def recorded(seconds: float, read: Any = table_frame) -> RecordedFrame:
    return RecordedFrame(f"{seconds:.3f}", read, round(seconds * SECOND))


def recognize(frame: thor2.RGBDFrame) -> list[Recognition]:
    """Name the first instance `<b>mug</b>`; the others are unknown."""
    names = {frame.instances[0]: "<b>mug</b>"}
    return [
        Recognition(label, names.get(label), 0.9, reason=None if label in names else "unknown: it is")
        for label in frame.instances
    ]


def fail() -> thor2.RGBDFrame:
    raise InputError("depth is missing")


STAMPS = [100 + k / 10 for k in range(10)]


@pytest.mark.parametrize(
    ("stamps", "work", "expected"),
    [
        (STAMPS, [], [(stamp, stamp - 100) for stamp in STAMPS]),
        (STAMPS, [0.25] * 10, [(100, 0), (100.1, 0.25), (100.4, 0.55), (100.7, 0.85)]),
        # However slow the work is, late frames are skipped.
        ([100 + k for k in range(9)], [0, *[LONGEST_PAUSE + 1.5] * 9], [(100, 0), (101, 1), (105, 5)]),
        # A first frame that takes long, as programs are compiled, loses no others.
        (STAMPS, [LONGEST_PAUSE + 5, 0.25], [(100, 0), (100.1, 7), *[(stamp, stamp - 93.1) for stamp in STAMPS[4:]]]),
        # A gap, and time stamps that go back.
        ([100, 100.1, 500, 3, 3.1], [], [(100, 0), (100.1, 0.1), (500, 0.1), (3, 0.1), (3.1, 0.2)]),
    ],
)
def test_recordings_play_at_their_speed(
    stamps: list[float], work: list[float], expected: list[tuple[float, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock stands still, but for sleeping and for the work after each frame."""
    clock, shown, works = [0.0], [], iter(work)

    def sleep(seconds: float) -> None:
        clock[0] += seconds

    monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: clock[0], sleep=sleep))
    for frame in paced(map(recorded, stamps)):
        shown.append(pytest.approx((frame.stamp / SECOND, clock[0])))
        sleep(next(works, 0.0))
    assert shown == expected


def latest(broadcast: Broadcast) -> dict[str, Any]:
    return dict(json.loads(broadcast.wait(0, 0)[1]))


def test_messages_of_a_view() -> None:
    broadcast = Broadcast()
    view = LiveView(recognize, segment_table, broadcast)
    assert latest(broadcast)["state"] == "waiting" and "image" not in latest(broadcast)
    view.show(recorded(1))
    one = latest(broadcast)
    assert (one["state"], one["number"], one["frame"], one["fps"], one["error"]) == ("live", 1, "1.000", None, None)
    assert [(o["label"], o["name"], o["track"]) for o in one["objects"]] == [(1, "<b>mug</b>", None), (2, None, None)]
    assert one["objects"][0]["position"][2] == pytest.approx(0.8, abs=0.01)
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(one["image"]))))
    assert picture.shape == (240, 320, 3)
    for shown, column in zip(one["objects"], (60, 180), strict=True):  # left edges of the boxes
        near = picture[115, column - 3 : column + 4].astype(int) - list(bytes.fromhex(shown["color"][1:]))
        assert np.abs(near).sum(axis=1).min() < 180  # without a line, at least 260
    view.show(recorded(2, fail))
    failed = latest(broadcast)
    assert failed["error"] == "depth is missing" and failed["objects"] == [] and failed["number"] == 1
    assert failed["image"] == one["image"] and failed["fps"] > 0
    view.show(recorded(3, fail))
    assert view.first_error == "2.000: depth is missing"
    view.publish_state("ended", "no more")
    ended = latest(broadcast)
    assert ended["state"] == "ended" and ended["message"] == "no more" and "image" in ended


def test_labels_of_a_frame_are_kept_and_tracks_give_colours() -> None:
    broadcast, labels = Broadcast(), np.zeros((240, 320), np.uint8)
    labels[80:150, 60:110], labels[80:150, 180:250] = 7, 3
    view = LiveView(lambda f: [TrackedRecognition(k, f"{k}", track=2, frames=5) for k in f.instances], fail, broadcast)
    view.show(recorded(1, lambda: dataclasses.replace(table_frame(), labels=labels)))
    objects = latest(broadcast)["objects"]
    assert sorted(one["name"] for one in objects) == ["3", "7"]
    assert {(one["color"], one["frames"]) for one in objects} == {("#f0e442", 5)}


def test_slow_readers_get_the_latest_message() -> None:
    broadcast = Broadcast()
    for k in range(5):
        broadcast.publish(str(k))
    assert broadcast.wait(0, 0) == (5, "4") and broadcast.wait(5, 0) is None
    threading.Timer(0.05, broadcast.publish, ["late"]).start()
    assert broadcast.wait(5, HANG) == (6, "late")


def test_server_serves_its_files_and_events_only() -> None:
    broadcast = Broadcast()
    broadcast.publish('{"a": 1}')
    with (
        serve_live(broadcast, port=0, allow_host=["robot.local"]) as url,
        httpx.Client(base_url=url, timeout=HANG) as client,
    ):
        for path in ("/", "/watch.js", "/watch.css", "/style.css", "/icon.svg"):
            answer = client.get(path)
            assert answer.status_code == 200 and answer.content
            assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        with client.stream("GET", "/events") as events:
            assert next(events.iter_lines()) == 'data: {"a": 1}'
        for path in ("/live.py", "/%2e%2e/live.py", "//etc/passwd", "/page/index.html"):
            assert client.get(path).status_code == 404
        for host, status in (("attacker.example:80", 403), ("localhost:80", 200), ("robot.local:80", 200)):
            assert client.get("/", headers={"Host": host}).status_code == status
        assert_refused("port is", serve_live(broadcast, port=int(url.rpartition(":")[2])).__enter__)


def test_page_shows_frames_and_states(browser: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "KEEP_ALIVE", 0.05)
    broadcast, page, errors = Broadcast(), browser.new_page(), []
    page.set_default_timeout(1000 * HANG)
    view = LiveView(recognize, segment_table, broadcast)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda line: errors.append(line.text))
    with serve_live(broadcast, port=0) as url:
        page.goto(url)
        expect(page.locator("#ready")).to_have_text("Waiting")
        expect(page.locator("#message")).to_contain_text("compiled")
        for k in range(3):
            view.show(recorded(1_700_000_000.5 + k))
        for selector, text in (("ready", "Live"), ("number", "3"), ("frame", "1700000002.500")):
            expect(page.locator(f"#{selector}")).to_have_text(text)
        expect(page.locator("#objects .name")).to_have_text(["<b>mug</b>", "unknown"])
        expect(page.locator("#objects .confidence")).to_have_text(["90 %", "90 %"])
        assert page.locator("#picture").evaluate("image => image.decode().then(() => image.naturalWidth)") == 320
        assert float(page.locator("#fps").inner_text()) > 0
        assert page.locator("#outdated").is_hidden()
        for width in (1280, 390):
            page.set_viewport_size({"width": width, "height": 800})
            assert page.evaluate("document.documentElement.scrollWidth") == width
        view.show(recorded(2, fail))
        expect(page.locator("#problem")).to_have_text("depth is missing")
        expect(page.locator("#none")).to_be_visible()
        assert page.locator("#outdated").is_visible()  # one script call updates the whole page
        assert page.locator("#picture").evaluate("image => getComputedStyle(image).opacity") == "0.4"
        view.publish_state("failed", "the camera was unplugged")
        expect(page.locator("#ready")).to_have_text("Stopped")
        expect(page.locator("#problem")).to_have_text("the camera was unplugged")
        view.show(recorded(3))
        expect(page.locator("#ready")).to_have_text("Live")
        assert page.locator("#outdated").is_hidden()
    expect(page.locator("#ready")).to_have_text("Disconnected")  # the server is gone
    expect(page.locator("#picture")).to_be_visible()
    page.close()
    assert [error for error in errors if "ERR_" not in error] == []
