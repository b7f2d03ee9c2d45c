"""Worker processes that are slow, die or are stopped, and signals to the process that has started them."""

import math
import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest
from processes import HANG, wait_until

from thor2_jax import processes
from thor2_jax.processes import Processes


def test_slow_and_dead_processes_are_replaced(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    pool = Processes(1, multiprocessing.get_context("spawn"), os.getpid)
    request.addfinalizer(pool.close)
    monkeypatch.setattr(processes, "MIN_SECONDS", 0.1)
    for seconds, function, argument, kind in (
        (0.1, time.sleep, 10 * HANG, TimeoutError),
        (HANG, os._exit, 3, ChildProcessError),
    ):
        replaced = pool.submit(os.getpid).result(HANG)
        with pytest.raises(kind):
            pool.submit(function, argument, deadline=time.monotonic() + seconds).result(HANG)
        with pytest.raises(ProcessLookupError):
            os.kill(replaced, 0)
    stopped = pool.submit(os.getpid).result(HANG)
    os.kill(stopped, signal.SIGSTOP)
    request.addfinalizer(lambda: Path(f"/proc/{stopped}").exists() and os.kill(stopped, signal.SIGKILL))
    with pytest.raises(TimeoutError):  # It does not receive an argument that fills the pipe.
        pool.submit(len, bytes(10**7), deadline=time.monotonic()).result(HANG)
    pool.submit(os.getpid).result(HANG)
    (idle,) = pool._processes.values()
    idle.stop()  # The pool does not notice the death of an idle process.
    assert pool.submit(math.sqrt, 9.0).result(HANG) == 3.0
    with pytest.raises(ValueError, match="math domain error") as error:
        pool.submit(math.sqrt, -1.0).result(HANG)
    assert "processes.py" in error.value.__notes__[0]  # the traceback in the process
    with pytest.raises(RuntimeError, match="Local: a reason"):  # an error that cannot be pickled
        pool.submit(eval, "(_ for _ in ()).throw(type('Local', (Exception,), {})('a reason'))").result(HANG)
    monkeypatch.setattr(processes.threading.Timer, "start", lambda timer: None)
    with pytest.raises(TimeoutError):  # The answer comes at the moment at which the timer ends the process.
        pool.submit(time.sleep, 0.2, deadline=0).result(HANG)


@pytest.mark.parametrize("begun", [True, False], ids=["", "starting"])
def test_closing_ends_running_calls(begun: bool) -> None:
    pool = Processes(1, multiprocessing.get_context("spawn"), os.getpid)
    running = pool.submit(time.sleep, 10 * HANG, attempts=3)
    wait_until(lambda: pool._processes or not begun)
    pool.close()
    with pytest.raises(TimeoutError):
        running.result(0)
