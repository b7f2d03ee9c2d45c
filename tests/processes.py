"""Processes and programs that tests start; they end with the process of the tests, even if that is killed."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle

MARK = "THOR2_TESTS"
"""Environment variable whose value, one for each process of tests, the processes inherit that it starts."""

HANG = 900.0
"""Seconds after which a test gives up: ten times the longest wait that was seen on a busy machine."""

UNOPTIMIZED = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)
"""XLA_FLAGS with which programs compile in a third of the time."""

_GUARD = """
import os, signal, sys
from pathlib import Path
mark = f"{sys.argv[1]}={sys.argv[2]}".encode()
sys.stdin.read()  # ends when all processes that hold the other end of the pipe have ended: the process of the tests
for folder in Path("/proc").glob("[0-9]*"):
    try:
        if mark in (folder / "environ").read_bytes().split(b"\\0"):
            os.kill(int(folder.name), signal.SIGKILL)
    except OSError:  # it has ended, or belongs to another user
        pass
"""


def end_descendants_with_this_process() -> None:
    """Start a process that kills what this one has started and left behind, once this one has ended in any way.

    It does nothing on systems without /proc.
    """
    os.environ.pop(MARK, None)
    value = f"{os.getpid()}-{time.time_ns()}"
    command = [sys.executable, "-S", "-E", "-c", _GUARD, MARK, value]
    read, _ = os.pipe()  # the end for writing is closed when this process ends
    os.posix_spawn(command[0], command, os.environ, file_actions=[(os.POSIX_SPAWN_DUP2, read, 0)], setsid=True)
    os.close(read)
    os.environ[MARK] = value


def wait_until(
    condition: Callable[[], object], explain: Callable[[], str] = str, pause: Callable[[float], object] = time.sleep
) -> None:
    """Wait until a condition holds, at most `HANG` seconds; `explain` gives the message of the failure."""
    until = time.monotonic() + HANG
    while not condition():
        assert time.monotonic() < until, explain()
        pause(0.02)


def is_running(pid: int) -> bool:
    """Return whether a process runs, by /proc; one that has ended and is not collected does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def call_pickled(content: bytes) -> Any:
    """Call a function with arguments, both pickled by cloudpickle, in the process that a test started."""
    function, arguments = cloudpickle.loads(content)
    return function(*arguments)


def free_port() -> int:
    """Return a TCP port that no process listens on."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return int(free.getsockname()[1])


def run_python(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run Python with these arguments and return its exit status and its output."""
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=HANG)


def start_program(code: str, *arguments: object, devices: int = 1) -> subprocess.Popen[str]:
    """Start a Python program on the CPU, which JAX divides into some devices."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish_programs(*processes: subprocess.Popen[str]) -> list[str]:
    """Wait for programs, assert that none failed, and return what each wrote to standard output."""
    outputs = []
    try:
        for process in processes:
            out, err = process.communicate(timeout=HANG)
            assert process.returncode == 0, err[-3000:]
            outputs.append(out)
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    return outputs
