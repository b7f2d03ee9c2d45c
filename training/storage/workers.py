"""Where tasks run: in processes of this machine, or on a Ray cluster. Either is a map that keeps the order.

    with closing(local(workers=2)(function, items)) as results:      # or on_ray(workers=64, address="auto")
        for result in results:
            ...

Results wait in the order of their items, `workers` of them at most, so memory does not grow with the number of items.
"""

import collections
import importlib
import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol, TypeVar

from thor2_jax.errors import InputError

__all__ = ["IN_PROCESS", "Engine", "local", "on_ray"]

A = TypeVar("A")
B = TypeVar("B")
Handle = TypeVar("Handle")


class Engine(Protocol):
    """Applies a function to items, several at a time; yields the results in the order of the items."""

    def __call__(self, function: Callable[[A], B], items: Iterable[A]) -> Generator[B, None, None]:
        """`function` and items are pickled: a function of a module. Closing the generator ends what still runs."""


def _in_order(
    submit: Callable[[A], Handle], fetch: Callable[[Handle], B], items: Iterable[A], ahead: int
) -> Generator[B, None, None]:
    pending: collections.deque[Handle] = collections.deque()
    for item in items:
        pending.append(submit(item))
        if len(pending) > ahead:
            yield fetch(pending.popleft())
    while pending:
        yield fetch(pending.popleft())


def _begin_worker() -> None:
    """Leave Ctrl-C to the parent, and end with it even if it is killed: an idle worker would wait for ever."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _check(workers: int) -> None:
    if workers < 1:
        raise InputError(f"workers must be at least 1, not {workers}")


def local(workers: int = 1) -> Engine:
    """Processes of this machine; 1 works in this one. With more, the calling script needs a `__main__` guard.

    A process that dies, out of memory for one, ends the map with ChildProcessError.

    Raises:
        InputError: `workers` is not positive.
    """
    _check(workers)

    def run(function: Callable[[A], B], items: Iterable[A]) -> Generator[B, None, None]:
        if workers == 1:
            yield from map(function, items)
            return
        # Not forked: JAX has threads, and a copy of them in a child can hang.
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker)
        try:
            yield from _in_order(
                lambda item: pool.submit(function, item), lambda future: future.result(), items, workers
            )
        except BrokenProcessPool as error:
            raise ChildProcessError(f"a worker process died, perhaps for want of memory ({error})") from error
        finally:
            pool.shutdown(cancel_futures=True)

    return run


IN_PROCESS = local()


def on_ray(workers: int, address: str | None = None) -> Engine:
    """Tasks on a Ray cluster. What a worker that dies had at hand is done again by another.

    Args:
        workers: tasks at a time.
        address: as of `ray.init`; None is the cluster of this machine, or one started for the duration of the map.

    Raises:
        InputError: `workers` is not positive, or Ray is not installed.
    """
    _check(workers)
    try:
        ray: Any = importlib.import_module("ray")
    except ModuleNotFoundError:
        raise InputError("engine: ray is not installed; it comes with the extra thor2-jax[cluster]") from None

    def run(function: Callable[[A], B], items: Iterable[A]) -> Generator[B, None, None]:
        with warnings.catch_warnings():
            # JAX warns of forks; Ray's are followed by the start of another program.
            warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
            cluster = ray.init(address, log_to_driver=False, logging_level="error")
        with cluster:
            yield from _in_order(ray.remote(function).remote, ray.get, items, workers)

    return run
