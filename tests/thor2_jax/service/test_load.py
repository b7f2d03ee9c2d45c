"""Load tests: a soak, a signal under load, and several workers."""

import contextlib
import os
import re
import signal
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from processes import HANG, wait_until
from slow_tier import slow

from .conftest import Files


def memory(pid: int) -> int:
    """Return the memory of a process and its children in KiB, with shared pages counted once."""
    folder = Path(f"/proc/{pid}")
    own = re.findall(r"^Pss: +(\d+)", (folder / "smaps_rollup").read_text(), re.M)
    children = "".join((task / "children").read_text() for task in (folder / "task").iterdir())
    return int(own[0]) + sum(memory(int(child)) for child in children.split())


def send_many(url: str, files: Files, count: int, at_once: int) -> Counter[int]:
    """Send `count` requests and count their statuses."""
    with httpx.Client(base_url=url, timeout=HANG) as client, ThreadPoolExecutor(at_once) as callers:
        return Counter(callers.map(lambda _: client.post("/v1/recognize", files=files).status_code, range(count)))


def test_soak_without_errors_or_memory_growth(server: Any, files: Files) -> None:
    send_many(server.url, files, 24, 8)
    before = memory(server.process.pid)
    assert send_many(server.url, files, 60, 8) == {200: 60}
    assert memory(server.process.pid) - before < 20 * 1024


@pytest.mark.parametrize("workers", [1, *slow(2)])
@pytest.mark.parametrize("number", [signal.SIGTERM, *slow(signal.SIGINT, signal.SIGHUP)])
def test_signals_answer_accepted_requests(
    number: signal.Signals, workers: int, start_server: Callable[..., Any], files: Files
) -> None:
    """With one worker, explanations are being compiled, which never ends, and the service does not wait for it."""
    options = ("--workers", str(workers), "--processes", "1", "--warm-why")
    server, answered = start_server(*options), list[int]()
    wait_until(lambda: server.log.read_text().count("ready: ") == workers, server.log.read_text)

    def call(_: int) -> None:
        with contextlib.suppress(httpx.TransportError):  # The last request is not accepted: the socket is closed.
            while True:
                answered.append(httpx.post(f"{server.url}/v1/recognize", files=files, timeout=HANG).status_code)

    with ThreadPoolExecutor(8) as clients:
        clients.map(call, range(8))
        wait_until(lambda: answered.count(200) >= 10, server.log.read_text)
        server.process.send_signal(number)
        assert server.process.wait(HANG) == 0
    log = server.log.read_text()
    counts = re.findall(r"stopped: (\d+) requests accepted, (\d+) finished", log)
    assert len(counts) == workers and set(answered) <= {200, 503}
    assert [sum(map(int, numbers)) for numbers in zip(*counts, strict=True)] == [answered.count(200)] * 2
    assert "Traceback" not in log and "ERROR" not in log


@pytest.mark.slow
def test_ready_workers_share_a_port_and_end_with_their_parent(start_server: Callable[..., Any], files: Files) -> None:
    server = start_server("--workers", "2", "--processes", "1")

    def readiness() -> Any:
        return httpx.get(f"{server.url}/readyz", timeout=HANG).raise_for_status().json()

    def count(words: str) -> int:
        return len(re.findall(words, server.log.read_text()))

    wait_until(lambda: count("ready: ") == 2, server.log.read_text)
    assert readiness() == {"status": "ready", "ready_workers": 2, "workers": 2}
    assert send_many(server.url, files, 60, 8) == {200: 60}
    metrics = httpx.get(f"{server.url}/metrics", timeout=HANG).text.splitlines()
    assert 'thor2_requests_total{path="/v1/recognize",status="200"} 60.0' in metrics
    assert {"thor2_compilations_after_warm_up_total 0.0", "thor2_requests_waiting 0.0"} <= set(metrics)
    workers = re.findall(r"Started server process \[(\d+)\]", server.log.read_text())
    os.kill(int(workers[0]), signal.SIGKILL)
    wait_until(lambda: count("Started server process") == 3, server.log.read_text)
    assert count("ready: ") < 3
    while count("ready: ") < 3:
        assert readiness()["ready_workers"] == 1 or count("ready: ") == 3
        assert send_many(server.url, files, 8, 4) == {200: 8}
    wait_until(lambda: readiness()["ready_workers"] == 2, server.log.read_text)
    server.process.kill()  # the workers do not outlive the process that started them
    wait_until(lambda: count("stopped: ") == 2, server.log.read_text)
    with pytest.raises(httpx.TransportError):
        httpx.get(f"{server.url}/healthz")
    assert "Traceback" not in server.log.read_text()
