"""Worker pools: ordered parallel maps over processes on this machine or tasks on a Ray cluster.

    with closing(local_workers(2)(function, items)) as results:  # or ray_workers(64, address="auto")
        for result in results:
            ...

At most `workers` results wait to be read, so memory does not grow with the number of items. If a worker dies, its item
is given to another worker.
"""

import collections
import contextlib
import ctypes
import functools
import importlib
import multiprocessing
import os
import signal
import socket
import warnings
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future
from typing import Any, Protocol, TypeVar

from thor2_jax.errors import InputError, needs_extra, reason_of
from thor2_jax.processes import Processes

__all__ = ["IN_PROCESS", "WorkerPool", "keep_freed_memory", "local_workers", "ray_workers"]

A = TypeVar("A")
B = TypeVar("B")
Handle = TypeVar("Handle")


CONNECT_SECONDS = 10.0
"""Longest time to connect to one network address of a Ray cluster."""

ATTEMPTS = 3
"""Number of workers that may die at the same item before an error is raised."""

M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -4, -8
"""Options of mallopt(3)."""


class WorkerPool(Protocol):
    """Function that maps another function over items, several at a time, and yields the results in their order."""

    def __call__(self, function: Callable[[A], B], items: Iterable[A]) -> Generator[B, None, None]:
        """Apply `function`, which must be picklable like the items; a closed generator begins no more tasks."""


def _map_ordered(
    submit: Callable[[A], Handle], fetch: Callable[[Handle], B], items: Iterable[A], ahead: int
) -> Generator[B, None, None]:
    pending: collections.deque[Handle] = collections.deque()
    for item in items:
        pending.append(submit(item))
        if len(pending) > ahead:
            yield fetch(pending.popleft())
    yield from map(fetch, pending)


def keep_freed_memory() -> None:
    """Make the C library reuse large blocks of memory in this process instead of returning them to the system.

    Otherwise, a training requests the pages of its largest arrays again in each step, which takes a tenth of its time.
    """
    with contextlib.suppress(AttributeError):  # only glibc has these options
        # There is one arena, since the arenas of other threads return blocks above 64 MB regardless of these options.
        for option, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, -1), (M_ARENA_MAX, 1)):
            ctypes.CDLL(None).mallopt(option, value)


def _initialize_worker() -> None:
    # Otherwise, JAX reserves most of an accelerator's memory for one worker. It reads the variable when it is imported.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    keep_freed_memory()


def local_workers(workers: int = 1) -> WorkerPool:
    """Return a pool of processes on this machine; a single worker runs in the calling process.

    With several workers, the calling script needs an `if __name__ == "__main__"` guard. If a worker dies, only its item
    is computed again. The map raises ChildProcessError if workers die repeatedly at the same item, for example because
    memory runs out.
    """

    def run(function: Callable[[A], B], items: Iterable[A]) -> Generator[B, None, None]:
        if workers == 1:
            yield from map(function, items)
            return
        processes = Processes(workers, multiprocessing.get_context("spawn"), _initialize_worker, signal.SIGINT)
        with contextlib.closing(processes):
            submit = functools.partial(processes.submit, function, attempts=ATTEMPTS)
            yield from _map_ordered(submit, Future.result, items, workers)

    return run


IN_PROCESS = local_workers()
"""The pool that runs every task in the calling process."""


def ray_workers(workers: int, address: str | None = None) -> WorkerPool:
    """Return a pool of tasks on a Ray cluster, which repeats the tasks of a worker that dies.

    Args:
        workers: number of concurrent tasks.
        address: address of the cluster, as for `ray.init`; None uses the cluster on this machine, or starts one for the
            duration of the map.

    Raises:
        InputError: Ray is not installed. The map raises it if the address is invalid or cannot be reached.
    """
    with needs_extra("engine is ray, which", "the package ray", "cluster"):
        ray: Any = importlib.import_module("ray")

    def fetch(result: Any) -> Any:
        try:
            return ray.get(result)
        except ray.exceptions.RayTaskError as error:  # The message of this error is a traceback of the worker.
            raise error.cause from None

    def run(function: Callable[[A], B], items: Iterable[A]) -> Generator[B, None, None]:
        given = address or os.environ.get("RAY_ADDRESS", "")
        host, _, port = given.removeprefix("ray://").rpartition(":")
        if host and "/" not in host and port.isdecimal():  # Ray would try for minutes to connect.
            try:
                socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
            except (OSError, OverflowError, UnicodeError) as error:
                raise InputError(
                    f"address is {given}, which cannot be reached ({reason_of(error)}); expected HOST:PORT of a Ray "
                    "cluster; start the cluster, or correct the address"
                ) from None
        with warnings.catch_warnings():
            # JAX warns about forks, but Ray's forks are safe, since they execute another program at once.
            warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
            try:
                cluster = ray.init(address, log_to_driver=False, logging_level="error")
            except ValueError as error:
                raise InputError(f"engine is ray; expected HOST:PORT of its cluster as the address ({error})") from None
        with cluster:
            # Ray accepts functions only, not other callables such as partial functions.
            yield from _map_ordered(ray.remote(lambda item: function(item)).remote, fetch, items, workers)

    return run
