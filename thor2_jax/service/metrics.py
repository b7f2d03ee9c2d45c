"""Prometheus metrics of the service, including the number of compilations after warm-up (expected to be zero)."""

import functools
import os

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.multiprocess import MultiProcessCollector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from thor2_jax.files import write_bytes

__all__ = ["Metrics", "count_requests"]

STAGE_BUCKETS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0)
BATCH_SIZE_BUCKETS = (1, 2, 4, 8, 16, 32, 64)


class Metrics:
    """Metrics of one process, or of all workers if `PROMETHEUS_MULTIPROC_DIR` names their shared directory."""

    def __init__(self) -> None:
        """Create the metrics; raise OSError if the files that the workers share cannot be written."""
        if directory := os.environ.get("PROMETHEUS_MULTIPROC_DIR"):
            # The files are mapped: without their blocks, a disk that becomes full would end this process by SIGBUS.
            for kind in ("counter", "gauge_livesum", "histogram"):
                write_bytes(f"{directory}/{kind}_{os.getpid()}.db", bytes(2**16))
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
        if "PROMETHEUS_MULTIPROC_DIR" not in os.environ:
            return self._registry
        merged = CollectorRegistry()
        MultiProcessCollector(merged)
        return merged


def count_requests(app: ASGIApp, metrics: Metrics) -> ASGIApp:
    """Return ASGI middleware that counts responses by route and status."""

    async def counted(scope: Scope, receive: Receive, send: Send) -> None:
        status = 500  # An outer middleware answers so if the application raises an exception.

        async def send_noted(message: Message) -> None:
            nonlocal status
            status = message.get("status", status)
            await send(message)

        try:
            await app(scope, receive, send_noted)
        finally:
            if scope["type"] == "http":
                # Routes, not paths: callers could create an unlimited number of labels.
                path = getattr(scope.get("route"), "path", "other")
                metrics.requests.labels(path or "other", str(status)).inc()

    return counted
