"""What the service counts, for Prometheus, and the proof that no request compiles anything."""

import os
from pathlib import Path

import jax
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.multiprocess import MultiProcessCollector, mark_process_dead
from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["CompilationWatch", "Metrics", "RequestCounting"]

SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0)
COMPILED = "/jax/core/compile/backend_compile_duration"
WORKERS = "PROMETHEUS_MULTIPROC_DIR"


class Metrics:
    """Counters of one process; of all workers where `PROMETHEUS_MULTIPROC_DIR` names their common folder."""

    def __init__(self) -> None:
        if WORKERS in os.environ:
            _forget_dead_workers(Path(os.environ[WORKERS]))
        registry = self._registry = CollectorRegistry()
        self.requests = Counter("thor2_requests", "Requests.", ["path", "status"], registry=registry)
        self.stages = Histogram(
            "thor2_stage_seconds", "Seconds of a request by stage.", ["stage"], registry=registry, buckets=SECONDS
        )
        self.batches = Histogram(
            "thor2_batch_clouds",
            "Clouds in a batch of the device.",
            registry=registry,
            buckets=(1, 2, 4, 8, 16, 32, 64),
        )
        self.waiting = Gauge(
            "thor2_requests_waiting", "Requests in work.", registry=registry, multiprocess_mode="livesum"
        )
        self.compilations = Counter(
            "thor2_compilations_after_warm_up", "Programs compiled since the service was ready.", registry=registry
        )

    def text(self) -> bytes:
        """In the format that Prometheus reads."""
        if WORKERS not in os.environ:
            return generate_latest(self._registry)
        together = CollectorRegistry()
        MultiProcessCollector(together)
        return generate_latest(together)


def _forget_dead_workers(folder: Path) -> None:
    """A worker that is started in place of one that died: the requests of that one wait no more."""
    for path in folder.glob("gauge_live*.db"):
        pid = int(path.stem.rpartition("_")[2])
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            mark_process_dead(pid)


class CompilationWatch:
    """Counts what JAX compiles in this process, from `start` to `stop`."""

    def __init__(self, counter: Counter) -> None:
        self._counter, self._listening = counter, False

    def _listen(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event == COMPILED:
            self._counter.inc()

    def start(self) -> None:
        """Count from now on."""
        self._listening = True
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def stop(self) -> None:
        """Count no more; harmless if `start` was never called."""
        if self._listening:
            jax.monitoring.unregister_event_duration_listener(self._listen)


class RequestCounting:
    """ASGI middleware: counts answers by route and status."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, and look at the status that goes out."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        def count(status: int) -> None:
            # Only names of routes: paths are the caller's, and without end.
            path = getattr(scope.get("route"), "path", "other")
            self._metrics.requests.labels(path or "other", str(status)).inc()

        async def counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                count(message["status"])
            await send(message)

        try:
            await self._app(scope, receive, counted)
        except Exception:  # it is answered further out
            count(500)
            raise
