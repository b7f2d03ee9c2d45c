"""A single thread that runs the model, with batches shared between waiting requests."""

import dataclasses
import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Generic, TypeVar

from thor2_jax.service.problem import deadline_exceeded

__all__ = ["Batcher"]

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True, eq=False)
class _Job(Generic[Item, Result]):
    items: Sequence[Item]
    deadline: float
    future: Future[list[Result]]


class Batcher(Generic[Item, Result]):
    """Combine the items of several jobs into batches and process them in one thread."""

    def __init__(
        self,
        process_batch: Callable[[list[Item]], list[Result]],
        count_expected: Callable[[], int],
        max_batch: int,
        window: float,
    ) -> None:
        """Start the thread.

        Args:
            process_batch: returns one result per item, for at most `max_batch` items.
            count_expected: returns the number of current jobs, including jobs that are not submitted yet.
            max_batch: maximum number of items in a batch.
            window: seconds for which an incomplete batch waits for expected jobs.
        """
        self._process_batch, self._count_expected = process_batch, count_expected
        self._max_batch, self._window = max_batch, window
        # A SimpleQueue of CPython 3.11 may wait for ever where its timeout passes before it begins to wait.
        self._waiting: queue.Queue[_Job[Item, Result] | None] = queue.Queue()
        self._thread = threading.Thread(target=self._run, name="device")
        self._thread.start()

    def submit(self, items: Sequence[Item], deadline: float) -> Future[list[Result]]:
        """Queue `items` and return a future of their results, in order.

        The future raises RequestError (504) if the job still waits at `deadline` (a time of `time.monotonic`). A
        future that is cancelled while it waits is skipped.
        """
        job = _Job(items, deadline, Future[list[Result]]())
        if items:
            self._waiting.put(job)
        else:
            job.future.set_result([])
        return job.future

    def close(self) -> None:
        """Finish all submitted jobs and stop the thread."""
        self._waiting.put(None)
        self._thread.join()

    def _run(self) -> None:
        is_open = True
        while is_open:
            jobs: list[_Job[Item, Result]] = []
            free, window_end = self._max_batch, 0.0
            while free > 0:
                try:
                    timeout = window_end - time.monotonic() if len(jobs) < self._count_expected() else 0.0
                    job = self._waiting.get(timeout=max(0.0, timeout) if jobs else None)
                except queue.Empty:
                    break
                if job is None:
                    is_open = False
                    break
                if not jobs:
                    window_end = time.monotonic() + self._window
                jobs.append(job)
                free -= len(job.items)
            self._process([job for job in jobs if job.future.set_running_or_notify_cancel()])

    def _process(self, jobs: list[_Job[Item, Result]]) -> None:
        now = time.monotonic()
        for job in jobs:
            if job.deadline < now:
                job.future.set_exception(deadline_exceeded())
        jobs = [job for job in jobs if job.deadline >= now]
        items = [item for job in jobs for item in job.items]
        results: list[Result] = []
        try:
            for first in range(0, len(items), self._max_batch):
                results += self._process_batch(items[first : first + self._max_batch])
        except Exception as error:  # The callers receive the error; the thread continues with the next batch.
            for job in jobs:
                job.future.set_exception(error)
            return
        for job in jobs:
            job.future.set_result(results[: len(job.items)])
            del results[: len(job.items)]
