"""Handling of Ctrl-C and SIGTERM, also during the start of processes, and processes that end with their parent."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from multiprocessing import resource_tracker

__all__ = ["end_with_parent", "ended_by_signals", "signals_blocked"]


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGINT and SIGTERM end this process at once inside the context, while there is no work to finish.

    While modules and models are loaded, the exception of Python's handler can get lost, and with it the signal:
    exceptions in callbacks, such as those of JAX for garbage collection, are ignored.
    """
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number, handler in previous.items():
        signal.signal(number, handler if handler is signal.SIG_IGN else signal.SIG_DFL)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def signals_blocked(*numbers: signal.Signals) -> Iterator[None]:
    """Block signals in this thread inside the context, and permanently in processes that start there.

    A Ctrl-C reaches all processes of a terminal. Processes that still import modules would end with a traceback.
    """
    resource_tracker.ensure_running()  # Its start would unblock the signals later.
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


def end_with_parent(number: signal.Signals) -> None:
    """Send a signal to this process when its parent has ended, even by SIGKILL; a main process has no parent."""
    if (parent := multiprocessing.parent_process()) is not None:

        def send() -> None:
            parent.join()
            os.kill(os.getpid(), number)

        threading.Thread(target=send, name="parent-watch", daemon=True).start()
