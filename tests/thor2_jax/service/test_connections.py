"""Time and size limits of request heads, over real sockets with a slow application and short limits."""

import asyncio
import contextlib
import socket
import struct
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import uvicorn
from processes import HANG

from thor2_jax.service import server as serving
from thor2_jax.service.app import PageFiles

WORK = 1.0
HEAD = b"%s /%s HTTP/1.1\r\nHost: localhost\r\n%s\r\n"
SLOW, QUICK = HEAD % (b"GET", b"slow", b""), HEAD % (b"GET", b"", b"")
LAST = HEAD % (b"GET", b"", b"Connection: close\r\n")
CUT = QUICK[:-6]
UPLOAD = HEAD % (b"POST", b"", b"Content-Length: 1000\r\n")


async def application(scope: Any, receive: Any, send: Any) -> None:
    """Answer without reading the body."""
    if scope["path"] == "/slow":
        await asyncio.sleep(WORK)
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"4")]})
    await send({"type": "http.response.body", "body": b"done"})


@contextlib.contextmanager
def serve(app: Any) -> Iterator[Any]:
    """Serve an application in a thread, and yield its address."""
    config = uvicorn.Config(app, http=serving.TimedConnection, lifespan="off", log_config=None)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        try:
            yield listening.getsockname()
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture
def address(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.setattr(serving, "HEAD_SECONDS", WORK / 4)
    monkeypatch.setattr(serving, "EARLY_ANSWER_SECONDS", WORK)
    with serve(application) as listening_address:
        yield listening_address


def until_closed(address: Any, sent: bytes, then: bytes = b"") -> int:
    """Count the answers on a connection until the server closes it; `then` is sent repeatedly."""
    answers = b""
    with socket.create_connection(address) as connection:
        connection.sendall(sent)
        connection.settimeout(WORK / 20)
        for _ in range(round(HANG / WORK * 20)):
            try:
                received = connection.recv(4096)
            except TimeoutError:
                with contextlib.suppress(ConnectionError):
                    connection.sendall(then)
                continue
            except ConnectionError:
                received = b""
            if not received:
                return answers.count(b"done")
            answers += received
    raise AssertionError("the connection is still open")


@pytest.mark.parametrize(
    ("sent", "answers"),
    [(CUT, 0), (QUICK + CUT, 1), (SLOW + CUT, 1), (SLOW + SLOW + CUT, 2), (SLOW + SLOW + QUICK, 3)],
)
def test_truncated_head_closes_the_connection(address: Any, sent: bytes, answers: int) -> None:
    assert until_closed(address, sent) == answers


@pytest.mark.parametrize(("sent", "then"), [(b"", b"\r\n"), (QUICK, b""), (QUICK, b"\r\n"), (UPLOAD, b"x")])
def test_slow_bytes_do_not_keep_a_connection_open(address: Any, sent: bytes, then: bytes) -> None:
    assert until_closed(address, sent, then) == bool(sent)


def test_body_may_arrive_after_its_answer(address: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "EARLY_ANSWER_SECONDS", HANG)
    with socket.create_connection(address, timeout=HANG) as connection:
        connection.sendall(UPLOAD)
        answers = b""
        while not answers.endswith(b"done"):
            answers += connection.recv(4096)
        connection.sendall(bytes(1000) + QUICK)
        while received := connection.recv(4096):
            answers += received
    assert answers.count(b"done") == 2


@pytest.mark.parametrize("start", [b"GET /", CUT + b"\r\nX: "])
def test_endless_head_closes_the_connection(address: Any, start: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "HEAD_SECONDS", HANG)
    with socket.create_connection(address, timeout=HANG) as connection, pytest.raises(ConnectionError):
        connection.sendall(start)
        for _ in range(64):
            connection.sendall(b"x" * 2**20)


def test_many_pipelined_requests(address: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Together the requests are larger than the limit for one head."""
    monkeypatch.setattr(serving, "HEAD_SECONDS", HANG)
    count = serving.MAX_HEAD // len(QUICK) + 1000
    with socket.create_connection(address, timeout=HANG) as connection:
        threading.Thread(target=connection.sendall, args=(QUICK * (count - 1) + LAST,)).start()
        answers = b""
        while received := connection.recv(2**16):
            answers += received
    assert answers.count(b"done") == count


def test_reset_connections_leave_no_traceback(caplog: pytest.LogCaptureFixture) -> None:
    """Pipelined requests for static files whose client resets the connection while they are answered."""
    with serve(PageFiles()) as address:
        for count in (1, 3, 50) * 4:
            with socket.create_connection(address) as connection:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                connection.sendall(HEAD % (b"GET", b"samples/clutter/color.jpg", b"") * count)
                time.sleep(0.002 * count)
        with socket.create_connection(address, timeout=HANG) as connection:
            connection.sendall(HEAD % (b"GET", b"style.css", b"") * 20 + LAST)
            answers = b""
            while received := connection.recv(2**16):
                answers += received
    assert answers.count(b"HTTP/1.1 200") == 21
    assert not [record for record in caplog.records if record.levelname == "ERROR"]
