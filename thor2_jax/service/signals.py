"""Handlers of Ctrl-C and SIGTERM, also while processes of the service and of worker pools start."""

import contextlib
import signal
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from typing import Any

__all__ = ["ended_by_signals", "handlers_replaced", "signals_blocked"]


@contextlib.contextmanager
def handlers_replaced(replace: Callable[[Any], Any]) -> Iterator[None]:
    """Replace the handlers of SIGINT and SIGTERM by what `replace` returns for each of them, inside the context."""
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number, handler in previous.items():
        signal.signal(number, replace(handler))
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGINT and SIGTERM end this process at once, as long as there is nothing to finish.

    The exception of Python's handler can get lost while modules and models are loaded, and with it the signal: what is
    raised in a callback, such as those of JAX for garbage collection, is ignored.
    """
    with handlers_replaced(lambda previous: previous if previous is signal.SIG_IGN else signal.SIG_DFL):
        yield


@contextlib.contextmanager
def signals_blocked(*numbers: signal.Signals) -> Iterator[None]:
    """Block signals for good in processes that start in the context, and in this thread for its duration.

    A Ctrl-C reaches all processes of a terminal. Those that still import modules would end with a traceback.
    """
    resource_tracker.ensure_running()  # Its own start would unblock them.
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)
