"""HTTP routes, the page at /, authentication and error responses."""

import contextlib
import io
import secrets
from collections.abc import AsyncIterator, Callable, Sequence
from functools import partial
from typing import Annotated, Any

import numpy as np
import pydantic_core
from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.responses import JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.concurrency import run_in_threadpool
from starlette.convertors import PathConvertor, register_url_convertor
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from thor2_jax.config import DESCRIPTOR_VERSION
from thor2_jax.printable import find_name
from thor2_jax.processes import ended_by_signals
from thor2_jax.service import schemas
from thor2_jax.service.answers import adaptation_answer, explained_frame, instance_answer, object_answers
from thor2_jax.service.decoding import read_body, read_form
from thor2_jax.service.engine import CloudResult
from thor2_jax.service.hosts import is_allowed_host
from thor2_jax.service.metrics import count_requests
from thor2_jax.service.pipeline import Service
from thor2_jax.service.problem import Problem, RequestError, error_responses
from thor2_jax.service.schemas import NPZ
from thor2_jax.service.settings import Settings

__all__ = ["create_app"]

WHY_SECONDS = 90.0
"""Shortest deadline of an explanation, since explanations wait for one another."""

FRAME_ERRORS = error_responses(400, 408, 413, 415, 422, 429, 500, 503, 504)
GALLERY_ERRORS = error_responses(429, 500, 503, 504, 507)


def create_app(settings: Settings, workers: int = 1) -> FastAPI:
    """Create the ASGI application. Its processes and threads run for the duration of its lifespan.

    Args:
        settings: settings of this process.
        workers: number of processes that share a socket. With several, the lifespan starts when this process is ready,
            so that it accepts no connection before; a single process answers with status 503 until then.

    Raises:
        InputError: the run cannot be read.
    """
    service = Service(settings)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        # The handlers of uvicorn would wait until the worker is ready.
        with ended_by_signals() if workers > 1 else contextlib.nullcontext():
            await run_in_threadpool(service.start)
            if workers > 1:
                await run_in_threadpool(service.wait_until_ready)
        yield
        await run_in_threadpool(service.close)

    app = FastAPI(
        title="THOR2",
        version="1",
        description="Recognition of the objects in an RGB-D frame with an instance segmentation.",
        lifespan=lifespan,
        responses=error_responses(403),
        exception_handlers=dict.fromkeys((RequestError, HTTPException, ClientDisconnect, Exception), _on_error),
        docs_url=None,  # The interactive documentation loads scripts from another server.
        redoc_url=None,
    )
    app.state.service = service
    app.add_middleware(check_host, names=settings.allow_host)
    app.add_middleware(count_requests, metrics=service.metrics)
    _add_health_routes(app, service, workers)
    authenticated = APIRouter()
    if settings.token:
        authenticated = APIRouter(dependencies=[Depends(_token_check(settings.token))], responses=error_responses(401))
    _add_inference_routes(authenticated, service)
    _add_model_routes(authenticated, service)
    _add_teaching_routes(authenticated, service)
    app.include_router(authenticated)
    app.router.default = StaticFiles(packages=[("thor2_jax.service", "page")], html=True)
    return app


class _AnyText(PathConvertor):
    regex = "(?s:.*)"  # Names with line breaks are unknown, too; `path` has no route for them.


register_url_convertor("any", _AnyText())


def check_host(app: ASGIApp, names: Sequence[str]) -> ASGIApp:
    """Return ASGI middleware that answers with status 403 unless the header Host names this server."""

    async def checked(scope: Scope, receive: Receive, send: Send) -> None:
        host = Headers(scope=scope).get("host", "") if scope["type"] == "http" else "localhost"
        if is_allowed_host(host, (scope.get("server") or ("",))[0], names):
            await app(scope, receive, send)
        else:
            message = f"Host is {host[:100]!r}; expected localhost, the address, or a name given to --allow-host."
            await _problem_response(RequestError(403, "Host", message))(scope, receive, send)

    return checked


def _add_health_routes(app: FastAPI, service: Service, workers: int) -> None:
    @app.get("/healthz")
    async def healthz() -> schemas.Health:
        """Report that the process is alive."""
        return schemas.Health(status="alive")

    @app.get("/readyz", responses=error_responses(503))
    async def readyz() -> schemas.Readiness:
        """Report whether requests are accepted, and by how many processes; only ready processes receive requests."""
        service.check_ready()
        return schemas.Readiness(status="ready", ready_workers=service.metrics.count_ready_workers(), workers=workers)


def _add_inference_routes(routes: APIRouter, service: Service) -> None:
    of_frame: dict[str, Any] = {"responses": FRAME_ERRORS, "openapi_extra": {"requestBody": schemas.FRAME_FORM}}
    if service.settings.adapt:  # A frame then changes how the next ones are recognized.
        of_frame["dependencies"] = [Depends(_check_same_site)]

    @routes.post("/v1/recognize", **of_frame)
    async def recognize(request: Request) -> schemas.FrameAnswer:
        """Recognize every instance of a frame; a frame without labels is segmented."""
        async with service.admit(request, partial(read_form, form=schemas.FRAME_FORM)) as (admitted, files):
            model, prepared, _, recognitions = await service.recognize(files, admitted)
        return schemas.FrameAnswer(
            instances=[instance_answer(recognition) for recognition in recognitions],
            knows=model.gallery.summary,
            label_map=prepared.label_map,
            adaptation=adaptation_answer(service.engine.adaptation),
            timings=admitted.milliseconds(),
        )

    @routes.post("/v1/explain", response_model=schemas.ExplainedFrame, **of_frame)
    async def explain(request: Request) -> Response:
        """Recognize every instance of a frame and return its cloud, persistence images and colours, too.

        A frame without labels is segmented.
        """
        async with service.admit(request, partial(read_form, form=schemas.FRAME_FORM)) as (admitted, files):
            arguments = *await service.recognize(files, admitted, with_label_map=True), admitted.milliseconds()
            content = await run_in_threadpool(lambda: explained_frame(*arguments).model_dump_json())
        return Response(content, media_type="application/json")

    @routes.post("/v1/why", responses=FRAME_ERRORS, openapi_extra={"requestBody": schemas.WHY_FORM})
    async def why(request: Request) -> schemas.WhyAnswer:
        """Explain the answer for one instance: the attributions of points, and the smallest changes to another answer.

        The status is 503 until explanations of clouds of this size are compiled; this begins after the start.
        """
        async with service.admit(request, partial(read_form, form=schemas.WHY_FORM), WHY_SECONDS) as (admitted, files):
            return await service.why(files, admitted)

    responses = {200: {"content": {NPZ: schemas.ARRAYS}}, **error_responses(408, 413, 415, 422, 429, 503, 504)}
    body = {"requestBody": schemas.CLOUDS_BODY}

    @routes.post("/v1/describe", response_model=schemas.DescribeAnswer, responses=responses, openapi_extra=body)
    async def describe(request: Request) -> Response:
        """Compute the descriptors of clouds. The answer has the content type of the body: JSON or npz.

        An npz body has the arrays points [M, 3] float (metres), colors [M, 3] uint8 and sizes [B] (points per cloud);
        the answer has images [B, S, P, P], embeddings [B, S, R, J] and overflow [B].
        """
        content_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        if content_type not in (NPZ, "application/json"):
            raise RequestError(415, "body", f"The body must be application/json or {NPZ} (npz).")
        async with service.admit(request, read_body) as (admitted, content):
            results = await service.describe(content, content_type == NPZ, admitted)
            encode = _encode_npz if content_type == NPZ else partial(_encode_json, timings=admitted.milliseconds())
            return Response(await run_in_threadpool(encode, results), media_type=content_type)


def _add_model_routes(routes: APIRouter, service: Service) -> None:
    @routes.get("/v1/model")
    async def model() -> schemas.ModelAnswer:
        """Return the classes and the configuration of the model."""
        service.engine.refresh()
        current, run = service.engine.model, service.engine.model.run
        return schemas.ModelAnswer(
            classes=list(current.names),
            knows=current.gallery.summary,
            classifiers=list(current.classifiers),
            descriptor_version=DESCRIPTOR_VERSION,
            descriptor=pydantic_core.to_jsonable_python(run.config),
            color_network=run.network.fingerprint,
            teaches=service.settings.teach,
            segmenter=service.settings.segmenter,
        )

    @routes.get("/v1/colornet")
    async def colornet() -> schemas.ColorNetworkAnswer:
        """Return the colour network of the descriptors."""
        network = service.engine.model.run.network
        names = ("mean_rgb", "member_counts", "edges", "edge_weights", "similarity")
        arrays = {name: getattr(network, name).tolist() for name in names}
        return schemas.ColorNetworkAnswer(fingerprint=network.fingerprint, **arrays)

    @routes.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
    async def metrics() -> Response:
        """Return the metrics in the Prometheus text format."""
        return Response(service.metrics.text(), media_type="text/plain; version=0.0.4; charset=utf-8")

    @routes.get("/v1/objects", responses=error_responses(500, 507))
    async def objects() -> schemas.ObjectsAnswer:
        """Return the objects that the model can recognize, with their views."""
        known = service.known_objects()
        return schemas.ObjectsAnswer(objects=object_answers(known), generation=known.gallery.generation)


def _add_teaching_routes(authenticated: APIRouter, service: Service) -> None:
    async def check_teaches() -> None:
        if not service.settings.teach:
            raise RequestError(403, None, "Enrolling is disabled; start the service with `thor2 serve --teach`.")

    guards = [Depends(check_teaches), Depends(_check_same_site)]
    routes = APIRouter(dependencies=guards, include_in_schema=service.settings.teach)

    @routes.post(
        "/v1/objects",
        responses=FRAME_ERRORS | GALLERY_ERRORS | error_responses(409),
        openapi_extra={"requestBody": schemas.ENROLLMENT_FORM},
    )
    async def enroll(request: Request) -> schemas.EnrollmentAnswer:
        """Enroll an object from one instance of a frame; all processes recognize it from now on.

        For a name that exists, set extend or replace.
        """
        async with service.admit(request, partial(read_form, form=schemas.ENROLLMENT_FORM)) as (admitted, files):
            known = await service.enroll(files, admitted)
        stored_name = find_name(files["name"], known.gallery.names)
        enrolled = next((answer for answer in object_answers(known) if answer.name == stored_name), None)
        if enrolled is None:
            raise RequestError(409, "name", "The object was forgotten meanwhile; enroll it again.")
        return schemas.EnrollmentAnswer(
            **dict(enrolled), generation=known.gallery.generation, timings=admitted.milliseconds()
        )

    @routes.post(
        "/v1/objects/undo",
        responses=GALLERY_ERRORS | error_responses(400, 408, 409, 413, 415, 422),
        openapi_extra={"requestBody": schemas.UNDO_FORM},
    )
    async def undo(request: Request) -> schemas.ChangeAnswer:
        """Undo the last change of the gallery, unless it has changed again since then."""
        async with service.admit(request, partial(read_form, form=schemas.UNDO_FORM)) as (admitted, files):
            known = await service.change(lambda objects: objects.undo(files["generation"]), 409, "generation", admitted)
        return schemas.ChangeAnswer(generation=known.gallery.generation)

    @routes.delete("/v1/objects/{name:any}", responses=GALLERY_ERRORS | error_responses(404, 408, 413, 422))
    async def forget(request: Request, name: str) -> schemas.ChangeAnswer:
        """Forget an object: remove its views; a trained class is no longer predicted."""
        async with service.admit(request, read_body) as (admitted, _):
            known = await service.change(lambda objects: objects.forget(name), 404, "name", admitted)
        return schemas.ChangeAnswer(generation=known.gallery.generation)

    authenticated.include_router(routes)


async def _check_same_site(request: Request) -> None:
    """Raise RequestError (403) if a web page of another site sent the request, which browsers allow."""
    site, origin = request.headers.get("sec-fetch-site"), request.headers.get("origin")
    if site is None:  # Browsers send this header only to https and to localhost.
        site = "none" if origin is None or origin.partition("://")[2] == request.headers.get("host") else "cross-site"
    if site not in ("same-origin", "none"):
        raise RequestError(403, "Origin", "The request comes from a web page of another site.")


def _token_check(token: str) -> Callable[..., Any]:
    async def check(
        credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(HTTPBearer(auto_error=False))],
    ) -> None:
        if credentials is None or not secrets.compare_digest(credentials.credentials.encode(), token.encode()):
            raise RequestError(401, "Authorization")

    return check


def _encode_json(results: Sequence[CloudResult], timings: dict[str, float]) -> bytes:
    descriptors = [
        {"images": r.images.tolist(), "embeddings": r.embeddings.tolist(), "overflow": int(r.inference.overflow)}
        for r in results
    ]
    return pydantic_core.to_json({"descriptors": descriptors, "timings": timings})


def _encode_npz(results: Sequence[CloudResult]) -> bytes:
    stream = io.BytesIO()
    np.savez(
        stream,
        images=np.stack([r.images for r in results]),
        embeddings=np.stack([r.embeddings for r in results]),
        overflow=np.array([r.inference.overflow for r in results], np.int32),
    )
    return stream.getvalue()


async def _on_error(_: Request, error: Exception) -> Response:
    if isinstance(error, HTTPException):
        return _problem_response(RequestError(error.status_code, None, error.detail), dict(error.headers or {}))
    if isinstance(error, ClientDisconnect):
        return _problem_response(RequestError(400, "body", "The body is incomplete."))
    if not isinstance(error, RequestError):
        return _problem_response(RequestError(500, None, "Internal error of the service; see its log."))
    again = {"Retry-After": str(error.retry_after)}
    return _problem_response(error, {401: {"WWW-Authenticate": "Bearer"}, 429: again, 503: again}.get(error.status))


def _problem_response(error: RequestError, headers: dict[str, str] | None = None) -> JSONResponse:
    problem = Problem.model_validate(error, from_attributes=True)
    return JSONResponse(problem.model_dump(exclude_defaults=True), error.status, headers)
