"""Fixtures shared by all tests, the tiers of tests, and the compilation cache."""

import asyncio
import dataclasses
import functools
import gc
import json
import os
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, settings
from processes import HANG, UNOPTIMIZED, end_descendants_with_this_process

if TYPE_CHECKING:
    from playwright.sync_api import Browser

# JAX reads these variables when it is imported. The process that distributes the tests does not import it.
os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # as the command line sets it
# Most of the time of the tests is compilation, which takes a third of it without optimization. CI also compares the
# golden files with the programs that users compile.
os.environ.setdefault("XLA_FLAGS", UNOPTIMIZED)
# Tracing allocates many objects that stay, so that older generations are practically never collected.
gc.set_threshold(100_000, 1000, 1000)
# Programs that tests start import the packages of this checkout and the modules of this directory.
PATHS = [str(Path(__file__).parents[1]), str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, PATHS))
# Subprocesses inherit these: the processes of a run share their compiled programs, and the next run finds them.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", f"{tempfile.gettempdir()}/thor2-jax-tests-{os.getuid()}")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("THOR2_CACHE", "off")  # commands keep no programs in the home directory

EXAMPLES = {"properties": (4, 60), "fuzz": (150, 3000)}
"""Directory of tests -> number of Hypothesis examples for each test, by default and with --thorough."""

settings.register_profile("default", deadline=None)  # no test may depend on the speed of the machine
settings.load_profile("default")

STRICT = ("descriptor", "golden", "properties")
"""Directories whose tests allow no implicit dtype promotion; Flax, which other tests use, relies on it."""

SHARED = Path(__file__).resolve().parents[1].parent / "shared"

signal.signal(signal.SIGINT, signal.default_int_handler)  # A background job starts with it ignored.

end_descendants_with_this_process()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--thorough", action="store_true", help="run all tests, with many more examples of each property")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give the tests of a folder to one process, if they are distributed by files: they share servers and programs."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file: str = super()._split_scope(nodeid)
            return file.rpartition("/")[0]

    return Scheduling(config, log) if config.getoption("dist") == "loadfile" else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out slow tests unless --thorough or -m selects them, or they are named by their file and `::`."""
    if config.getoption("thorough") or config.getoption("markexpr") or any("::" in arg for arg in config.args):
        return
    slow = [item for item in items if item.get_closest_marker("slow")]
    config.hook.pytest_deselected(items=slow)
    items[:] = [item for item in items if not item.get_closest_marker("slow")]


def pytest_collectstart(collector: pytest.Collector) -> None:
    """Load the profile of a directory: tests keep the settings that are active while their file is imported."""
    folder = collector.path.parent.name if isinstance(collector, pytest.Module) else ""
    if folder in EXAMPLES:
        settings.register_profile(
            folder,
            max_examples=EXAMPLES[folder][collector.config.getoption("thorough")],
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
        )
        settings.load_profile(folder)


def pytest_collection_finish() -> None:
    """Exclude imported objects from garbage collections: they stay, and are half of all objects."""
    gc.freeze()


def pytest_sessionfinish() -> None:
    """Collect garbage once; pytest would collect all objects five times, and the interpreter again."""
    gc.collect()
    gc.freeze()


def pytest_collectreport() -> None:
    """Restore the default settings of Hypothesis for other directories."""
    settings.load_profile("default")


@pytest.fixture(autouse=True)
def strict_dtype_promotion(request: pytest.FixtureRequest) -> Iterator[None]:
    import jax

    with jax.numpy_dtype_promotion("strict" if request.path.parent.name in STRICT else "standard"):
        yield


@pytest.fixture
def x64(strict_dtype_promotion: None) -> Iterator[None]:
    """Compute in float64; constants of the engine stay float32 and are promoted."""
    import jax

    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(autouse=True)
def no_running_loop(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let tests without the browser call asyncio.run: the event loop of Playwright counts as running until it ends."""
    loop = None if "browser" in request.fixturenames else asyncio._get_running_loop()
    if loop is not None:
        asyncio._set_running_loop(None)
    yield
    if loop is not None:
        asyncio._set_running_loop(loop)


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    """Headless Chromium, for the tests of the pages."""
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=1000 * HANG)
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not installed (apt-get install chromium)")
    with sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=chromium)


@pytest.fixture
def texts(capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[str, str]]:
    """Return a function that runs a command, which must have a status, and returns its standard output and error."""

    def run(*arguments: object, status: int = 0) -> tuple[str, str]:
        from commands import run_thor2

        capfd.readouterr()
        assert run_thor2(*arguments) == status
        return capfd.readouterr()

    return run


@pytest.fixture
def printed(texts: Callable[..., tuple[str, str]]) -> Callable[..., str]:
    """Return a function that runs a command, which must succeed, and returns what it prints."""
    return lambda *arguments: texts(*arguments)[0]


@pytest.fixture
def refused(texts: Callable[..., tuple[str, str]]) -> Callable[..., str]:
    """Return a function that runs a command, which must fail, and returns the line that says why.

    Commands that fail before they begin their work print nothing else; others do if `at_once` is False.
    """

    def run(*arguments: object, at_once: bool = True) -> str:
        out, error = texts(*arguments, status=2)
        *others, line = error.splitlines()
        assert line.startswith("error: ") and not any("error: " in other or "Traceback" in other for other in others)
        assert not at_once or (out, others) == ("", []), error
        return line

    return run


@pytest.fixture
def messages(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The messages that `thor2 watch` publishes; it is interrupted when it waits for Ctrl-C."""
    from thor2_jax.watch.live import Broadcast

    published: list[dict[str, Any]] = []
    publish = Broadcast.publish

    def record(self: Broadcast, text: str) -> None:
        published.append(json.loads(text))
        publish(self, text)
        if published[-1]["state"] == "ended":
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Broadcast, "publish", record)
    monkeypatch.setattr("training.cli.watch.NOTICE_SECONDS", 0.0)
    return published


@pytest.fixture(scope="module")
def module_patch() -> Iterator[pytest.MonkeyPatch]:
    """Replaces attributes for the tests of a file."""
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def small_classifiers(module_patch: pytest.MonkeyPatch) -> None:
    """Let classifiers have two small hidden layers: a training and its checkpoints take a third of the time.

    Other processes have to be given the layers, since they do not see the change.
    """
    module_patch.setattr("thor2_jax.networks.networks.HIDDEN", (32, 16))


@pytest.fixture(scope="module")
def small_buckets(module_patch: pytest.MonkeyPatch) -> None:
    """Let batches have the padded size of small clouds."""
    module_patch.setattr("thor2_jax.capacity.MIN_BATCH_POINTS", 512)


@pytest.fixture(scope="module")
def small_transformers(module_patch: pytest.MonkeyPatch) -> None:
    """Give the vision transformers one block and, but DINOv2, narrow tokens and images of 32 pixels."""
    from training.baselines import image_baselines
    from training.baselines import image_networks as networks

    for name in ("rgbd-vit-small", "vit-cnn-small"):
        network, vit = image_baselines.ARCHITECTURES[name], dataclasses.replace(networks.VIT_TINY, width=96, depth=1)
        small = dataclasses.replace(network, create=functools.partial(network.create, vit=vit, size=32), size=32)
        module_patch.setitem(image_baselines.ARCHITECTURES, name, small)
    module_patch.setattr(networks, "VIT_DINOV2_SMALL", dataclasses.replace(networks.VIT_DINOV2_SMALL, depth=1))


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Directory of two meshes, a red brick and a green box."""
    from rendered_objects import write_box

    folder = tmp_path_factory.mktemp("meshes")
    write_box(folder / "brick.ply", (0.05, 0.03, 0.1), (200, 40, 40))
    write_box(folder / "box.ply", (0.05, 0.05, 0.05), (40, 200, 90))
    return folder


@pytest.fixture(scope="session")
def shared() -> Path:
    """Directory of real scans, frames and golden files beside the checkout; skips the test if it is absent."""
    if not SHARED.is_dir():
        pytest.skip("no shared/ directory with real scans beside the checkout")
    return SHARED


@pytest.fixture(scope="session", params=["objects", "scans"])
def golden_files(request: pytest.FixtureRequest) -> tuple[Path, ...]:
    """Golden files of the built-in objects (tests/golden/make_golden.py), and those of real scans."""
    if request.param == "objects":
        return tuple(sorted((Path(__file__).parent / "golden" / "objects").glob("*.npz")))
    return tuple(sorted((request.getfixturevalue("shared") / "golden").glob("*.npz")))
