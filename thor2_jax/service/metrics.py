"""Prometheus metrics of the service, including the number of compilations after warm-up (expected to be zero)."""

import contextlib
import functools
import os
import threading
from pathlib import Path

import jax
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.multiprocess import MultiProcessCollector, mark_process_dead
from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["COMPILER_THREAD", "CompilationCounter", "Metrics", "RequestCounter"]

STAGE_BUCKETS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0)
BATCH_SIZE_BUCKETS = (1, 2, 4, 8, 16, 32, 64)
COMPILATION_EVENT = "/jax/core/compile/backend_compile_duration"
COMPILER_THREAD = "compile-explanations"
"""Name of the thread whose compilations are not counted, since no request waits for them."""

SHARED_DIRECTORY = "PROMETHEUS_MULTIPROC_DIR"


class Metrics:
    """Metrics of one process, or of all workers if `PROMETHEUS_MULTIPROC_DIR` names their shared directory."""

    def __init__(self) -> None:
        registry = self._registry = CollectorRegistry()
        gauge = functools.partial(Gauge, registry=registry, multiprocess_mode="livesum")
        counter = functools.partial(Counter, registry=registry)
        self.requests = counter("thor2_requests", "Answered requests.", ["path", "status"])
        histogram = functools.partial(Histogram, registry=registry)
        self.stages = histogram(
            "thor2_stage_seconds", "Duration of the stages of a request.", ["stage"], buckets=STAGE_BUCKETS
        )
        self.batches = histogram("thor2_batch_clouds", "Number of clouds in a batch.", buckets=BATCH_SIZE_BUCKETS)
        self.in_progress = gauge("thor2_requests_waiting", "Requests in progress.")
        self.ready_workers = gauge("thor2_ready_workers", "Processes that accept requests.")
        self.compilations = counter("thor2_compilations_after_warm_up", "Programs compiled after warm-up.")

    def text(self) -> bytes:
        """Return the metrics in the Prometheus text format."""
        return generate_latest(self._merged())

    def count_ready_workers(self) -> int:
        """Return the number of living processes that accept requests."""
        return int(self._merged().get_sample_value("thor2_ready_workers") or 0)

    def _merged(self) -> CollectorRegistry:
        """Return the registry of this process, or one that merges those of all workers."""
        if SHARED_DIRECTORY not in os.environ:
            return self._registry
        _remove_dead_workers(Path(os.environ[SHARED_DIRECTORY]))
        merged = CollectorRegistry()
        MultiProcessCollector(merged)
        return merged


def _remove_dead_workers(directory: Path) -> None:
    """Remove the gauges of workers that have died, so that their requests no longer count as in progress."""
    for path in directory.glob("gauge_live*.db"):
        pid = int(path.stem.rpartition("_")[2])
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            with contextlib.suppress(FileNotFoundError):  # Another worker has removed the file.
                mark_process_dead(pid)


class CompilationCounter:
    """Count the programs that JAX compiles between `start` and `stop`, except in the thread `COMPILER_THREAD`."""

    def __init__(self, counter: Counter) -> None:
        self._counter, self._is_active = counter, False

    def _on_event(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event == COMPILATION_EVENT and not threading.current_thread().name.startswith(COMPILER_THREAD):
            self._counter.inc()

    def start(self) -> None:
        """Start counting."""
        self._is_active = True
        jax.monitoring.register_event_duration_secs_listener(self._on_event)

    def stop(self) -> None:
        """Stop counting; does nothing before `start`."""
        if self._is_active:
            jax.monitoring.unregister_event_duration_listener(self._on_event)


class RequestCounter:
    """ASGI middleware that counts responses by route and status."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Call the application and count the status of its response."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        def count(status: int) -> None:
            # Routes, not paths: callers could create an unlimited number of labels.
            path = getattr(scope.get("route"), "path", "other")
            self._metrics.requests.labels(path or "other", str(status)).inc()

        async def send_counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                count(message["status"])
            await send(message)

        try:
            await self._app(scope, receive, send_counted)
        except Exception:  # An outer middleware answers with status 500.
            count(500)
            raise
