"""The service without HTTP: admission of requests, the stages of a request, start and shutdown."""

import asyncio
import contextlib
import copy
import dataclasses
import logging
import shlex
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import numpy as np
from starlette.requests import ClientDisconnect, Request

from thor2_jax.capacity import POINT_BUCKETS
from thor2_jax.errors import InputError
from thor2_jax.explanation.explain import compile_explanations, explain_instance
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery.enrollment import LOOKS, ObjectGallery, gallery_object, views_to_embed
from thor2_jax.gallery.store import GalleryBusyError, GalleryError
from thor2_jax.model.model import Model
from thor2_jax.model.recognition import Recognition
from thor2_jax.service.answers import why_answer
from thor2_jax.service.engine import Batcher, CloudResult, ExplanationPrograms, InferenceEngine, recognize
from thor2_jax.service.metrics import Metrics
from thor2_jax.service.preparation import (
    PreparedRequest,
    prepare_clouds,
    prepare_frame,
    prepare_view,
    start_processes,
    timed,
)
from thor2_jax.service.problem import RequestError, field_errors
from thor2_jax.service.schemas import WhyAnswer
from thor2_jax.service.settings import Settings

__all__ = ["AdmittedRequest", "Service"]

log = logging.getLogger(__name__)

T = TypeVar("T")

WHY_RETRY_SECONDS = 3
"""Value of Retry-After until explanations are compiled."""

COMPILATION_EVENT = "/jax/core/compile/backend_compile_duration"
"""JAX event for the compilation of a program."""

COMPILER_THREAD = "compile"
"""Name of the thread whose compilations are not counted, since no request waits for them."""

LOCK_SHARE = 0.8
"""Fraction of a request's remaining time for which it waits for another writer; the rest is for the error response."""


class AdmittedRequest:
    """A request in progress.

    Attributes:
        deadline: time of `time.monotonic` by which the request must be answered.
        seconds: stage -> duration.
    """

    def __init__(self, time_limit: float) -> None:
        self._start = time.monotonic()
        self.deadline = self._start + time_limit
        self.seconds: dict[str, float] = {}

    def milliseconds(self) -> dict[str, float]:
        """Return the durations of all finished stages and the total so far."""
        total = time.monotonic() - self._start
        return {name: round(seconds * 1e3, 3) for name, seconds in {**self.seconds, "total": total}.items()}


async def _end_if_disconnected(http: Request, limit: asyncio.Timeout) -> None:
    await http.receive()  # Only a disconnection follows the body.
    if not limit.expired():
        limit.reschedule(0)


class Service:
    """One process of the service.

    Attributes:
        state: "starting", "ready", "stopping" or "failed".
        progress: description of the current step of the warm-up.
    """

    def __init__(self, settings: Settings) -> None:
        """Load the run; raise InputError if it cannot be read, and OSError as `Metrics`."""
        self.settings = settings
        self.engine = InferenceEngine(settings)
        self.metrics = Metrics()
        self.state = "starting"
        self.progress = ""
        self._in_progress = self._accepted = 0
        self._compiled: dict[ExplanationPrograms, Future[None]] = {}

    def start(self) -> None:
        """Start processes and threads. `state` becomes "ready" when all batch shapes are compiled."""
        settings = self.settings
        self._pool = start_processes(settings.processes, settings.segmenter)
        self._batcher = Batcher(self._process_batch, settings.max_batch)
        self._explainer = ThreadPoolExecutor(1, thread_name_prefix="explain")
        self._compiler = ThreadPoolExecutor(1, thread_name_prefix=COMPILER_THREAD)
        # Changes that wait for another process occupy only one thread, also if their clients have disconnected.
        self._changer = ThreadPoolExecutor(1, thread_name_prefix="gallery")
        self._warmed_up = self._compiler.submit(self._warm_up)
        jax.monitoring.register_event_duration_secs_listener(self._count_compilation)

    def _count_compilation(self, event: str, duration_secs: float, **_: str | int) -> None:
        is_awaited = not threading.current_thread().name.startswith(COMPILER_THREAD)
        if self.state == "ready" and event == COMPILATION_EVENT and is_awaited:
            self.metrics.compilations.inc()

    def _warm_up(self) -> None:
        start, shapes = time.monotonic(), self.engine.batch_shapes
        try:
            for k, shape in enumerate(shapes, 1):
                if self.state != "starting":
                    return
                self.progress = f"compiling {k} of {len(shapes)}"
                log.info("%s: %d clouds of %d points", self.progress, *shape)
                self.engine.infer([], shape)  # compiles the programs
            self.engine.compile_adaptation()
        except Exception:
            log.exception("warm-up failed")
            self.state = "failed"
            raise
        if self.state == "starting":
            self.state = "ready"
            self.metrics.ready_workers.set(1)
            log.info("ready: %d batch shapes compiled in %.1f s", len(shapes), time.monotonic() - start)
        if self.settings.warm_why:
            self._warm_why([programs for n in POINT_BUCKETS for programs in self.engine.explanation_programs(n)])

    def _warm_why(self, programs: list[ExplanationPrograms]) -> None:
        """Compile for explanations, one size after the other, so that the sizes of requests can be inserted."""
        if programs and self.state == "ready":
            self._compile_explanations(programs[0]).add_done_callback(lambda _: self._warm_why(programs[1:]))

    def _compile_explanations(self, programs: ExplanationPrograms) -> Future[None]:
        """Compile programs for explanations in the background, unless their compilation has already begun."""

        def compile_all() -> None:
            try:
                compile_explanations(self.engine.model, *programs, lambda: self.state != "ready")
            except Exception:  # Requests compile the missing programs and report the error.
                log.exception("compiling explanations failed")
            else:
                if self.state == "ready":
                    source = "classifiers" if programs[1] else "gallery"
                    log.info("explanations of clouds of %d points are compiled (%s)", programs[0], source)

        if programs not in self._compiled:
            self._compiled[programs] = self._compiler.submit(compile_all)
        return self._compiled[programs]

    def wait_until_ready(self) -> None:
        """Return when the warm-up has ended; raise its error if it failed."""
        self._warmed_up.result()

    def check_ready(self) -> None:
        """Raise RequestError (503) unless the service accepts requests."""
        if self.state != "ready":
            progress = f": {self.progress}" if self.state == "starting" and self.progress else ""
            raise RequestError(503, None, f"The service is {self.state}{progress}.")

    def close(self) -> None:
        """Refuse new requests, finish those in progress, then stop processes and threads.

        A compilation or explanation that has begun cannot be interrupted; its thread ends later.
        """
        self.state = "stopping"
        self.metrics.ready_workers.set(0)
        self._compiler.shutdown(wait=False, cancel_futures=True)
        self._pool.close()
        self._batcher.close()
        self._explainer.shutdown(wait=False, cancel_futures=True)
        self._changer.shutdown(cancel_futures=True)
        jax.monitoring.unregister_event_duration_listener(self._count_compilation)
        log.info("stopped: %d requests accepted, %d finished", self._accepted, self._accepted - self._in_progress)

    @contextlib.asynccontextmanager
    async def admit(
        self, http: Request, read_body: Callable[[Request], Awaitable[T]], min_seconds: float = 0.0
    ) -> AsyncIterator[tuple[AdmittedRequest, T]]:
        """Admit a request for the duration of the context, or until its client disconnects; yield it with its body.

        Args:
            http: the request.
            read_body: function that waits for its whole body; called only if the request is admitted.
            min_seconds: shortest time until the deadline, if that of the settings is shorter; its body has the latter.

        Raises:
            RequestError: 503 if the service is not ready or stops, 429 if the queue is full; at the deadline, 408 if
                the body has not arrived and 504 otherwise; also as `read_body`.
            ClientDisconnect: the client has disconnected.
        """
        self.check_ready()
        if self._in_progress >= self.settings.queue:
            raise RequestError(429, None, f"The queue is full: {self.settings.queue} requests are in progress.")
        request = AdmittedRequest(max(self.settings.deadline, min_seconds))
        self._in_progress += 1
        self._accepted += 1
        self.metrics.in_progress.inc()
        try:
            async with asyncio.timeout(self.settings.deadline) as limit:
                with timed(request.seconds, "upload"):
                    body = await read_body(http)
                limit.reschedule(request.deadline)  # The clock of the event loop is `time.monotonic`.
                watch = asyncio.create_task(_end_if_disconnected(http, limit))
                try:
                    yield request, body
                finally:
                    watch.cancel()
        except TimeoutError:
            if "upload" not in request.seconds:
                raise RequestError(408, "body") from None
            raise (ClientDisconnect() if watch.done() else RequestError(504)) from None
        except asyncio.CancelledError:  # uvicorn stops, and does not wait longer
            raise RequestError(503, None, "The service is stopping.") from None
        finally:
            self._in_progress -= 1
            self.metrics.in_progress.dec()
            for name, duration in request.seconds.items():
                self.metrics.stages.labels(name).observe(duration)

    async def recognize(
        self, files: dict[str, bytes], request: AdmittedRequest, with_label_map: bool = False
    ) -> tuple[Model, PreparedRequest, list[CloudResult], list[Recognition]]:
        """Recognize the frame in `files` (the arguments of `decoding.decode_frame`).

        Returns:
            The model that gave the answers, which another request may replace meanwhile, the frame with corrected
            colours, the results of its usable instances, and a recognition of each instance.

        Raises:
            RequestError: as `preparation.prepare_frame`.
        """
        arguments = files, self.engine.model.run.config, with_label_map, self.settings.segmenter
        prepared = await self._prepare(request, prepare_frame, *arguments)
        corrected = self.engine.correct(prepared.instances, observe=True)
        results = await self._infer(corrected, request)
        self.engine.refresh()
        model = self.engine.model
        # Comparing the instances with the surfaces of enrolled objects takes milliseconds.
        recognitions = await asyncio.to_thread(recognize, model, corrected, results)
        return model, dataclasses.replace(prepared, instances=corrected), results, recognitions

    async def why(self, fields: dict[str, Any], request: AdmittedRequest) -> WhyAnswer:
        """Explain the answer for one instance of a frame, one request after the other.

        The fields are those of `schemas.WHY_FORM`.

        Raises:
            RequestError: as `prepare_view`, 422 if the run cannot be explained, or 503 until explanations of clouds of
                this size are compiled.
        """
        prepared = await self._prepare(request, prepare_view, fields, self.engine.model.run.config)
        self.engine.refresh()
        needed = self.engine.explanation_programs(len(prepared.instances[0].points))
        if not all([self._compile_explanations(programs).done() for programs in needed]):
            message = "Explanations are still being compiled, which can take some minutes."
            raise RequestError(503, None, message, WHY_RETRY_SECONDS)

        def explained() -> WhyAnswer:
            assert prepared.frame is not None
            (instance,) = self.engine.correct(prepared.instances, observe=False)
            return why_answer(explain_instance(self.engine.model, instance), prepared.frame)

        with timed(request.seconds, "explain"), field_errors("instance"):
            answer = await asyncio.wrap_future(self._explainer.submit(explained))
        answer.timings = request.milliseconds()
        return answer

    async def describe(self, content: bytes, is_npz: bool, request: AdmittedRequest) -> list[CloudResult]:
        """Describe the clouds of an npz or JSON body; raise RequestError if it is invalid."""
        prepared = await self._prepare(request, prepare_clouds, content, is_npz)
        return await self._infer(prepared.instances, request)

    async def enroll(self, fields: dict[str, Any], request: AdmittedRequest) -> ObjectGallery:
        """Enroll an object from one instance of a frame, and return the new gallery.

        The view and its augmented copies are embedded in batches, like the instances of frames; a view that the object
        has already is not added. The fields are those of `schemas.ENROLLMENT_FORM`.

        Raises:
            RequestError: 409 if the name exists and neither `extend` nor `replace` is true, 422 if both are; also as
                `change` and `prepare_view`. Nothing is enrolled.
        """
        name, flags = fields["name"], {flag: fields.get(flag, False) for flag in ("extend", "replace")}
        if all(flags.values()):
            raise RequestError(422, "replace", "extend and replace are both true; choose one.")
        objects = self.known_objects()
        with self._gallery_errors(409, "name"):
            name = objects.gallery.name_to_enroll(name, **flags)
        prepared = await self._prepare(request, prepare_view, fields, self.engine.model.run.config)
        try:
            view = self.engine.correct(prepared.instances, observe=False)
            clouds = objects.new_views(name, view, None, extend=flags["extend"])
        except InputError as error:
            message = str(error).replace("views[0]", f"instance {fields['instance']}")
            raise RequestError(422, "instance", f"{message}.") from None
        views = await asyncio.to_thread(views_to_embed, clouds, "frames")
        results = await self._infer(views, request)
        embeddings = np.array([result.inference.embeddings[:LOOKS] for result in results])
        # Also without a new view, this is a change that can be undone.
        added = {name: gallery_object(embeddings, clouds, "frames")} if clouds else {}
        return await self.change(lambda objects: objects.add(added, **flags), 409, "name", request)

    async def change(
        self, change: Callable[[ObjectGallery], None], refused: int, field: str, request: AdmittedRequest
    ) -> ObjectGallery:
        """Change the gallery on disk in another thread, then read it again in this thread, like other processes.

        Args:
            change: function that changes a copy of the gallery.
            refused: status if the gallery refuses the change.
            field: field of the request that the error then names.
            request: the request.

        Returns:
            The gallery after the change.

        Raises:
            RequestError: 500 if the gallery cannot be read, 503 while another process writes to it, 507 if it cannot be
                written, `refused` for other errors. The gallery is unchanged.
        """

        def change_copy() -> ObjectGallery:
            copied = copy.copy(self.engine.objects)
            copied.lock_seconds = max(0.0, LOCK_SHARE * (request.deadline - time.monotonic()))
            with self._gallery_errors(refused, field):
                change(copied)
            return copied

        with timed(request.seconds, "gallery"):
            copied = await asyncio.wrap_future(self._changer.submit(change_copy))
        self.engine.refresh()
        return copied

    @contextlib.contextmanager
    def _gallery_errors(self, refused: int, field: str) -> Iterator[None]:
        """Turn the errors of the gallery into those of `change`, whose messages do not contain its path."""
        try:
            yield
        except OSError as error:
            log.error("%s", error)
            message = f"The gallery cannot be read or written ({error.strerror}); it is as before."
            raise RequestError(507, None, message) from None
        except GalleryError as error:
            log.error("%s", error)
            directory = self.engine.objects.directory
            message = str(error).replace(f"--gallery {shlex.quote(str(directory))}", "--gallery GALLERY")
            message = message.replace(f"{directory}/", "").replace(str(directory), "the directory")
            raise RequestError(503 if isinstance(error, GalleryBusyError) else 500, None, f"{message}.") from None
        except InputError as error:
            raise RequestError(refused, field, f"{error}.") from None

    def known_objects(self) -> ObjectGallery:
        """Return the objects that the model can recognize, as stored on disk; raise RequestError as `change`."""
        with self._gallery_errors(500, "gallery"):
            self.engine.read_gallery()
        return self.engine.objects

    async def _prepare(
        self, request: AdmittedRequest, function: Callable[..., PreparedRequest], *arguments: Any
    ) -> PreparedRequest:
        """Call a function of `preparation` in a worker process."""
        call = self._pool.submit(function, *arguments, deadline=request.deadline)
        try:
            prepared: PreparedRequest = await asyncio.wrap_future(call)
        except ChildProcessError:
            raise RequestError(422, "body", "The body made the process that decoded it crash.") from None
        request.seconds.update(prepared.seconds)
        return prepared

    async def _infer(self, instances: Sequence[PreparedInstance], request: AdmittedRequest) -> list[CloudResult]:
        usable = [instance for instance in instances if instance.reason is None]
        with timed(request.seconds, "device"):
            return await asyncio.wrap_future(self._batcher.submit(usable)) if usable else []

    def _process_batch(self, instances: list[PreparedInstance]) -> list[CloudResult]:
        self.metrics.batches.observe(len(instances))
        return self.engine.infer(instances)
