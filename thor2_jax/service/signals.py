"""Ctrl-C while processes of the service start."""

import contextlib
import signal
from collections.abc import Iterator
from multiprocessing import resource_tracker

__all__ = ["ended_by_signals", "signals_blocked"]


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGINT and SIGTERM end this process at once, as long as there is nothing to finish.

    The exception of Python's handler can get lost while modules and models are loaded, and with it the signal: what is
    raised in a callback, such as those of JAX for garbage collection, is ignored.
    """
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number, handler in previous.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


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
