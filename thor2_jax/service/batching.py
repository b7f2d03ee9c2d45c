"""One thread that owns the device: clouds of all waiting requests share its batches."""

import dataclasses
import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Generic, TypeVar

from thor2_jax.service.problem import late

__all__ = ["Batcher"]

Cloud = TypeVar("Cloud")
Row = TypeVar("Row")


@dataclasses.dataclass(frozen=True, eq=False)
class _Job(Generic[Cloud, Row]):
    clouds: Sequence[Cloud]
    deadline: float
    future: Future[list[Row]]


class Batcher(Generic[Cloud, Row]):
    """Calls `compute` with the clouds of several jobs at once, in a thread of its own."""

    def __init__(
        self, compute: Callable[[list[Cloud]], list[Row]], expected: Callable[[], int], max_batch: int, window: float
    ) -> None:
        """Start the thread.

        Args:
            compute: a row for each of at most `max_batch` clouds.
            expected: how many jobs there are now, with those that are not submitted yet.
            max_batch: most clouds in a call.
            window: seconds that a batch with room left waits for jobs that are expected.
        """
        self._compute, self._expected = compute, expected
        self._max_batch, self._window = max_batch, window
        self._waiting: queue.SimpleQueue[_Job[Cloud, Row] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="device")
        self._thread.start()

    def submit(self, clouds: Sequence[Cloud], deadline: float) -> Future[list[Row]]:
        """Rows of `clouds`, in order. The future raises RequestError (504) if they wait past `deadline`.

        The deadline is one of `time.monotonic`. A future that is cancelled in time is not worked on.
        """
        job = _Job(clouds, deadline, Future[list[Row]]())
        if clouds:
            self._waiting.put(job)
        else:
            job.future.set_result([])
        return job.future

    def close(self) -> None:
        """Do what was submitted, then end the thread."""
        self._waiting.put(None)
        self._thread.join()

    def _run(self) -> None:
        going_on = True
        while going_on:
            jobs: list[_Job[Cloud, Row]] = []
            room, until = self._max_batch, 0.0
            while room > 0:
                try:
                    patience = until - time.monotonic() if len(jobs) < self._expected() else 0.0
                    job = self._waiting.get(timeout=max(0.0, patience) if jobs else None)
                except queue.Empty:
                    break
                if job is None:
                    going_on = False
                    break
                if not jobs:
                    until = time.monotonic() + self._window
                jobs.append(job)
                room -= len(job.clouds)
            self._work([job for job in jobs if job.future.set_running_or_notify_cancel()])

    def _work(self, jobs: list[_Job[Cloud, Row]]) -> None:
        now = time.monotonic()
        for job in jobs:
            if job.deadline < now:
                job.future.set_exception(late())
        jobs = [job for job in jobs if job.deadline >= now]
        clouds = [cloud for job in jobs for cloud in job.clouds]
        rows: list[Row] = []
        try:
            for first in range(0, len(clouds), self._max_batch):
                rows += self._compute(clouds[first : first + self._max_batch])
        except Exception as error:  # whoever waits must hear of it; the thread serves the next
            for job in jobs:
                job.future.set_exception(error)
            return
        for job in jobs:
            job.future.set_result(rows[: len(job.clouds)])
            del rows[: len(job.clouds)]
