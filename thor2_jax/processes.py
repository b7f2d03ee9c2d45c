"""Worker processes, Ctrl-C and SIGTERM, also during the start of processes, and processes that end with their parent.

`Processes` has a thread for each process that waits for it. A process that dies or takes too long is replaced.
"""

import contextlib
import math
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any

__all__ = ["Processes", "end_with_parent", "ended_by_signals", "signals_blocked", "signals_handled"]

MIN_SECONDS = 1.0
"""Shortest time that a process has for a call, so that only exceptionally slow calls are interrupted."""


@contextlib.contextmanager
def signals_handled(actions: Mapping[signal.Signals, Any]) -> Iterator[None]:
    """Handle these signals by these actions inside the context, except those that are ignored, as `nohup` does."""
    previous = {number: signal.getsignal(number) for number in actions}
    for number, handler in previous.items():
        signal.signal(number, handler if handler is signal.SIG_IGN else actions[number])
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def ended_by_signals() -> contextlib.AbstractContextManager[None]:
    """Let SIGINT, SIGTERM and SIGHUP end this process at once inside the context, while there is no work to finish.

    While modules and models are loaded, the exception of Python's handler can get lost, and with it the signal:
    exceptions in callbacks, such as those of JAX for garbage collection, are ignored.
    """
    return signals_handled(dict.fromkeys((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), signal.SIG_DFL))


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


def _run(pipe: Connection, initialize: Callable[[], object]) -> None:
    """Receive functions with their arguments, and send back (result, None) or (None, error)."""
    end_with_parent(signal.SIGKILL)  # a call can take minutes
    initialize()
    with contextlib.suppress(EOFError, OSError):  # The parent has ended or was killed.
        pipe.send("ready")
        while True:
            function, arguments = pipe.recv()
            try:
                pipe.send((function(*arguments), None))
            except Exception as error:
                error.add_note(traceback.format_exc())  # The traceback itself cannot be sent.
                try:
                    pipe.send((None, error))
                except Exception:  # The error cannot be pickled.
                    pipe.send((None, RuntimeError(traceback.format_exc())))


class _Process:
    def __init__(self, context: Any, initialize: Callable[[], object], blocked: Sequence[signal.Signals]) -> None:
        self.pipe, child_pipe = context.Pipe()
        self.process = context.Process(target=_run, args=(child_pipe, initialize), daemon=True)
        with signals_blocked(*blocked):
            self.process.start()
        child_pipe.close()
        self.pipe.recv()

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


class Processes:
    """A fixed number of processes, which start when they are first needed.

    Args:
        count: number of processes.
        context: of `multiprocessing`. It must not fork this process, since JAX starts threads, and a forked child can
            deadlock on their locks.
        initialize: function that each process calls at its start.
        blocked: signals that the processes do not receive. A Ctrl-C reaches all processes of a terminal.
    """

    def __init__(self, count: int, context: Any, initialize: Callable[[], object], *blocked: signal.Signals) -> None:
        self._start = lambda: _Process(context, initialize, blocked)
        self._threads = ThreadPoolExecutor(count)
        self._processes, self._closed = dict[int, _Process](), False  # by the thread that waits for it

    def submit(
        self, function: Callable[..., Any], *arguments: Any, attempts: int = 1, deadline: float = math.inf
    ) -> Future[Any]:
        """Call `function`, which must be picklable like its arguments, in a process.

        The future raises the error of the function, TimeoutError if the call has not returned at `deadline` (a time of
        `time.monotonic`) or when the processes are closed, or ChildProcessError if `attempts` processes died one after
        the other.
        """
        return self._threads.submit(self._call, function, arguments, attempts, deadline)

    def _call(self, function: Callable[..., Any], arguments: tuple[Any, ...], attempts: int, deadline: float) -> Any:
        thread = threading.get_ident()
        for _ in range(attempts):
            process, limit = self._processes.get(thread), math.inf
            try:
                if process is None or not process.process.is_alive():
                    process = self._processes[thread] = self._start()
                limit = 0.0 if self._closed else max(deadline, time.monotonic() + MIN_SECONDS)
                # A process that was stopped by a signal does not receive, so that sending to it takes as long, too.
                timer = threading.Timer(min(limit - time.monotonic(), threading.TIMEOUT_MAX), process.process.kill)
                timer.start()
                try:
                    process.pipe.send((function, arguments))
                    result, error = process.pipe.recv()
                finally:
                    timer.cancel()
                if time.monotonic() >= limit:  # The timer may have ended the process after its answer.
                    raise TimeoutError
            except (EOFError, OSError):  # The process has ended, or will.
                if process is not None:
                    process.stop()
                if self._closed or time.monotonic() >= limit:
                    raise TimeoutError("the deadline of a call was exceeded") from None
            else:
                if error is not None:
                    raise error
                return result
        raise ChildProcessError(f"{attempts} worker processes died at the same item, possibly because memory ran out")

    def close(self) -> None:
        """End the processes without waiting for running calls, and cancel the calls that have not begun."""
        self._closed = True
        for process in list(self._processes.values()):
            process.process.kill()
        self._threads.shutdown(cancel_futures=True)
        for process in self._processes.values():
            process.stop()
