"""Invalid requests receive a 4xx status whose JSON names the field, and the next valid request is answered."""

import asyncio
import contextlib
import dataclasses
import io
import json
import socket
import struct
import threading
import zipfile
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from failures import Pickled
from image_files import encode_npy, png_of_zeros
from processes import HANG, wait_until
from service_requests import check_refused

from thor2_jax.frames.frames import encode_image
from thor2_jax.service.decoding import MAX_BODY
from thor2_jax.service.pipeline import Service

from .conftest import Files


@pytest.fixture(autouse=True)
def check_still_serving(http: httpx.Client, files: Files) -> Iterator[None]:
    yield
    assert http.post("/v1/recognize", files=files).status_code == 200


def post(http: httpx.Client, files: Files, **changes: bytes) -> httpx.Response:
    return http.post("/v1/recognize", files=files | changes)


@pytest.mark.parametrize("field", ["color", "depth", "labels"])
def test_damaged_truncated_or_large_images(http: httpx.Client, files: Files, field: str) -> None:
    good = files[field]
    for bad in (b"", b"damaged", good[:20], good[: len(good) // 2], good[:-40]):
        check_refused(post(http, files, **{field: bad}), 422, field)
    for place in range(8, len(good), len(good) // 20):  # Some of these can still be decoded.
        flipped = good[:place] + bytes([good[place] ^ 0xFF]) + good[place + 1 :]
        assert post(http, files, **{field: flipped}).status_code in (200, 413, 422)
    for size, status in (((50_000, 50_000), 422), ((2**31 - 1, 1), 422), ((8000, 8000), 413)):
        check_refused(post(http, files, **{field: png_of_zeros(*size)}), status, field)


def test_images_of_other_kinds_and_sizes(http: httpx.Client, files: Files, frame: Any) -> None:
    contents = files | {"gif": encode_image(frame.labels, "GIF")}
    for field, others in {"color": ("labels", "gif"), "depth": ("color", "labels"), "labels": ("color", "gif")}.items():
        for other in others:
            check_refused(post(http, files, **{field: contents[other]}), 422, field)
    check_refused(post(http, files, color=png_of_zeros(320, 240, 16)), 422, "color", "16", "8")
    for field, kind in (("depth", np.uint16), ("labels", np.uint8)):
        small = encode_image(np.ones((120, 160), kind))
        check_refused(post(http, files, **{field: small}), 422, field, "(120, 160)", "(240, 320)")
    many = np.minimum(np.arange(240 * 320), 257).astype(np.uint16).reshape(240, 320)
    check_refused(post(http, files, labels=encode_image(many)), 422, "labels", "257 instances")


def test_invalid_intrinsics(http: httpx.Client, files: Files, unlabelled: Files) -> None:
    good = json.loads(files["intrinsics"])
    texts = "", '{"fx":' * 500, '{"\\ud800": 1}', "fx: 0x" + "f" * 4000, json.dumps(good | {"fx": 10**3000})
    for content in (*map(str.encode, texts), b"\xff\xfe\x00"):
        check_refused(post(http, files, intrinsics=content), 422, "intrinsics")
    check_refused(post(http, files, intrinsics=b" " * 5000), 413, "intrinsics", "5000")
    extremes = {"fx": 1e-300}, {"fx": 1e-9}, {"cx": 1e300}, {"cx": 1e8}, {"fx": 1e300, "fy": 1e300}
    for extreme in (*extremes, {"depth_scale": 1e-300}):
        for frame in (files, unlabelled):
            answer = post(http, frame, intrinsics=json.dumps(good | extreme).encode())
            assert answer.status_code == 200 or answer.json()["field"] == "intrinsics"


def test_invalid_forms(server: Any, http: httpx.Client, files: Files) -> None:
    for name in files.keys() - {"labels"}:  # A frame without labels is segmented.
        incomplete = {other: content for other, content in files.items() if other != name}
        check_refused(post(http, incomplete), 422, name, "missing")
    twice = [*files.items(), ("depth", files["depth"])]
    check_refused(http.post("/v1/recognize", files=twice), 422, "depth", "more than once")
    check_refused(http.post("/v1/recognize", files=[(f"part{k}", b"") for k in range(1000)]), 400, "body")
    mask = {{"labels": "mask"}.get(name, name): content for name, content in files.items()}
    check_refused(post(http, mask), 422, "body", "'mask'", "labels")
    check_refused(http.post("/v1/recognize", json={"color": "x"}), 415, "body")
    for boundary in ("", "; boundary=", "; boundary=" + "x" * 500):
        headers = {"content-type": f"multipart/form-data{boundary}"}
        for content in (b"--x\r\n\r\n", b"damaged"):
            answer = http.post("/v1/recognize", content=content, headers=headers)
            assert answer.status_code in (400, 422) and answer.json()["field"] in ("body", "color")
    assert "boundary" not in server.log.read_text()
    for charset in ("punycode", "undefined", "utf-16", "none"):
        headers = {"content-type": f"multipart/form-data; boundary=x; charset={charset}"}
        check_refused(http.post("/v1/recognize", content=b"--x--\r\n", headers=headers), 415, "body", "utf-8")
    for kind in ("text/plain", ""):
        check_refused(http.post("/v1/describe", content=b"{}", headers={"content-type": kind}), 415, "body")


def test_bodies_over_the_size_limit(http: httpx.Client, files: Files) -> None:
    check_refused(post(http, files, color=bytes(MAX_BODY)), 413, "body")
    endless = (bytes(2**16) for _ in range(MAX_BODY // 2**16 + 1))  # Sent in chunks without a declared length.
    check_refused(http.post("/v1/describe", content=endless, headers=NPZ), 413, "body")


def test_a_request_head_that_is_too_large_ends_its_connection(server: Any) -> None:
    """The command serves with the limits that test_connections.py tests."""
    url = httpx.URL(server.url)
    with socket.create_connection((url.host, url.port), timeout=HANG) as connection:
        with contextlib.suppress(ConnectionError):
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 2**23 + b"\r\n\r\n")
            assert connection.recv(1) == b""


@pytest.mark.parametrize("request_of", ["describe", "why"])
def test_body_that_never_arrives(
    request_of: str, service: Service, teaching_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The connection times out without affecting others, also before explanations, whose deadline is longer."""
    monkeypatch.setattr(service, "settings", dataclasses.replace(service.settings, deadline=0.5))
    url = httpx.URL(teaching_url)
    kind = {"describe": b"application/json", "why": b"multipart/form-data; boundary=x"}[request_of]
    with socket.create_connection((url.host, url.port), timeout=HANG) as slow:
        headers = b"Host: localhost\r\nContent-Type: %b\r\nContent-Length: 9\r\n\r\n" % kind
        slow.sendall(b"POST /v1/%b HTTP/1.1\r\n" % request_of.encode() + headers)
        assert b" 408 " in slow.recv(4096).split(b"\r\n")[0]


def test_a_request_ends_when_its_client_disconnects(
    service: Service, teaching_url: str, files: Files, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It does not occupy the queue until the deadline."""
    begun, dropped = threading.Event(), service.metrics.requests.labels("/v1/recognize", "400")._value

    async def never_end(*_: Any) -> None:
        begun.set()
        await asyncio.Event().wait()

    monkeypatch.setattr(service, "recognize", never_end)
    monkeypatch.setattr(service, "settings", dataclasses.replace(service.settings, deadline=10 * HANG))
    before = dropped.get()
    with pytest.raises(httpx.ReadTimeout):
        httpx.post(f"{teaching_url}/v1/recognize", files=files, timeout=httpx.Timeout(HANG, read=0.2))
    assert begun.wait(HANG)
    wait_until(lambda: service._in_progress == 0)
    wait_until(lambda: dropped.get() == before + 1)


NPZ = {"content-type": "application/octet-stream"}


def npz(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


POINTS, COLORS = np.zeros((4, 3), np.float32), np.zeros((4, 3), np.uint8)


NO_POINTS = [
    *(POINTS.astype(np.int64), POINTS[:, :2], np.full_like(POINTS, np.nan), np.full_like(POINTS, 1e30)),
    *(np.array([Pickled()] * 4), np.array(["a", "b"]), np.zeros(4, [("x", "f4")])),
]
INVALID_ARRAYS = [
    *[("points", array) for array in NO_POINTS],
    *[("colors", array) for array in (np.zeros((5, 3), np.uint8), COLORS.astype(np.float32))],
    *[("sizes", np.array(sizes)) for sizes in ([3], [5, -1], [2**62, 2**62, 2**62, 2**62 + 4], [4.0], 4)],
    *[("sizes", np.zeros(count, int)) for count in (0, 1000)],
]


def test_npz_with_invalid_arrays(http: httpx.Client) -> None:
    for name, array in INVALID_ARRAYS:
        content = npz(**{"points": POINTS, "colors": COLORS, "sizes": np.array([4])} | {name: array})
        check_refused(http.post("/v1/describe", content=content, headers=NPZ), 422, name)


def test_damaged_npz_and_decompression_bombs(http: httpx.Client) -> None:
    good = npz(points=POINTS, colors=COLORS, sizes=np.array([4]))
    for bad in (b"", b"damaged", good[:100], good[:-30], good[:40] + b"\xff" * 40 + good[80:]):
        answer = http.post("/v1/describe", content=bad, headers=NPZ)
        assert answer.status_code == 422 and answer.json()["field"] in ("body", "points"), answer.text
    incomplete = npz(points=POINTS, colors=COLORS)
    check_refused(http.post("/v1/describe", content=incomplete, headers=NPZ), 422, "sizes", "missing")
    bomb = npz(points=np.zeros((MAX_BODY // 12 + 1, 3), np.float32), colors=COLORS, sizes=np.array([4]))
    assert len(bomb) < 10**6
    check_refused(http.post("/v1/describe", content=bomb, headers=NPZ), 413, "body")

    def archive(points: bytes, method: int = zipfile.ZIP_DEFLATED) -> bytes:
        stream = io.BytesIO(npz(colors=COLORS, sizes=np.array([4])))
        with zipfile.ZipFile(stream, "a", method) as file:
            file.writestr("points.npy", points)
        return stream.getvalue()

    # The header declares an array that is not there: nothing of that size may be allocated.
    huge = encode_npy(POINTS).replace(b"(4, 3), }" + b" " * 12, b"(1000000000000, 3), }")
    check_refused(http.post("/v1/describe", content=archive(huge), headers=NPZ), 422, "points")
    deep = b"\x93NUMPY\x01\x00" + struct.pack("<H", 9000) + b"(" * 9000
    check_refused(http.post("/v1/describe", content=archive(deep), headers=NPZ), 422, "points")
    check_refused(http.post("/v1/describe", content=archive(b"", zipfile.ZIP_LZMA), headers=NPZ), 422, "body")

    # The directory declares fewer bytes than the entry decompresses to.
    lying = bytearray(archive(bytes(MAX_BODY + 1)))
    place = lying.rindex(b"PK\x01\x02", 0, lying.rindex(b"points.npy"))
    lying[place + 24 : place + 28] = struct.pack("<I", 1000)
    check_refused(http.post("/v1/describe", content=bytes(lying), headers=NPZ), 422, "points")


def cloud(points: bytes, colors: bytes) -> bytes:
    """Return a body with one cloud, whose points and colours are given in JSON."""
    return b'{"clouds": [{"points": %b, "colors": %b}]}' % (points, colors)


ORIGIN = b"[[0, 0, 0]]"
NO_NUMBERS = b'"1"', b"true", b"null"
INVALID_JSON = [
    *[(body, "body") for body in (b"", b"{", b"[" * 100_000, b'{"clouds":' * 10_000, b"[]", b"\xff\xfe")],
    *[(body, "clouds") for body in (b"{}", b'{"clouds": []}', b'{"clouds": 3}')],
    (b'{"clouds": [' + b",".join([b'{"points": [], "colors": []}'] * 33) + b"]}", "clouds"),
    (cloud(b"[" + b",".join([b"[0,0,0]"] * 8193) + b"]", b"[]"), "clouds.0.points"),
    (cloud(ORIGIN, b"[]"), "clouds.0.colors"),
    *[(cloud(b"[[0, 0, %b]]" % x, ORIGIN), "clouds.0.points.0.2") for x in (b"NaN", b"1e9")],
    (cloud(b"[[0, 0]]", ORIGIN), "clouds.0.points.0.2"),
    *[(cloud(ORIGIN, b"[[0, 0, %b]]" % x), "clouds.0.colors.0.2") for x in (b"256", b"0.5")],
    *[(cloud(b"[[%b, 0, 0]]" % x, ORIGIN), "clouds.0.points.0.0") for x in NO_NUMBERS],
    *[(cloud(ORIGIN, b"[[%b, 0, 0]]" % x), "clouds.0.colors.0.0") for x in NO_NUMBERS],
    (b'{"clouds": [{"points": [], "colors": [], "other": 1}]}', "clouds.0.other"),
]


def test_invalid_json_clouds(http: httpx.Client) -> None:
    for body, field in INVALID_JSON:
        answer = http.post("/v1/describe", content=body, headers={"content-type": "application/json"})
        check_refused(answer, 422, field)
