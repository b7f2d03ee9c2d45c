"""Many requests: a soak, a signal in the middle of the work, several workers, and whatever schemathesis thinks of."""

import re
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import hypothesis
import pytest
import schemathesis
from hypothesis import HealthCheck
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

Files = dict[str, bytes]


def memory(pid: int) -> int:
    """KiB of a process and those that it started, shared pages counted once."""
    total, waiting = 0, [pid]
    while waiting:
        folder = Path(f"/proc/{waiting.pop()}")
        for task in (folder / "task").iterdir():
            waiting += map(int, (task / "children").read_text().split())
        total += sum(
            int(line.split()[1]) for line in (folder / "smaps_rollup").read_text().splitlines() if line[:4] == "Pss:"
        )
    return total


def many(url: str, files: Files, count: int, at_once: int) -> Counter[int]:
    """Statuses of `count` requests."""
    with httpx.Client(base_url=url, timeout=60) as client, ThreadPoolExecutor(at_once) as callers:
        return Counter(callers.map(lambda _: client.post("/v1/recognize", files=files).status_code, range(count)))


def counted(url: str) -> int:
    """Frames answered since the service started."""
    found = re.search(
        r'^thor2_requests_total{path="/v1/recognize",status="200"} (.*)$', httpx.get(f"{url}/metrics").text, re.M
    )
    return int(float(found[1])) if found else 0


def test_a_soak_without_errors_and_with_flat_memory(server: Any, files: Files) -> None:
    many(server.url, files, 60, 8)
    before = memory(server.process.pid)
    assert many(server.url, files, 300, 8) == {200: 300}
    assert memory(server.process.pid) - before < 20 * 1024


@pytest.fixture(scope="module")
def narrow(start_server: Callable[..., Any]) -> Any:
    return start_server("--queue", "4")


def test_past_the_queue_there_are_429s_and_no_errors(narrow: Any, files: Files) -> None:
    refused = Counter[int]()

    def until_taken(_: int) -> int:
        while (answer := httpx.post(f"{narrow.url}/v1/recognize", files=files, timeout=60)).status_code == 429:
            assert answer.headers["retry-after"] == "1" and answer.json()["field"] is None
            refused[429] += 1
            time.sleep(0.05)
        return answer.status_code

    with ThreadPoolExecutor(12) as callers:
        assert set(callers.map(until_taken, range(40))) == {200}
    assert refused[429] > 0


def test_a_signal_under_load_leaves_no_request_without_its_answer(narrow: Any, files: Files) -> None:
    before = counted(narrow.url)
    answered: list[int] = []
    broken: list[httpx.TransportError] = []
    stop = threading.Event()

    def caller() -> None:
        while not stop.is_set():
            try:
                answered.append(httpx.post(f"{narrow.url}/v1/recognize", files=files, timeout=60).status_code)
            except httpx.ConnectError:  # nobody listens any more: not taken
                return
            except httpx.TransportError as error:
                broken.append(error)
                return

    callers = [threading.Thread(target=caller) for _ in range(8)]
    for one in callers:
        one.start()
    while answered.count(200) < 10:
        time.sleep(0.01)
    assert narrow.terminate() == 0
    stop.set()
    for one in callers:
        one.join(60)
    log = narrow.log.read_text()
    assert set(answered) <= {200, 429, 503}
    taken = before + answered.count(200)
    assert answered.count(200) >= 10 and f"stopped: {taken} requests taken, {taken} finished" in log, (broken, log)
    assert "Traceback" not in log


@pytest.mark.slow
def test_several_workers_share_a_port_and_their_counters(start_server: Callable[..., Any], files: Files) -> None:
    server = start_server("--workers", "2", "--processes", "1")
    until = time.monotonic() + 240
    while server.log.read_text().count("ready:") < 2:
        assert time.monotonic() < until
        time.sleep(0.1)
    assert many(server.url, files, 60, 8) == {200: 60}
    assert counted(server.url) == 60
    assert "thor2_compilations_after_warm_up_total 0.0" in httpx.get(f"{server.url}/metrics").text.splitlines()
    assert server.terminate() == 0
    finished = [line for line in server.log.read_text().splitlines() if "stopped:" in line]
    assert len(finished) == 2 and sum(int(line.split()[2]) for line in finished) == 60


@pytest.fixture(scope="module")
def document(server: Any) -> Any:
    return schemathesis.openapi.from_url(f"{server.url}/openapi.json")


OPERATIONS = {
    "/v1/recognize": "POST",
    "/v1/explain": "POST",
    "/v1/describe": "POST",
    "/v1/model": "GET",
    "/v1/colornet": "GET",
    "/metrics": "GET",
    "/healthz": "GET",
    "/readyz": "GET",
}


def test_every_operation_of_the_document_is_tried(document: Any) -> None:
    found = [operation.ok() for operation in document.get_all_operations()]
    assert {operation.path: operation.method.upper() for operation in found} == OPERATIONS


@pytest.mark.parametrize("path", OPERATIONS)
def test_no_request_of_the_document_fails(document: Any, path: str) -> None:
    checks = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]

    @hypothesis.settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @hypothesis.given(case=document[path][OPERATIONS[path]].as_strategy())
    def call(case: schemathesis.Case) -> None:
        case.call_and_validate(checks=checks)

    call()
