"""Worker pools: order of the results, memory, and processes that die."""

import platform
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from processes import finish_programs, is_running, start_program, wait_until
from refusals import assert_refused

from training.storage.workers import IN_PROCESS, local_workers, ray_workers

# A worker cannot import functions of a test file; it can import `eval`, whose items contain the work.
SLOW_FIRST = ["__import__('time').sleep(0.3) or 0", *map(str, range(1, 9))]


@pytest.mark.parametrize("workers", [1, 2])
def test_results_keep_the_order_of_lazily_drawn_items(workers: int) -> None:
    drawn: list[str] = []

    def items() -> Iterator[str]:
        for item in SLOW_FIRST:
            drawn.append(item)
            yield item

    values, ahead = [], []
    with closing(local_workers(workers)(eval, items())) as results:
        for result in results:
            values.append(result)
            ahead.append(len(drawn) - len(values))
    assert values == list(range(9))
    assert max(ahead) == (0 if workers == 1 else workers)


def test_no_items_give_no_results() -> None:
    assert list(IN_PROCESS(eval, [])) == list(local_workers(2)(eval, [])) == []


@pytest.mark.slow
def test_ctrl_c_is_blocked_from_the_start_of_a_worker() -> None:
    (blocked,) = local_workers(2)(eval, ["__import__('signal').pthread_sigmask(0, ())"])
    assert signal.SIGINT in blocked and signal.SIGTERM not in blocked


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_exceptions_of_the_function_are_raised(workers: int) -> None:
    with pytest.raises(ZeroDivisionError), closing(local_workers(workers)(eval, ["1", "1 / 0", "2"])) as results:
        list(results)


def test_an_address_that_is_none_of_a_cluster() -> None:
    pytest.importorskip("ray", reason="the extra [cluster] is not installed")
    assert_refused("engine is ray; expected HOST:PORT", list, ray_workers(1, "a")(eval, ["1"]))
    for address in ("127.0.0.1:1", "ray://127.0.0.1:1", "[::1]:99999"):
        refused = f"address is {re.escape(address)}, which cannot be reached"
        assert_refused(refused, list, ray_workers(1, address)(eval, ["1"]))


@pytest.mark.slow
def test_a_dead_worker_costs_its_item_only(tmp_path: Path) -> None:
    """The item of the worker that dies is computed again, the other worker continues, and the dead one is replaced."""
    logged = f"open({str(tmp_path / 'log')!r}, 'a').write('%s ') and %s"
    once = f"(__import__('os')._exit(3) if open({str(tmp_path / 'log')!r}).read().count('b') == 1 else 1)"
    items = [logged % ("a", "__import__('time').sleep(1) or 0"), logged % ("b", once)]
    items += [logged % (name, "__import__('os').getpid()") for name in "cdef"]
    with closing(local_workers(2)(eval, items)) as results:
        first, second, *others = results
    assert (first, second) == (0, 1) and len(set(others)) <= 2
    written = (tmp_path / "log").read_text().split()
    assert sorted(written) == sorted("abbcdef") and written.count("a") == 1


@pytest.mark.slow
def test_an_item_at_which_every_worker_dies_is_an_error() -> None:
    results = local_workers(2)(eval, ["1", "__import__('os')._exit(3)", "2", "3"])
    with pytest.raises(ChildProcessError, match="3 worker processes"), closing(results):
        list(results)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_workers_end_with_a_parent_that_is_killed() -> None:
    program = """
from training.storage.workers import local_workers
number, long = "__import__('time').sleep(0.5) or __import__('os').getpid()", "__import__('time').sleep(10_000)"
results = local_workers(2)(eval, [number, number, long, long])
print(next(results), next(results), flush=True)
next(results)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        workers = [int(pid) for pid in parent.stdout.readline().split()]
        assert workers and all(is_running(pid) for pid in workers)
        parent.send_signal(signal.SIGKILL)
    wait_until(lambda: not any(map(is_running, workers)))


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has no such options")
def test_freed_memory_is_used_again() -> None:
    script = """
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from resource import getpagesize
from training.storage.workers import keep_freed_memory

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * getpagesize()

def kept():
    before = resident()
    bytearray(2**27)
    return resident() - before

print(kept())
keep_freed_memory()
print(kept(), ThreadPoolExecutor(1).submit(kept).result())
"""
    (out,) = finish_programs(start_program(script))
    returned, kept, kept_again = map(int, out.split())
    # The second block of 128 MB is where the first one was, though another thread asks for it.
    assert returned < 2**25 and kept > 2**26 and kept_again < 2**25
