"""`thor2 serve` reports errors at startup in one line and exits with code 2."""

import asyncio
import functools
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from commands import Command
from processes import finish_programs, start_program
from refusals import assert_refused
from uvicorn.supervisors import Multiprocess
from uvicorn.supervisors.multiprocess import Process

from thor2_jax.errors import InputError
from thor2_jax.service import server
from thor2_jax.service.app import create_app
from thor2_jax.service.settings import Settings


@pytest.fixture
def serve(refused: Command, monkeypatch: pytest.MonkeyPatch) -> Iterator[Command]:
    """Return a function that runs the command in this process, where it must fail, and returns its error line."""
    monkeypatch.setattr(uvicorn.Config, "configure_logging", lambda _: None)
    handler = signal.getsignal(signal.SIGTERM)
    yield functools.partial(refused, "serve")
    signal.signal(signal.SIGTERM, handler)


@pytest.mark.parametrize("workers", [1, 2])
def test_missing_run_directory(workers: int, tmp_path: Path, serve: Command, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        assert "model: " in serve("--model", tmp_path, "--port", "0", "--workers", workers)
    assert workers == 1 or "listening at" not in caplog.text  # that is logged after the model is loaded
    # The second one is a worker that replaces another one after the directory was removed.
    with pytest.raises(InputError if workers == 1 else SystemExit, match="model: "):
        server._create_worker(Settings(tmp_path), workers)


def test_a_worker_refuses_a_run_that_was_trained_again(run_dir: Path) -> None:
    with pytest.raises(SystemExit, match="has changed since the start; restart"):
        server._create_worker(Settings(run_dir), 2, "the digest of the record that the other workers have read")


def test_xla_is_set_up_before_jax_is_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL")
    code = "import os, sys, training; print('jax' in sys.modules); del os.environ['XLA_FLAGS']; import training.cli; "
    code += "print(*map(os.getenv, sys.argv[1:]))"
    expected = "False\n3 --xla_cpu_use_fusion_emitters=false\n"
    assert finish_programs(start_program(code, "TF_CPP_MIN_LOG_LEVEL", "XLA_FLAGS")) == [expected]


SETTINGS = ("max-batch", "7"), ("unknown-below", "2.0")
HOSTS = ("allow-host", "http://robot.local"), ("host", "http://localhost")
CACHES = ("cache", __file__), ("cache", "/proc/programs")  # which not even root can write


@pytest.mark.parametrize(
    ("name", "value"), [*SETTINGS, *HOSTS, *CACHES, *(("deadline", value) for value in ("0.0", "nan", "inf"))]
)
def test_invalid_settings(run_dir: Path, serve: Command, name: str, value: str) -> None:
    error = serve("--model", run_dir, f"--{name}", value)
    assert f"--{name} is " in error and value in error


def test_a_segmenter_that_cannot_be_loaded_stops_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings(tmp_path).segmenter == "table"
    assert_refused("segmenter is 'sam'; expected one of table", Settings, tmp_path, segmenter="sam")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert Settings(tmp_path).segmenter is None


def test_invalid_tokens(run_dir: Path, serve: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty one does not switch authentication off."""
    for token in ("", "é", "a "):
        assert "--token" in serve("--model", run_dir, "--token", token)
    monkeypatch.setenv("THOR2_TOKEN", "")
    assert "THOR2_TOKEN" in serve("--model", run_dir)


def test_ctrl_c_while_the_model_is_loaded(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An exception of Python's own handler can get lost there."""
    actions: list[Any] = []
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGHUP

    def load(*_: object) -> None:
        actions.extend(map(signal.getsignal, numbers))
        raise InputError("ends the command")

    before = [*map(signal.getsignal, numbers)]
    monkeypatch.setattr(server, "InferenceEngine", load)
    monkeypatch.setattr(server, "create_app", load)
    for workers in (1, 2):
        assert_refused("ends", server.serve, Settings(run_dir), port=0, workers=workers)
    assert actions == [signal.SIG_IGN if handler is signal.SIG_IGN else signal.SIG_DFL for handler in before] * 2
    assert [*map(signal.getsignal, numbers)] == before


def test_workers_receive_no_ctrl_c_and_own_their_end_of_the_pipe(monkeypatch: pytest.MonkeyPatch) -> None:
    """If a busy worker is killed, the health check ends at once; otherwise it would last for its timeout, a minute."""
    masks: list[set[signal.Signals]] = []

    def start_worker(supervisor: Any) -> None:
        assert all(process.parent_conn.poll(0) for process in supervisor.processes)  # the end of the pipe
        masks.append(set(signal.pthread_sigmask(signal.SIG_BLOCK, ())))
        supervisor.processes = [Process(uvicorn.Config("no application"), [])]  # not started: it holds no pipe

    supervisor = object.__new__(server._Supervisor)
    supervisor.processes = []
    for start in ("init_processes", "keep_subprocess_alive", "keep_subprocess_alive"):
        monkeypatch.setattr(Multiprocess, start, start_worker)
        getattr(supervisor, start)()
    blocked = {signal.SIGINT, signal.SIGHUP}
    assert [mask & {signal.SIGTERM, *blocked} for mask in masks] == [blocked] * 3


def test_preparation_processes_receive_no_signal_of_a_terminal() -> None:
    """A new process, whose fork server is that of the pool. The fork server imports modules for seconds."""
    code = (
        "import signal; from thor2_jax.service.preparation import start_processes; processes = start_processes(1); "
        "blocked = processes.submit(signal.pthread_sigmask, signal.SIG_BLOCK, ()).result(); processes.close(); "
        "print(*sorted(blocked)); print(signal.pthread_sigmask(signal.SIG_BLOCK, ()))"
    )
    blocked = sorted(map(int, (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)))
    assert finish_programs(start_program(code)) == [" ".join(map(str, blocked)) + "\nset()\n"]


def test_metrics_of_workers_need_no_space_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A write to a mapped file ends the process if its disk is full and the file has a hole there."""
    monkeypatch.setenv("PROMETHEUS_MULTIPROC_DIR", str(tmp_path))
    finish_programs(start_program("from thor2_jax.service.metrics import Metrics; Metrics()"))
    files = [path.stat() for path in tmp_path.iterdir()]
    assert len(files) == 3 and all(file.st_blocks * 512 >= file.st_size for file in files)


def test_a_service_leaves_no_directory_of_its_workers(run_dir: Path) -> None:
    code = """
import os
from unittest import mock
from training.cli import main
from thor2_jax.service import server
server.InferenceEngine = server._Supervisor = mock.Mock()
server._Supervisor.return_value.run = lambda: print(os.environ["PROMETHEUS_MULTIPROC_DIR"], flush=True)
main()
"""
    (printed,) = finish_programs(start_program(code, "serve", "--model", run_dir, "--workers", 2, "--port", 0))
    assert printed and not Path(printed.strip()).parent.exists()


def test_a_closed_terminal_ends_workers_except_under_nohup(run_dir: Path) -> None:
    """Otherwise, uvicorn would replace the workers, also under `nohup`, and handle no other signal meanwhile."""
    code = """
import signal, sys
from pathlib import Path
from unittest import mock
from thor2_jax.service import server
server.InferenceEngine = mock.Mock()
server._Supervisor.run = lambda self: (signal.raise_signal(signal.SIGHUP), print(*map(int, self.signal_queue)))
for action in (signal.SIG_DFL, signal.SIG_IGN):
    signal.signal(signal.SIGHUP, action)
    server.serve(server.Settings(Path(sys.argv[1])), port=0, workers=2)
"""
    assert finish_programs(start_program(code, run_dir)) == [f"{int(signal.SIGTERM)}\n\n"]


def test_signal_while_processes_start(run_dir: Path, monkeypatch: pytest.MonkeyPatch, request: Any) -> None:
    """It ends a worker at once, which then does not compile for a minute; uvicorn handles it in a ready worker."""
    app, actions = create_app(Settings(run_dir), workers=2), []

    def record() -> None:
        actions.append(signal.getsignal(signal.SIGTERM))

    async def start() -> None:
        async with app.router.lifespan_context(app):
            record()

    for name in ("start", "wait_until_ready", "close"):
        monkeypatch.setattr(app.state.service, name, record)
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGTERM, before))
    asyncio.run(start())
    assert actions == [signal.SIG_DFL] * 2 + [signal.default_int_handler] * 2


def test_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch, refused: Command, run_dir: Path) -> None:
    for name in [name for name in sys.modules if name.startswith("thor2_jax.service")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert "'.[serve]'" in refused("serve", "--model", run_dir)
