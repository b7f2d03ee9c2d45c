"""Fixtures shared by all tests, the thorough tier, and the slow tier's time."""

import os
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Read when JAX is imported and inherited by subprocesses: the processes of a run share their compiled programs, and the
# next run finds them.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", f"{tempfile.gettempdir()}/thor2-jax-tests-{os.getuid()}")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")

EXAMPLES = {"properties": (4, 60), "fuzz": (150, 3000)}
"""Folder of tests -> examples that Hypothesis draws for each, and those with --thorough."""

for folder, numbers in EXAMPLES.items():
    for tier, number in zip(("quick", "thorough"), numbers, strict=True):
        settings.register_profile(
            f"{folder}-{tier}",
            max_examples=number,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
        )

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--thorough", action="store_true", help="many more examples of laws and damaged files")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("thorough"):
        left_out = [item for item in items if item.get_closest_marker("thorough")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = [r for group in terminalreporter.stats.values() for r in group if isinstance(r, pytest.TestReport)]
    slow = [report for report in reports if "slow" in report.keywords]
    if slow:
        seconds, whole = (sum(report.duration for report in some) for some in (slow, reports))
        n_tests = len({report.nodeid for report in slow})
        terminalreporter.write_line(f"slow tier: {n_tests} tests, {seconds:.0f} of {whole:.0f} seconds")


def pytest_collectstart(collector: pytest.Collector) -> None:
    """A test takes the settings that hold while its file is imported."""
    folder = collector.path.parent.name if isinstance(collector, pytest.Module) else ""
    if folder in EXAMPLES:
        settings.load_profile(f"{folder}-{'thorough' if collector.config.getoption('thorough') else 'quick'}")


def pytest_collectreport() -> None:
    """Other folders' tests have Hypothesis as they know it."""
    settings.load_profile("default")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real scans, frames and golden files beside the checkout; skips where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("no shared/ folder with real scans beside the checkout")
    return SHARED


@pytest.fixture(scope="session", params=["objects", "scans"])
def golden_files(request: pytest.FixtureRequest) -> tuple[Path, ...]:
    """Golden files of the built-in objects (tests/golden/make_golden.py), and those of real scans."""
    if request.param == "objects":
        return tuple(sorted((Path(__file__).parent / "golden" / "objects").glob("*.npz")))
    return tuple(sorted((request.getfixturevalue("shared") / "golden").glob("*.npz")))
