"""Invalid requests receive a 4xx status whose JSON names the field, and the next valid request is answered."""

import contextlib
import dataclasses
import functools
import io
import json
import socket
import struct
import zipfile
import zlib
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from helpers import deep_png, encode_image, png_file, with_checksums
from PIL import Image
from processes import HANG

from thor2_jax.service.settings import MAX_BODY

Files = dict[str, bytes]


@pytest.fixture(autouse=True)
def check_still_serving(http: httpx.Client, files: Files) -> Iterator[None]:
    yield
    assert http.post("/v1/recognize", files=files).status_code == 200


def check_refused(answer: httpx.Response, status: int, field: str | None, *words: str) -> None:
    assert answer.status_code == status, answer.text
    problem = answer.json()
    assert set(problem) == {"field", "message"} and problem["field"] == field, problem
    for word in words:
        assert word in problem["message"]
    for internal in ("Traceback", "/", "0x", ".py", "Error"):
        assert internal not in problem["message"].replace("application/json", "").replace("multipart/form-data", "")


@pytest.mark.slow  # It waits for the time limit of `thor2 serve`; test_connections.py has the same with short limits.
def test_incomplete_heads_time_out(server: Any) -> None:
    host, port = server.url.removeprefix("http://").split(":")
    whole = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
    heads = (b"", b"GET /healthz HTTP/1.1\r\nHost:", whole + b"GET /healthz HTTP/1.1\r\n")
    with contextlib.ExitStack() as stack:
        connections = []
        for sent in heads:
            connections.append(stack.enter_context(socket.create_connection((host, int(port)), timeout=HANG)))
            connections[-1].sendall(sent)
        for sent, connection in zip(heads, connections, strict=True):
            answer = b""
            while received := connection.recv(4096):
                answer += received
            assert answer.count(b"HTTP/1.1 200") == sent.count(b"\r\n\r\n")


@functools.cache
def png_bomb(width: int, height: int, kind: int = 2, bits: int = 8) -> bytes:
    """PNG whose header declares a large image, with a deflated run of zeros."""
    header = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    data = zlib.compress(bytes(10**7), 9)
    return png_file(with_checksums((b"IHDR", header), (b"IDAT", data), (b"IEND", b"")))


@pytest.mark.parametrize("field", ["color", "depth", "labels"])
def test_damaged_truncated_or_large_images(http: httpx.Client, files: Files, field: str) -> None:
    good = files[field]
    for bad in (b"", b"damaged", good[:20], good[: len(good) // 2], good[:-40]):
        check_refused(http.post("/v1/recognize", files=files | {field: bad}), 422, field)
    for place in range(8, len(good), len(good) // 20):  # Some of these can still be decoded.
        flipped = good[:place] + bytes([good[place] ^ 0xFF]) + good[place + 1 :]
        answer = http.post("/v1/recognize", files=files | {field: flipped})
        assert answer.status_code in (200, 413, 422), answer.text
    for width, height in ((50_000, 50_000), (2**31 - 1, 1), (8000, 8000)):
        answer = http.post("/v1/recognize", files=files | {field: png_bomb(width, height)})
        assert answer.status_code in (413, 422) and answer.json()["field"] == field


def test_images_of_other_modes_and_formats(http: httpx.Client, files: Files, frame: Any) -> None:
    gif = io.BytesIO()
    Image.fromarray(frame.labels).save(gif, "GIF")
    for field, content in (
        ("color", files["labels"]),
        ("color", gif.getvalue()),
        ("depth", files["color"]),
        ("depth", files["labels"]),
        ("labels", files["color"]),
        ("labels", gif.getvalue()),
    ):
        check_refused(http.post("/v1/recognize", files=files | {field: content}), 422, field)
    check_refused(http.post("/v1/recognize", files=files | {"color": deep_png(240, 320)}), 422, "color", "16", "8")


def test_errors_of_all_fields_are_returned(http: httpx.Client, files: Files) -> None:
    answer = http.post("/v1/recognize", files=files | dict.fromkeys(("color", "labels", "intrinsics"), b"damaged"))
    problem = answer.json()
    assert answer.status_code == 422 and problem["field"] == "color"
    assert [error["field"] for error in problem["further"]] == ["labels", "intrinsics"]


def test_images_of_different_sizes(http: httpx.Client, files: Files) -> None:
    for field, kind in (("depth", np.uint16), ("labels", np.uint8)):
        small = encode_image(np.ones((120, 160), kind))
        check_refused(http.post("/v1/recognize", files=files | {field: small}), 422, field, "(120, 160)", "(240, 320)")


def test_too_many_instances(http: httpx.Client, files: Files) -> None:
    many = np.arange(240 * 320).astype(np.uint16).reshape(240, 320)  # 65,535 labels and background.
    check_refused(
        http.post("/v1/recognize", files=files | {"labels": encode_image(many)}), 422, "labels", "65535 instances"
    )


def test_invalid_intrinsics(http: httpx.Client, files: Files) -> None:
    good = json.loads(files["intrinsics"])
    texts = [json.dumps(good | {"fx": value}) for value in (float("nan"), float("inf"), 0, -1, "600", None, [1], True)]
    texts += ["", "{", "[]", "null", "{}", '{"fx": 1e999, "fy": 1, "cx": 0, "cy": 0}', "[" * 2000, '{"fx":' * 500]
    texts += ['{"\\ud800": 1}', "fx: 0x" + "f" * 4000]
    texts += [json.dumps(good | {"fx": 10**400}), '{"fx": ' + "1" * 3000 + ', "fy": 1, "cx": 0, "cy": 0}']
    for text in texts:
        check_refused(http.post("/v1/recognize", files=files | {"intrinsics": text.encode()}), 422, "intrinsics")
    check_refused(http.post("/v1/recognize", files=files | {"intrinsics": b"\xff\xfe\x00"}), 422, "intrinsics")
    check_refused(http.post("/v1/recognize", files=files | {"intrinsics": b" " * 5000}), 413, "intrinsics", "5000")
    for extreme in ({"fx": 1e-300}, {"cx": 1e300}, {"fx": 1e300, "fy": 1e300}, {"depth_scale": 1e-300}):
        answer = http.post("/v1/recognize", files=files | {"intrinsics": json.dumps(good | extreme).encode()})
        assert answer.status_code == 200 or answer.json()["field"] == "intrinsics"


def test_invalid_forms(http: httpx.Client, files: Files) -> None:
    for name in files.keys() - {"labels"}:  # A frame without labels is segmented.
        incomplete = {other: content for other, content in files.items() if other != name}
        check_refused(http.post("/v1/recognize", files=incomplete), 422, name, "missing")
    twice = [*files.items(), ("depth", files["depth"])]
    check_refused(http.post("/v1/recognize", files=twice), 422, "depth", "more than once")
    check_refused(http.post("/v1/recognize", json={"color": "x"}), 415, "body")
    check_refused(http.post("/v1/recognize", content=b"x"), 415, "body")
    for kind in ("multipart/form-data", "multipart/form-data; boundary=", "multipart/form-data; boundary=" + "x" * 500):
        answer = http.post("/v1/recognize", content=b"--x\r\n\r\n", headers={"content-type": kind})
        assert answer.status_code in (400, 422) and answer.json()["field"] in ("body", "color")
    for charset in ("punycode", "idna", "undefined", "raw_unicode_escape", "utf-16", "none"):
        headers = {"content-type": f"multipart/form-data; boundary=x; charset={charset}"}
        check_refused(http.post("/v1/recognize", content=b"--x--\r\n", headers=headers), 415, "body", "utf-8")
    for kind in ("text/plain", "application/x-www-form-urlencoded", ""):
        assert http.post("/v1/describe", content=b"{}", headers={"content-type": kind}).status_code == 415
    many = [(f"part{k}", b"") for k in range(1000)]
    check_refused(http.post("/v1/recognize", files=many), 400, "body")


def test_bodies_over_the_size_limit(http: httpx.Client, files: Files) -> None:
    check_refused(http.post("/v1/recognize", files=files | {"color": bytes(MAX_BODY)}), 413, "body")
    check_refused(http.post("/v1/describe", content=bytes(MAX_BODY + 1), headers=NPZ), 413, "body")

    def endless() -> Iterator[bytes]:  # Sent in chunks without a declared length.
        for _ in range(MAX_BODY // 2**16 + 1):
            yield bytes(2**16)

    check_refused(http.post("/v1/describe", content=endless(), headers=NPZ), 413, "body")


@pytest.fixture
def short_deadline(teaching_app: FastAPI, teaching_url: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """The URL of a service whose requests have half a second; a process has at least one for them."""
    service = teaching_app.state.service
    monkeypatch.setattr(service, "settings", dataclasses.replace(service.settings, deadline=0.5))
    return teaching_url


def test_body_that_never_arrives(short_deadline: str) -> None:
    """The connection times out without affecting others."""
    host, port = short_deadline.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=HANG) as slow:
        slow.sendall(
            b"POST /v1/describe HTTP/1.1\r\nHost: [::1]\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n"
        )
        assert b" 408 " in slow.recv(4096).split(b"\r\n")[0]


NPZ = {"content-type": "application/octet-stream"}


def npz(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


POINTS, COLORS = np.zeros((4, 3), np.float32), np.zeros((4, 3), np.uint8)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"points": np.zeros((4, 3), np.int64)}, "points"),
        ({"points": np.zeros((4, 2), np.float32)}, "points"),
        ({"points": np.zeros(12, np.float32)}, "points"),
        ({"points": np.full((4, 3), np.nan, np.float32)}, "points"),
        ({"points": np.full((4, 3), 1e30, np.float32)}, "points"),
        ({"points": np.array([object()] * 4)}, "points"),
        ({"points": np.array(["a", "b"])}, "points"),
        ({"points": np.zeros(4, [("x", "f4")])}, "points"),
        ({"colors": np.zeros((5, 3), np.uint8)}, "colors"),
        ({"colors": np.zeros((4, 3), np.float32)}, "colors"),
        ({"sizes": np.array([3])}, "sizes"),
        ({"sizes": np.array([5, -1])}, "sizes"),
        ({"sizes": np.array([2**62, 2**62, 2**62, 2**62 + 4])}, "sizes"),
        ({"sizes": np.array([], int)}, "sizes"),
        ({"sizes": np.zeros(1000, int)}, "sizes"),
        ({"sizes": np.array([4.0])}, "sizes"),
        ({"sizes": np.array(4)}, "sizes"),
    ],
)
def test_npz_with_invalid_arrays(http: httpx.Client, change: dict[str, Any], field: str) -> None:
    arrays = {"points": POINTS, "colors": COLORS, "sizes": np.array([4])} | change
    check_refused(http.post("/v1/describe", content=npz(**arrays), headers=NPZ), 422, field)


def test_damaged_npz_and_decompression_bombs(http: httpx.Client) -> None:
    good = npz(points=POINTS, colors=COLORS, sizes=np.array([4]))
    for bad in (b"", b"damaged", good[:100], good[:-30], good[:40] + b"\xff" * 40 + good[80:]):
        answer = http.post("/v1/describe", content=bad, headers=NPZ)
        assert answer.status_code == 422 and answer.json()["field"] in ("body", "points"), answer.text
    check_refused(
        http.post("/v1/describe", content=npz(points=POINTS, colors=COLORS), headers=NPZ), 422, "sizes", "missing"
    )

    bomb = npz(points=np.zeros((MAX_BODY // 12 + 1, 3), np.float32), colors=COLORS, sizes=np.array([4]))
    assert len(bomb) < 10**6
    check_refused(http.post("/v1/describe", content=bomb, headers=NPZ), 413, "body")

    def archive(points: bytes, method: int = zipfile.ZIP_DEFLATED) -> bytes:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", method) as file:
            file.writestr("points.npy", points)
            for name, array in (("colors", COLORS), ("sizes", np.array([4]))):
                with file.open(f"{name}.npy", "w") as entry:
                    np.lib.format.write_array(entry, array)
        return stream.getvalue()

    # The header declares an array that is not there: nothing of that size may be allocated.
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (10**12, 3)})
    check_refused(http.post("/v1/describe", content=archive(header.getvalue()), headers=NPZ), 422, "points")
    deep = b"\x93NUMPY\x01\x00" + struct.pack("<H", 9000) + b"(" * 9000
    check_refused(http.post("/v1/describe", content=archive(deep), headers=NPZ), 422, "points")
    check_refused(http.post("/v1/describe", content=archive(b"", zipfile.ZIP_LZMA), headers=NPZ), 422, "body")

    # The directory declares fewer bytes than the entry decompresses to.
    lying = bytearray(archive(bytes(MAX_BODY + 1)))
    place = lying.rindex(b"PK\x01\x02", 0, lying.rindex(b"points.npy"))
    lying[place + 24 : place + 28] = struct.pack("<I", 1000)
    check_refused(http.post("/v1/describe", content=bytes(lying), headers=NPZ), 422, "points")


@pytest.mark.parametrize(
    ("body", "field"),
    [
        (b"", "body"),
        (b"{", "body"),
        (b"[" * 100_000, "body"),
        (b'{"clouds":' * 10_000, "body"),
        (b"[]", "body"),
        (b"{}", "clouds"),
        (b'{"clouds": []}', "clouds"),
        (b'{"clouds": 3}', "clouds"),
        (b'{"clouds": [{"points": [[0, 0, 0]], "colors": []}]}', "clouds.0.colors"),
        (b'{"clouds": [{"points": [[0, 0, NaN]], "colors": [[0, 0, 0]]}]}', "clouds.0.points.0.2"),
        (b'{"clouds": [{"points": [[0, 0, 1e9]], "colors": [[0, 0, 0]]}]}', "clouds.0.points.0.2"),
        (b'{"clouds": [{"points": [[0, 0]], "colors": [[0, 0, 0]]}]}', "clouds.0.points.0.2"),
        (b'{"clouds": [{"points": [[0, 0, 0]], "colors": [[0, 0, 256]]}]}', "clouds.0.colors.0.2"),
        (b'{"clouds": [{"points": [[0, 0, 0]], "colors": [[0, 0, 0.5]]}]}', "clouds.0.colors.0.2"),
        (b'{"clouds": [{"points": [], "colors": [], "other": 1}]}', "clouds.0.other"),
        (b'{"clouds": [' + b",".join([b'{"points": [], "colors": []}'] * 33) + b"]}", "clouds"),
        (b'{"clouds": [{"points": [' + b",".join([b"[0,0,0]"] * 8193) + b'], "colors": []}]}', "clouds.0.points"),
        (b"\xff\xfe", "body"),
    ],
)
def test_invalid_json_clouds(http: httpx.Client, body: bytes, field: str) -> None:
    answer = http.post("/v1/describe", content=body, headers={"content-type": "application/json"})
    check_refused(answer, 422, field)


def test_slow_frame_is_answered_or_cut_off(short_deadline: str, files: Files) -> None:
    """Noise over the largest image, where every point is a voxel, takes more than a second on most machines."""
    rng = np.random.default_rng(0)
    shape = (1080, 1920)
    images = {
        "color": encode_image(np.zeros((*shape, 3), np.uint8)),
        "depth": encode_image(rng.integers(260, 2500, shape).astype(np.uint16)),
        "labels": encode_image(np.ones(shape, np.uint8)),
    }
    answer = httpx.post(f"{short_deadline}/v1/recognize", files=files | images, timeout=HANG)
    assert answer.status_code in (200, 504)
