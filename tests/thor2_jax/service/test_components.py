"""Unit tests of batching, segmenters, request limits and the compilation counter."""

import asyncio
import queue
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock, Mock

import httpx
import jax
import numpy as np
import pytest
from fastapi import FastAPI
from processes import HANG
from service_requests import calls, check_refused

import thor2_jax as thor2
from thor2_jax.service import pipeline, preparation
from thor2_jax.service.app import create_app
from thor2_jax.service.decoding import MAX_BODY
from thor2_jax.service.engine import Batcher
from thor2_jax.service.pipeline import Service
from thor2_jax.service.preparation import PreparedRequest, prepare_frame
from thor2_jax.service.problem import RequestError, field_errors
from thor2_jax.service.schemas import LabelMap
from thor2_jax.service.settings import Settings

from .conftest import Files


def double(numbers: list[int]) -> list[int]:
    if 13 in numbers:
        raise ArithmeticError("thirteen")
    return [2 * n for n in numbers]


def test_waiting_jobs_share_batches_and_close_finishes_them() -> None:
    device, begin = Mock(side_effect=double), threading.Event()
    batcher = Batcher(device, max_batch=4)
    batcher._device.submit(begin.wait, HANG)  # The device is busy while the jobs arrive.
    jobs = [[2, 3], [4], [5, 6, 7, 8, 9, 10], [11], [12, 13, 14, 15], [16]]
    *finished, cancelled, failing, last = [batcher.submit(numbers) for numbers in jobs]
    assert cancelled.cancel()
    begin.set()
    batcher.close()
    assert [job.result(0) for job in (*finished, last)] == [[4, 6], [8], [10, 12, 14, 16, 18, 20], [32]]
    assert isinstance(failing.exception(0), ArithmeticError)
    batches = [[2, 3, 4, 5], [6, 7, 8, 9], [10], [12, 13, 14, 15], [16]]
    assert [call.args for call in device.mock_calls] == [(batch,) for batch in batches]


def many(frame: thor2.RGBDFrame) -> np.ndarray:
    return np.arange(frame.depth.size).reshape(frame.depth.shape)


@pytest.mark.parametrize(
    ("segmenter", "status", "words"),
    [
        (Mock(side_effect=RuntimeError("no\nweights")), 500, "segmenter Mock failed .*RuntimeError: no weights"),
        (Mock(side_effect=SystemExit(3)), 500, "segmenter Mock failed .*SystemExit: 3"),
        (many, 422, "labels has 76799 instances"),
        (None, 422, "labels is missing"),
    ],
)
def test_without_labels_of_a_segmenter_the_request_fails(
    unlabelled: Files, segmenter: Any, status: int, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preparation, "_segmenter", lambda name: segmenter)
    with pytest.raises(RequestError, match=words) as caught:
        prepare_frame(unlabelled, thor2.DescriptorConfig(), False, segmenter and "chosen")
    assert (caught.value.status, caught.value.field) == (status, "labels")


@pytest.fixture(scope="module")
def app(run_dir: Path) -> FastAPI:
    return create_app(Settings(run_dir, token="secret", queue=2, deadline=HANG, teach=True))


def frame_request(files: Files) -> Callable[[httpx.AsyncClient], Any]:
    """Return a function that sends a frame."""
    return lambda client: client.post("/v1/recognize", files=files)


MODEL = Mock(names=(), **{"gallery.summary": "no objects"})
NOTHING = MODEL, PreparedRequest([], {}, LabelMap(width=1, height=1, labels=[0], lengths=[1])), [], []


@pytest.fixture
def recognize(app: FastAPI, monkeypatch: pytest.MonkeyPatch) -> AsyncMock:
    """Stand-in for the recognition of frames in an application that is ready."""
    mock = AsyncMock(return_value=NOTHING)
    monkeypatch.setattr(app.state.service, "state", "ready")
    monkeypatch.setattr(app.state.service, "recognize", mock)
    return mock


PUBLIC = ("/healthz", "/readyz", "/openapi.json", "/", "/app.js", "/samples/index.json", "/samples/clutter/depth.png")


def test_token_is_required_except_for_health_and_page(app: FastAPI) -> None:
    paths = app.openapi()["paths"]
    guarded = {(method.upper(), path) for path in paths if path not in PUBLIC for method in paths[path]}
    assert guarded > {("POST", "/v1/recognize"), ("DELETE", "/v1/objects/{name}")} and len(guarded) == 11
    for method, path in guarded:
        for value in ("", "Bearer", "Bearer wrong", "Basic secret", "Bearer s\xe9cret", "Bearer secret secret"):
            headers = {"Authorization": value.encode("latin-1")}
            (answer,) = calls(app, lambda c, m=method, p=path, h=headers: c.request(m, p, headers=h))
            assert answer.status_code == 401 and answer.headers["www-authenticate"] == "Bearer"
            assert answer.json()["field"] == "Authorization"
    assert calls(app, lambda c: c.get("/v1/model"))[0].status_code == 200
    for answer in calls(app, *(lambda c, p=path: c.get(p) for path in PUBLIC), token=""):
        assert answer.status_code == (503 if answer.url.path == "/readyz" else 200)


def test_requests_are_refused_unless_ready(app: FastAPI, files: Files, monkeypatch: pytest.MonkeyPatch) -> None:
    for state in ("starting", "stopping", "failed"):
        monkeypatch.setattr(app.state.service, "state", state)
        for answer in calls(app, lambda c: c.get("/readyz"), frame_request(files)):
            assert answer.status_code == 503
        assert answer.headers["retry-after"] == "1" and state in answer.json()["message"]


def test_a_warm_up_reports_its_progress_and_counts_later_compilations(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    service = Service(Settings(run_dir, max_batch=16, processes=1))
    compiled = service.metrics.compilations._value
    messages: list[str] = []
    explained: queue.Queue[tuple[int, bool]] = queue.Queue()

    def compile_shape(*_: object) -> None:
        with pytest.raises(RequestError) as error:
            service.check_ready()
        messages.append(error.value.message)
        jax.jit(lambda x: x * len(messages))(1.0)

    monkeypatch.setattr(service.engine, "infer", compile_shape)
    monkeypatch.setattr(pipeline, "compile_explanations", lambda _, *programs: explained.put(programs[:2]))
    with caplog.at_level("INFO"):
        service.start()
        service.wait_until_ready()
        assert compiled.get() == 0
        jax.jit(lambda x: x * 3 + 1)(1.0)
        counted = compiled.get()
        assert [explained.get(timeout=HANG) for _ in range(3)] == [(2048, True), (4096, True), (8192, True)]
        service.close()
    jax.jit(lambda x: x * 5 + 2)(1.0)
    assert compiled.get() == counted >= 1
    for k, message in enumerate(messages, 1):
        assert f"compiling {k} of 6" in message and f"compiling {k} of 6" in caplog.text
    assert len(messages) == 6 and service.metrics.count_ready_workers() == 0


def test_full_queue_is_429_and_deadline_504(
    app: FastAPI, files: Files, recognize: AsyncMock, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused = app.state.service.metrics.requests.labels("/v1/recognize", "429")._value
    timeout = Mock(return_value=asyncio.Timeout(None))

    async def wait_for_refusals(*_: Any) -> Any:
        while refused.get() < 3:
            await asyncio.sleep(0.01)
        return NOTHING

    async def stuck(*_: Any) -> None:
        timeout.return_value.reschedule(0)  # it passes now
        await asyncio.sleep(HANG)

    recognize.side_effect = wait_for_refusals
    answers = calls(app, *[frame_request(files)] * 5)
    assert sorted(answer.status_code for answer in answers) == [200, 200, 429, 429, 429]
    assert all(answer.headers["retry-after"] == "1" for answer in answers if answer.status_code == 429)
    assert calls(app, frame_request(files))[0].status_code == 200  # Finished requests leave the queue.
    recognize.side_effect = asyncio.CancelledError  # by uvicorn, which does not wait longer
    check_refused(calls(app, frame_request(files))[0], 503, None, "stopping")
    recognize.side_effect = stuck
    monkeypatch.setattr(asyncio, "timeout", timeout)
    assert calls(app, frame_request(files))[0].status_code == 504
    timeout.assert_called_once_with(HANG)


@pytest.mark.parametrize(("error", "status"), [(ChildProcessError, 422), (TimeoutError, 504)])
def test_a_body_that_ends_its_process_or_takes_too_long(
    app: FastAPI, files: Files, monkeypatch: pytest.MonkeyPatch, error: type[Exception], status: int
) -> None:
    call = Future[PreparedRequest]()
    call.set_exception(error())
    monkeypatch.setattr(app.state.service, "state", "ready")
    monkeypatch.setattr(app.state.service, "_pool", Mock(**{"submit.return_value": call}), raising=False)
    assert calls(app, frame_request(files))[0].status_code == status


@pytest.mark.parametrize(("adapt", "status"), [(False, 200), (True, 403)])
def test_pages_of_other_sites_do_not_adapt_the_service(
    teaching_run: Path, files: Files, monkeypatch: pytest.MonkeyPatch, adapt: bool, status: int
) -> None:
    app = create_app(Settings(teaching_run, adapt=adapt))
    monkeypatch.setattr(app.state.service, "state", "ready")
    monkeypatch.setattr(app.state.service, "recognize", AsyncMock(return_value=NOTHING))
    for name in ("recognize", "explain"):
        for headers in ({"Sec-Fetch-Site": "cross-site"}, {"Origin": "http://other.example"}, {}):
            (response,) = calls(app, lambda c, n=name, h=headers: c.post(f"/v1/{n}", files=files, headers=h))
            assert response.status_code == (status if headers else 200)


def test_an_object_that_is_forgotten_meanwhile_is_not_enrolled(
    teaching_run: Path, files: Files, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = create_app(Settings(teaching_run, teach=True))
    service, fields = app.state.service, {"name": "gone", "instance": "7"}
    monkeypatch.setattr(service, "state", "ready")
    monkeypatch.setattr(service, "enroll", AsyncMock(return_value=service.engine.objects))
    (answer,) = calls(app, lambda client: client.post("/v1/objects", files=files, data=fields))
    check_refused(answer, 409, "name", "forgotten")


def test_a_list_at_the_end_of_a_message_has_three_dots() -> None:
    with pytest.raises(RequestError) as raised, field_errors():
        raise thor2.InputError("instance is 7; expected one of 1, 2, ...")
    assert raised.value.message == "instance is 7; expected one of 1, 2, ..."


def test_internal_error_hides_its_traceback(app: FastAPI, files: Files, recognize: AsyncMock) -> None:
    recognize.side_effect = RuntimeError("at /some/path")
    check_refused(calls(app, frame_request(files))[0], 500, None)
    assert 'thor2_requests_total{path="/v1/recognize",status="500"} 1.0' in app.state.service.metrics.text().decode()


def test_large_files_stay_in_memory(
    app: FastAPI, files: Files, recognize: AsyncMock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(tempfile.SpooledTemporaryFile, "rollover")  # It would write to a file.
    large = files | {"color": bytes(MAX_BODY - 200_000)}
    assert calls(app, frame_request(large))[0].status_code == 200
    assert recognize.await_args is not None and recognize.await_args.args[0] == large
