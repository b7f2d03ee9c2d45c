"""Batches, processes, limits on requests, and the counter of compilations, each alone."""

import asyncio
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import jax
import jax.numpy as jnp
import pytest
from fastapi import FastAPI
from prometheus_client import CollectorRegistry, Counter

from thor2_jax.client import multipart
from thor2_jax.errors import InputError
from thor2_jax.service.app import create_app
from thor2_jax.service.batching import Batcher
from thor2_jax.service.metrics import CompilationWatch
from thor2_jax.service.preparing import Preparers, prepare_clouds
from thor2_jax.service.problem import RequestError
from thor2_jax.service.settings import MAX_BODY, Settings


class Device:
    """Doubles numbers; waits for leave before each batch."""

    def __init__(self) -> None:
        self.batches: list[list[int]] = []
        self.leave = threading.Semaphore(0)

    def __call__(self, numbers: list[int]) -> list[int]:
        self.leave.acquire()
        self.batches.append(numbers)
        if 13 in numbers:
            raise ArithmeticError("thirteen")
        return [2 * n for n in numbers]


def in_a_while(seconds: float = 60.0) -> float:
    return time.monotonic() + seconds


def test_waiting_jobs_share_batches_and_get_their_own_rows() -> None:
    device = Device()
    batcher = Batcher(device, lambda: 0, max_batch=4, window=0.0)
    first = batcher.submit([1], in_a_while())
    time.sleep(0.1)  # the device has begun with it
    others = [batcher.submit(numbers, in_a_while()) for numbers in ([2, 3], [], [4], [5, 6, 7, 8, 9, 10])]
    device.leave.release(10)
    assert first.result(10) == [2]
    assert [other.result(10) for other in others] == [[4, 6], [], [8], [10, 12, 14, 16, 18, 20]]
    assert device.batches == [[1], [2, 3, 4, 5], [6, 7, 8, 9], [10]]
    batcher.close()


def test_a_batch_waits_for_jobs_that_are_expected_but_not_for_long() -> None:
    device = Device()
    device.leave.release(10)
    batcher = Batcher(device, lambda: 2, max_batch=4, window=0.3)
    first = batcher.submit([1], in_a_while())
    second = batcher.submit([2], in_a_while())
    assert (first.result(10), second.result(10)) == ([2], [4]) and device.batches == [[1, 2]]
    start = time.monotonic()
    assert batcher.submit([3], in_a_while()).result(10) == [6]
    assert 0.25 < time.monotonic() - start < 5
    batcher.close()


def test_late_cancelled_and_failing_jobs_harm_no_others() -> None:
    device = Device()
    batcher = Batcher(device, lambda: 0, max_batch=1, window=0.0)
    first = batcher.submit([1], in_a_while())
    time.sleep(0.1)
    late, cancelled = batcher.submit([2], time.monotonic()), batcher.submit([3], in_a_while())
    failing, last = batcher.submit([13], in_a_while()), batcher.submit([5], in_a_while())
    assert cancelled.cancel()
    device.leave.release(10)
    assert first.result(10) == [2] and last.result(10) == [10]
    with pytest.raises(RequestError) as error:
        late.result(10)
    assert error.value.status == 504
    with pytest.raises(ArithmeticError):
        failing.result(10)
    assert device.batches == [[1], [13], [5]]
    batcher.close()


def test_closing_finishes_what_was_submitted() -> None:
    device = Device()
    batcher = Batcher(device, lambda: 0, max_batch=2, window=0.0)
    jobs = [batcher.submit([n], in_a_while()) for n in range(7)]
    device.leave.release(10)
    batcher.close()
    assert [job.result(0) for job in jobs] == [[2 * n] for n in range(7)]


@pytest.fixture(scope="module")
def preparers() -> Iterator[Preparers]:
    found = Preparers(1)
    yield found
    found.close()


def test_a_process_gives_back_results_and_errors(preparers: Preparers) -> None:
    assert preparers.submit(in_a_while(), math.sqrt, 4.0).result(30) == 2.0
    with pytest.raises(RequestError) as refused:
        preparers.submit(in_a_while(), prepare_clouds, b"nothing", True).result(30)
    assert (refused.value.status, refused.value.field) == (422, "body")
    with pytest.raises(RuntimeError, match="math domain error"):
        preparers.submit(in_a_while(), math.sqrt, -1.0).result(30)


def test_a_process_that_takes_too_long_is_replaced(preparers: Preparers) -> None:
    before = preparers.submit(in_a_while(), os.getpid).result(30)
    start = time.monotonic()
    with pytest.raises(RequestError) as late:
        preparers.submit(in_a_while(0.5), time.sleep, 60).result(30)
    assert late.value.status == 504 and time.monotonic() - start < 20
    after = preparers.submit(in_a_while(), os.getpid).result(30)
    assert after != before
    with pytest.raises(ProcessLookupError):
        os.kill(before, 0)


def test_a_process_that_dies_is_replaced(preparers: Preparers) -> None:
    with pytest.raises(RequestError) as died:
        preparers.submit(in_a_while(), os._exit, 3).result(30)
    assert died.value.status == 422
    pid = preparers.submit(in_a_while(), os.getpid).result(30)
    os.kill(pid, 9)
    time.sleep(0.2)  # while it had nothing to do: nobody notices
    assert preparers.submit(in_a_while(), math.sqrt, 9.0).result(30) == 3.0


def test_compilations_are_counted_between_start_and_stop() -> None:
    counter = Counter("compilations", "Test.", registry=CollectorRegistry())
    watch = CompilationWatch(counter)
    watch.stop()
    watch.start()
    jax.jit(lambda x: x * 3 + 1)(jnp.ones(17)).block_until_ready()
    counted = counter._value.get()
    assert counted >= 1
    jax.jit(jnp.sin).lower(jnp.ones(17))
    watch.stop()
    jax.jit(lambda x: x * 5 + 2)(jnp.ones(19)).block_until_ready()
    assert counter._value.get() >= counted


@pytest.fixture(scope="module")
def app(run_folder: Path) -> FastAPI:
    return create_app(Settings(run_folder, token="secret", queue=2, deadline=0.5))


def calls(app: FastAPI, *requests: Callable[[httpx.AsyncClient], Any]) -> list[httpx.Response]:
    """Answers to requests that are made all at once."""

    async def together() -> list[httpx.Response]:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://x") as client:
            client.headers["Authorization"] = "Bearer secret"
            return await asyncio.gather(*(request(client) for request in requests))

    return asyncio.run(together())


def frame_request(files: dict[str, bytes]) -> Callable[[httpx.AsyncClient], Any]:
    return lambda client: client.post("/v1/recognize", files=files)


def test_the_token_is_needed_for_all_but_health(app: FastAPI) -> None:
    guarded = [("POST", f"/v1/{name}") for name in ("recognize", "explain", "describe")]
    guarded += [("GET", "/v1/model"), ("GET", "/v1/colornet")]
    for method, path in [*guarded, ("GET", "/metrics")]:
        for value in ("", "Bearer", "Bearer wrong", "Basic secret", "Bearer s\xe9cret", "Bearer secret secret"):
            headers = {"Authorization": value.encode("latin-1")}
            (answer,) = calls(app, lambda c, m=method, p=path, h=headers: c.request(m, p, headers=h))
            assert answer.status_code == 401 and answer.headers["www-authenticate"] == "Bearer"
            assert answer.json()["field"] == "Authorization"
    model, health = calls(app, lambda c: c.get("/v1/model"), lambda c: c.get("/healthz", headers={"Authorization": ""}))
    assert model.status_code == 200 and health.status_code == 200


def test_nothing_is_taken_before_it_is_ready_and_while_it_stops(
    app: FastAPI, files: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    for state in ("starting", "stopping", "failed"):
        monkeypatch.setattr(app.state.service, "state", state)
        ready, answer = calls(app, lambda c: c.get("/readyz"), frame_request(files))
        assert ready.status_code == answer.status_code == 503 and answer.headers["retry-after"] == "1"
        assert state in answer.json()["message"]


def test_past_the_queue_it_is_429_and_past_the_deadline_504(
    app: FastAPI, files: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def slow(*_: Any) -> list[Any]:
        await asyncio.sleep(0.2)
        return []

    monkeypatch.setattr(app.state.service, "state", "ready")
    monkeypatch.setattr(app.state.service, "recognize", slow)
    answers = calls(app, *[frame_request(files)] * 5)
    assert sorted(answer.status_code for answer in answers) == [200, 200, 429, 429, 429]
    assert all(answer.headers["retry-after"] == "1" for answer in answers if answer.status_code == 429)
    assert calls(app, frame_request(files))[0].status_code == 200  # places are given back

    async def stuck(*_: Any) -> list[Any]:
        await asyncio.sleep(60)
        return []

    monkeypatch.setattr(app.state.service, "recognize", stuck)
    assert calls(app, frame_request(files))[0].status_code == 504
    assert calls(app, frame_request(files), frame_request(files))[1].status_code == 504


def test_a_defect_is_told_without_its_traceback(
    app: FastAPI, files: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def broken(*_: Any) -> list[Any]:
        raise RuntimeError("at /some/path")

    monkeypatch.setattr(app.state.service, "state", "ready")
    monkeypatch.setattr(app.state.service, "recognize", broken)

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://x") as client:
            return await client.post("/v1/recognize", files=files, headers={"Authorization": "Bearer secret"})

    answer = asyncio.run(ask())
    assert answer.status_code == 500 and answer.json() == {
        "field": None,
        "message": "This is a defect of the service.",
    }
    assert 'thor2_requests_total{path="/v1/recognize",status="500"} 1.0' in app.state.service.metrics.text().decode()


def test_large_files_stay_in_memory(app: FastAPI, files: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    def roll(*_: Any) -> None:
        raise AssertionError("a part of the request went to the disk")

    taken: list[dict[str, bytes]] = []

    async def recognize(given: dict[str, bytes], _: Any) -> list[Any]:
        taken.append(given)
        return []

    monkeypatch.setattr(tempfile.SpooledTemporaryFile, "rollover", roll)
    monkeypatch.setattr(app.state.service, "state", "ready")
    monkeypatch.setattr(app.state.service, "recognize", recognize)
    large = files | {"color": os.urandom(MAX_BODY - 200_000)}
    assert len(multipart(large)[1]) > MAX_BODY - 200_000
    assert calls(app, frame_request(large))[0].status_code == 200
    assert taken == [large]


def test_a_worker_that_died_leaves_no_requests_waiting(tmp_path: Path) -> None:
    """Its other counts stay."""
    worker = "from thor2_jax.service.metrics import Metrics; import os; metrics = Metrics(); "
    died = "metrics.waiting.inc(3); metrics.compilations.inc(2); os._exit(0)"
    said = ""
    for life in (died, "metrics.waiting.inc(1); print(metrics.text().decode())"):
        environment = os.environ | {"PROMETHEUS_MULTIPROC_DIR": str(tmp_path)}
        said = subprocess.run(
            [sys.executable, "-c", worker + life],
            cwd=Path(__file__).parents[3], env=environment, check=True, capture_output=True, text=True,
        ).stdout  # fmt: skip
    assert "thor2_requests_waiting 1.0" in said and "thor2_compilations_after_warm_up_total 2.0" in said


def test_settings_out_of_range_are_refused() -> None:
    for wrong in ({"queue": 0}, {"deadline": 0.0}, {"processes": 0}, {"max_batch": 3}, {"token": ""}, {"token": "é"}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            Settings(Path("run"), **wrong)
