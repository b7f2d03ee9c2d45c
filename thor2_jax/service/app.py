"""The HTTP side: routes, who may call them, and errors as JSON."""

import contextlib
import io
import secrets
import signal
import threading
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from typing import Annotated, Any

import numpy as np
import pydantic_core
from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.responses import JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from thor2_jax.config import DESCRIPTOR_VERSION
from thor2_jax.service import schemas
from thor2_jax.service.answers import instance
from thor2_jax.service.engine import Row
from thor2_jax.service.metrics import RequestCounting
from thor2_jax.service.page_files import PageFiles
from thor2_jax.service.problem import Problem, RequestError, documented
from thor2_jax.service.running import Service
from thor2_jax.service.schemas import NPZ
from thor2_jax.service.settings import Settings
from thor2_jax.service.uploads import read_body, read_form

__all__ = ["create_app"]

FRAME = ("color", "depth", "labels", "intrinsics")
"""Parts of a form that is a frame."""


def create_app(settings: Settings) -> FastAPI:
    """The ASGI application. It owns its processes and threads from its lifespan's start to its end.

    Raises:
        InputError: the run cannot be read, or lacks a classifier.
    """
    service = Service(settings)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await run_in_threadpool(service.start)
        with _told_of_signals(service):
            yield
        await run_in_threadpool(service.close)

    app = FastAPI(
        title="THOR2",
        version="1",
        description="Names the objects of an RGB-D frame with an instance segmentation.",
        lifespan=lifespan,
        docs_url=None,  # its page loads scripts from elsewhere
        redoc_url=None,
    )
    app.state.service = service
    app.add_middleware(RequestCounting, metrics=service.metrics)
    app.include_router(_open_routes(service))
    app.include_router(_guarded_routes(service))
    app.router.default = PageFiles()
    app.add_exception_handler(RequestError, _on_request_error)
    app.add_exception_handler(HTTPException, _on_http_error)
    app.add_exception_handler(ClientDisconnect, _on_disconnect)
    app.add_exception_handler(Exception, _on_defect)
    return app


@contextlib.contextmanager
def _told_of_signals(service: Service) -> Iterator[None]:
    """While the server finishes its connections after a signal, the service already takes nothing more."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

    def stop(number: int, frame: Any) -> None:
        service.stop_taking()
        handler = before[signal.Signals(number)]
        if callable(handler):
            handler(number, frame)

    for number in before:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _open_routes(service: Service) -> APIRouter:
    routes = APIRouter()

    @routes.get("/healthz")
    async def healthz() -> schemas.Health:
        """The process lives."""
        return schemas.Health(status="alive")

    @routes.get("/readyz", responses=documented(503))
    async def readyz() -> schemas.Health:
        """Everything is compiled, and requests are taken."""
        if service.state != "ready":
            raise RequestError(503, None, f"The service is {service.state}.")
        return schemas.Health(status="ready")

    return routes


def _guarded_routes(service: Service) -> APIRouter:
    token = service.settings.token
    guarded = APIRouter(dependencies=[Depends(_check(token))], responses=documented(401)) if token else APIRouter()

    @guarded.post(
        "/v1/recognize",
        responses=documented(400, 408, 413, 415, 422, 429, 503, 504),
        openapi_extra={"requestBody": schemas.FRAME_FORM},
    )
    async def recognize(request: Request) -> schemas.FrameAnswer:
        """Name every instance of a frame."""
        async with service.request() as ticket:
            with ticket.stage("upload"):
                files = await read_form(request, FRAME)
            found = await service.recognize(files, ticket)
        return schemas.FrameAnswer(instances=[instance(one) for one in found], timings=ticket.milliseconds())

    @guarded.post(
        "/v1/explain",
        response_model=schemas.ExplainedFrame,
        responses=documented(400, 408, 413, 415, 422, 429, 503, 504),
        openapi_extra={"requestBody": schemas.FRAME_FORM},
    )
    async def explain(request: Request) -> Response:
        """Name every instance of a frame, and show what the names rest on: clouds, persistence images, colours."""
        async with service.request() as ticket:
            with ticket.stage("upload"):
                files = await read_form(request, FRAME)
            answer = await service.explain(files, ticket)
            content = await run_in_threadpool(answer.model_dump_json)
        return Response(content, media_type="application/json")

    @guarded.post(
        "/v1/describe",
        response_model=schemas.DescribeAnswer,
        responses={
            200: {"content": {NPZ: {"schema": {"type": "string", "format": "binary"}}}},
            **documented(408, 413, 415, 422, 429, 503, 504),
        },
        openapi_extra={"requestBody": schemas.CLOUDS_BODY},
    )
    async def describe(request: Request) -> Response:
        """Descriptors of clouds. The answer has the type of the body: JSON, or npz.

        npz: points [M, 3] floats in metres, colors [M, 3] uint8 and sizes [B], points of each cloud; answered by images
        [B, S, P, P], embeddings [B, S, R, J] and overflow [B].
        """
        kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        if kind not in (NPZ, "application/json"):
            raise RequestError(415, "body", f"The body must be application/json or {NPZ} (npz).")
        async with service.request() as ticket:
            with ticket.stage("upload"):
                content = await read_body(request)
            rows = await service.describe(content, kind == NPZ, ticket)
            if kind == NPZ:
                return Response(await run_in_threadpool(_npz, rows), media_type=NPZ)
            return Response(await run_in_threadpool(_json, rows, ticket.milliseconds()), media_type="application/json")

    @guarded.get("/v1/model")
    async def model() -> schemas.ModelAnswer:
        """What answers here."""
        run = service.engine.run
        return schemas.ModelAnswer(
            classes=list(run.classes),
            classifiers=list(run.classifiers),
            descriptor_version=DESCRIPTOR_VERSION,
            descriptor=pydantic_core.to_jsonable_python(run.config),
            color_network=run.network.fingerprint,
        )

    @guarded.get("/v1/colornet")
    async def colornet() -> schemas.ColorNetworkAnswer:
        """The colour network of the descriptors."""
        network = service.engine.run.network
        arrays = ("mean_rgb", "member_counts", "edges", "edge_weights", "similarity")
        return schemas.ColorNetworkAnswer(
            fingerprint=network.fingerprint, **{name: getattr(network, name).tolist() for name in arrays}
        )

    @guarded.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
    async def metrics() -> Response:
        """Counters for Prometheus."""
        return Response(service.metrics.text(), media_type="text/plain; version=0.0.4; charset=utf-8")

    return guarded


def _check(token: str) -> Callable[..., Any]:
    async def check(
        given: Annotated[HTTPAuthorizationCredentials | None, Depends(HTTPBearer(auto_error=False))],
    ) -> None:
        if given is None or not secrets.compare_digest(given.credentials.encode(), token.encode()):
            raise RequestError(401, "Authorization", "The bearer token is missing or wrong.")

    return check


def _json(rows: Sequence[Row], timings: dict[str, float]) -> bytes:
    descriptors = [
        {"images": row.images.tolist(), "embeddings": row.embeddings.tolist(), "overflow": row.overflow} for row in rows
    ]
    return pydantic_core.to_json({"descriptors": descriptors, "timings": timings})


def _npz(rows: Sequence[Row]) -> bytes:
    stream = io.BytesIO()
    np.savez(
        stream,
        images=np.stack([row.images for row in rows]),
        embeddings=np.stack([row.embeddings for row in rows]),
        overflow=np.array([row.overflow for row in rows], np.int32),
    )
    return stream.getvalue()


def _problem(status: int, problem: Problem, headers: dict[str, str] | None = None) -> JSONResponse:
    return JSONResponse(problem.model_dump(), status, headers)


async def _on_request_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, RequestError)
    headers = {401: {"WWW-Authenticate": "Bearer"}, 429: {"Retry-After": "1"}, 503: {"Retry-After": "1"}}
    return _problem(error.status, Problem(field=error.field, message=error.message), headers.get(error.status))


async def _on_http_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return _problem(error.status_code, Problem(field=None, message=error.detail), dict(error.headers or {}))


async def _on_disconnect(_: Request, error: Exception) -> Response:
    return _problem(400, Problem(field="body", message="The body ended early."))


async def _on_defect(_: Request, error: Exception) -> Response:
    return _problem(500, Problem(field=None, message="This is a defect of the service."))
