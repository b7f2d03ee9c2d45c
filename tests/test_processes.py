"""Nothing that tests start outlives them."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from processes import is_running, wait_until

PROGRAM = """
import subprocess, sys
from processes import end_descendants_with_this_process
end_descendants_with_this_process()
server = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(10_000)"], start_new_session=True)
print(server.pid, flush=True)
sys.stdin.read()
"""


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="looks for processes in /proc")
def test_a_server_ends_with_the_tests_that_started_it() -> None:
    command = [sys.executable, "-c", PROGRAM]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as tests:
        assert tests.stdout is not None
        server = int(tests.stdout.readline())
        tests.send_signal(signal.SIGKILL)
    wait_until(lambda: not is_running(server))
