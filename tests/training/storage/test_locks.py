"""Exclusive locks on output directories."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from thor2_jax.errors import InputError
from training.storage.jobs import LOCK, locked

HOLDER = """
import sys, time
from pathlib import Path
from training.storage.jobs import locked
with locked(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(10_000)
"""


def test_a_lock_excludes_others_until_its_end(tmp_path: Path) -> None:
    for _ in range(2):
        with locked(tmp_path):
            with pytest.raises(InputError, match=str(tmp_path)), locked(tmp_path):
                pass
    with pytest.raises(ZeroDivisionError), locked(tmp_path):
        1 / 0  # noqa: B018
    with locked(tmp_path):
        assert [path.name for path in tmp_path.iterdir()] == [LOCK]


def test_a_lock_ends_with_a_killed_process(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "locked\n"
        with pytest.raises(InputError), locked(tmp_path):
            pass
        holder.send_signal(signal.SIGKILL)
        assert holder.wait() == -signal.SIGKILL
    with locked(tmp_path):
        pass
