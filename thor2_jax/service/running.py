"""The service without HTTP: who is let in, a request's way through its stages, start and end."""

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import AsyncIterator, Iterator

from thor2_jax.recognition.prepared_instance import PreparedInstance
from thor2_jax.recognition.recognizer import Recognition
from thor2_jax.service.answers import explained_frame
from thor2_jax.service.batching import Batcher
from thor2_jax.service.engine import Engine, Row
from thor2_jax.service.metrics import CompilationWatch, Metrics
from thor2_jax.service.preparing import Prepared, Preparers, prepare_clouds, prepare_frame
from thor2_jax.service.problem import RequestError, late
from thor2_jax.service.schemas import ExplainedFrame
from thor2_jax.service.settings import Settings

__all__ = ["Service", "Ticket"]

log = logging.getLogger(__name__)


class Ticket:
    """A request that was let in: its deadline (`time.monotonic`) and the seconds of its stages."""

    def __init__(self, seconds: float) -> None:
        self._start = time.monotonic()
        self.deadline = self._start + seconds
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what happens inside, if it ends well."""
        start = time.monotonic()
        yield
        self.seconds[name] = time.monotonic() - start

    def milliseconds(self) -> dict[str, float]:
        """Of all stages up to now, and their total."""
        total = time.monotonic() - self._start
        return {name: round(seconds * 1e3, 3) for name, seconds in {**self.seconds, "total": total}.items()}


class Service:
    """One process's share of the service."""

    def __init__(self, settings: Settings) -> None:
        """Read the run; raises InputError where it cannot."""
        self.settings = settings
        self.metrics = Metrics()
        self.engine = Engine(settings)
        self.state = "starting"
        self._watch = CompilationWatch(self.metrics.compilations)
        self._in_work = self._taken = self._left = 0

    def start(self) -> None:
        """Start processes and threads; `state` is "ready" once everything is compiled."""
        self._preparers = Preparers(self.settings.processes)
        self._batcher = Batcher(self._on_device, lambda: self._in_work, self.settings.max_batch, self.settings.window)
        self._warming = threading.Thread(target=self._warm_up, name="warm-up")
        self._warming.start()

    def _warm_up(self) -> None:
        start, sizes = time.monotonic(), 0
        try:
            for _ in self.engine.warm_up():
                if self.state != "starting":
                    return
                sizes += 1
        except Exception:
            log.exception("warm-up failed")
            self.state = "failed"
            return
        self._watch.start()
        if self.state == "starting":
            self.state = "ready"
        log.info("ready: %d batch sizes compiled in %.1f s", sizes, time.monotonic() - start)

    def stop_taking(self) -> None:
        """Let in no more; those that are in get their answers."""
        self.state = "stopping"

    def close(self) -> None:
        """Finish what was taken, end processes and threads."""
        self.stop_taking()
        self._warming.join()
        self._preparers.close()
        self._batcher.close()
        self._watch.stop()
        log.info("stopped: %d requests taken, %d finished", self._taken, self._left)

    @contextlib.asynccontextmanager
    async def request(self) -> AsyncIterator[Ticket]:
        """Let a request in, for as long as it takes.

        Raises:
            RequestError: 503 if the service is not ready, 429 if too many are in; 408 (the body did not arrive) or 504
                at the deadline.
        """
        if self.state != "ready":
            raise RequestError(503, None, f"The service is {self.state}.")
        if self._in_work >= self.settings.queue:
            raise RequestError(429, None, "Too many requests wait already.")
        ticket = Ticket(self.settings.deadline)
        self._in_work += 1
        self._taken += 1
        self.metrics.waiting.inc()
        try:
            async with asyncio.timeout(self.settings.deadline):
                yield ticket
        except TimeoutError:
            if "upload" in ticket.seconds:
                raise late() from None
            raise RequestError(408, "body", "The body did not arrive in time.") from None
        finally:
            self._in_work -= 1
            self._left += 1
            self.metrics.waiting.dec()
            for name, seconds in ticket.seconds.items():
                self.metrics.stages.labels(name).observe(seconds)

    async def recognize(self, files: dict[str, bytes], ticket: Ticket) -> list[Recognition]:
        """Answers for the frame in `files` (the arguments of `decoding.frame_of`). Raises RequestError."""
        prepared, rows = await self._frame(files, False, ticket)
        return self.engine.recognitions(prepared.instances, rows)

    async def explain(self, files: dict[str, bytes], ticket: Ticket) -> ExplainedFrame:
        """As `recognize`, with what the answers rest on. Raises RequestError."""
        prepared, rows = await self._frame(files, True, ticket)
        found = self.engine.recognitions(prepared.instances, rows)
        config = self.engine.run.config
        return await asyncio.to_thread(explained_frame, prepared, found, rows, config, ticket.milliseconds())

    async def _frame(self, files: dict[str, bytes], with_map: bool, ticket: Ticket) -> tuple[Prepared, list[Row]]:
        sigma_s = self.engine.run.config.sigma_s
        call = self._preparers.submit(ticket.deadline, prepare_frame, files, sigma_s, with_map)
        prepared = await asyncio.wrap_future(call)
        return prepared, await self._rows(prepared, ticket)

    async def describe(self, content: bytes, as_npz: bool, ticket: Ticket) -> list[Row]:
        """A row for each cloud of a body, npz or JSON. Raises RequestError."""
        call = self._preparers.submit(ticket.deadline, prepare_clouds, content, as_npz)
        return await self._rows(await asyncio.wrap_future(call), ticket)

    async def _rows(self, prepared: Prepared, ticket: Ticket) -> list[Row]:
        ticket.seconds.update(prepared.seconds)
        usable = [instance for instance in prepared.instances if instance.reason is None]
        with ticket.stage("device"):
            return await asyncio.wrap_future(self._batcher.submit(usable, ticket.deadline))

    def _on_device(self, instances: list[PreparedInstance]) -> list[Row]:
        self.metrics.batches.observe(len(instances))
        return self.engine.rows(instances)
