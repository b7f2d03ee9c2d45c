"""Time and size limits of request heads, over real sockets with a slow application and short limits."""

import asyncio
import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from processes import HANG

from thor2_jax.service import server as serving

from .conftest import served

WORK = 0.5
HEAD = b"%s /%s HTTP/1.1\r\nHost: localhost\r\n%s\r\n"
SLOW, QUICK = HEAD % (b"GET", b"slow", b""), HEAD % (b"GET", b"", b"")
LAST = HEAD % (b"GET", b"", b"Connection: close\r\n")
CUT = QUICK[:-6]
UPLOAD = HEAD % (b"POST", b"", b"Content-Length: 1000\r\n")


async def application(scope: Any, receive: Any, send: Any) -> None:
    """Answer without reading the body."""
    await asyncio.sleep(WORK if scope["path"] == "/slow" else 0)
    count = 2**23 if scope["path"] == "/large" else 1
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"%d" % (4 * count))]})
    await send({"type": "http.response.body", "body": b"done" * count})


@contextlib.contextmanager
def serve(*sent: bytes) -> Iterator[tuple[Any, list[socket.socket]]]:
    """Serve the application; yield its address, and connections that had sent something before it began."""
    with contextlib.ExitStack() as stack:
        listening = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        address, connections = listening.getsockname(), []
        for content in sent:
            connections.append(stack.enter_context(socket.create_connection(address)))
            connections[-1].sendall(content)
        stack.enter_context(
            served(application, listening, loop="asyncio", http=serving.TimedConnection, lifespan="off")
        )
        yield address, connections


@pytest.fixture
def connection(monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """A connection to the application without time limits."""
    monkeypatch.setattr(serving, "HEAD_SECONDS", HANG)
    monkeypatch.setattr(serving, "EARLY_ANSWER_SECONDS", HANG)
    with serve() as (address, _), socket.create_connection(address, timeout=HANG) as connected:
        yield connected


def until_closed(connection: socket.socket, then: bytes) -> int:
    """Count the answers on a connection until the server closes it; `then` is sent repeatedly."""
    answers = b""
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


def receive_all(connection: socket.socket) -> bytes:
    """Return what the server sends until it closes a connection."""
    return b"".join(iter(lambda: connection.recv(2**16), b""))


def test_truncated_heads_and_slow_bytes_keep_no_connection_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "HEAD_SECONDS", WORK / 2)
    monkeypatch.setattr(serving, "EARLY_ANSWER_SECONDS", WORK)
    cases = {
        **{(CUT, b""): 0, (QUICK + CUT, b""): 1, (SLOW + CUT, b""): 1, (SLOW + SLOW + CUT, b""): 2},
        **{(SLOW + SLOW + QUICK, b""): 3, (b"", b"\r\n"): 0, (QUICK, b""): 1, (QUICK, b"\r\n"): 1, (UPLOAD, b"x"): 1},
    }
    sent, then = zip(*cases, strict=True)
    with serve(*sent) as (_, connections), ThreadPoolExecutor(len(cases)) as clients:
        assert dict(zip(cases, clients.map(until_closed, connections, then), strict=True)) == cases


def test_body_may_arrive_after_its_answer(connection: socket.socket) -> None:
    connection.sendall(UPLOAD)
    while not connection.recv(4096).endswith(b"done"):
        pass
    connection.sendall(bytes(1000) + LAST)
    assert receive_all(connection).count(b"done") == 1


@pytest.mark.parametrize("start", [b"GET /", CUT + b"\r\nX: "])
def test_endless_head_closes_the_connection(connection: socket.socket, start: bytes) -> None:
    with pytest.raises(ConnectionError):
        connection.sendall(start + b"x" * 2**26)


def test_answer_that_is_not_read_closes_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "UNREAD_MS", round(1000 * WORK))
    with serve(HEAD % (b"GET", b"large", b"")) as (_, (connection,)), pytest.raises(ConnectionError):
        for _ in range(round(HANG / WORK)):
            time.sleep(WORK)
            connection.sendall(b"\r\n")


def test_many_pipelined_requests(connection: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    """Together the requests are larger than the limit for one head, which is larger than what is received at once."""
    monkeypatch.setattr(serving, "MAX_HEAD", 2**19)
    count = 2 * serving.MAX_HEAD // len(QUICK)
    threading.Thread(target=connection.sendall, args=(QUICK * (count - 1) + LAST,)).start()
    assert receive_all(connection).count(b"done") == count
