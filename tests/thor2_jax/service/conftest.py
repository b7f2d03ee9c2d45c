"""Runs with random weights, a frame, running services that tests share, and their page in headless Chromium."""

import contextlib
import dataclasses
import functools
import json
import re
import shutil
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from fastapi import FastAPI
from image_files import patches, tilted
from page_actions import upload
from playwright.sync_api import Browser, BrowserContext, Page, Route, expect
from processes import HANG, wait_until
from segmentation_scenes import APART, render
from small_runs import save_untrained_run, small_embedding

import thor2_jax as thor2
from thor2_jax.frames.frames import encode_image
from thor2_jax.service import engine
from thor2_jax.service.app import create_app
from thor2_jax.service.pipeline import Service
from thor2_jax.service.settings import Settings

Files = dict[str, bytes]
Open = Callable[..., Page]
"""Type of the fixture `open_page`."""

SAMPLE_INDEX = Path(thor2.__file__).parent / "service" / "page" / "samples" / "index.json"
CLASSES = tuple(sorted({name for sample in json.loads(SAMPLE_INDEX.read_text()) for name in sample["objects"]}))
"""The classes of the run: the objects of the page's sample frames."""


@pytest.fixture(scope="session", autouse=True)
def one_tls_context() -> Iterator[None]:
    """Let all HTTP clients share their certificates, which no test needs: reading them takes 30 ms for each client."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ssl, "create_default_context", functools.cache(ssl.create_default_context))
        yield


@pytest.fixture(scope="session")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options: Any = {"config": thor2.DescriptorConfig(), "record": {"meshes": "/a/local/path"}}
    return save_untrained_run(tmp_path_factory.mktemp("service"), CLASSES, **options)


def write_run(folder: Path, trained: tuple[str, ...] = ("a", "b"), record: dict[str, object] | None = None) -> Path:
    """Write a run with trained classes and a small embedding, which compiles quickly."""
    save_untrained_run(folder, trained, ("tops", "tops2") if trained else (), record=record)
    small_embedding().save(folder / "embedding.safetensors")
    return folder


@pytest.fixture(scope="session")
def teaching_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("teaching") / "run")


@pytest.fixture(scope="session")
def frame() -> thor2.RGBDFrame:
    """A coloured plane with three usable instances and one that is too small."""
    return tilted(patches())


def frame_files(frame: thor2.RGBDFrame, *images: str) -> Files:
    contents = {name: encode_image(getattr(frame, name)) for name in images}
    return contents | {"intrinsics": json.dumps(dataclasses.asdict(frame.intrinsics)).encode()}


@pytest.fixture(scope="session")
def files(frame: thor2.RGBDFrame) -> Files:
    return frame_files(frame, "color", "depth", "labels")


@pytest.fixture(scope="session")
def scene() -> thor2.RGBDFrame:
    """Three boxes apart on a table."""
    return render(APART)


@pytest.fixture(scope="session")
def unlabelled(scene: thor2.RGBDFrame) -> Files:
    """The files of the scene, without labels."""
    return frame_files(scene, "color", "depth")


SERVE = """
import signal, threading
from thor2_jax.service import engine, pipeline
engine.POINT_BUCKETS = (engine.MIN_BATCH_POINTS,)  # the tests send no larger clouds
pipeline.compile_explanations = lambda *_: threading.Event().wait()  # a compilation that never ends
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup, it is ignored
from training.cli import main
main()
"""


class Server:
    """`thor2 serve` in a subprocess, which compiles programs for one padded size of clouds."""

    def __init__(self, run: Path, log: Path, cache: Path, *options: str) -> None:
        self.log = log
        options = ("--port", "0", "--max-batch", "8", "--deadline", str(HANG), "--no-warm-why", *options)
        command = [sys.executable, "-c", SERVE, "serve", "--model", str(run), "--cache", str(cache), *options]
        with log.open("wb") as stream:
            self.process = subprocess.Popen(command, cwd=Path(__file__).parents[3], stdout=stream, stderr=stream)
        wait_until(self._is_ready, log.read_text)
        self.url = re.findall(r"listening at (http://127\.0\.0\.1:\d+)", log.read_text())[0]

    def _is_ready(self) -> bool:
        text = self.log.read_text()
        assert self.process.poll() is None, text
        return "ready: " in text


@pytest.fixture(scope="session")
def start_server(run_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Server]]:
    folder, started = tmp_path_factory.mktemp("servers"), []

    def start(*options: str) -> Server:
        started.append(Server(run_dir, folder / f"{len(started)}.log", folder / "cache", *options))
        return started[-1]

    yield start
    for server in started:
        server.process.kill()
        server.process.wait()


@pytest.fixture(scope="session")
def server(start_server: Callable[..., Server]) -> Server:
    return start_server()


@pytest.fixture(scope="session")
def gallery(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("teaching") / "gallery"


@pytest.fixture(scope="session")
def teaching_app(teaching_run: Path, gallery: Path) -> FastAPI:
    """A service that teaches, with a gallery outside of the run directory."""
    options: dict[str, Any] = {"max_batch": 8, "processes": 1, "deadline": HANG, "warm_why": False}
    return create_app(Settings(teaching_run, gallery=gallery, teach=True, **options))


@contextlib.contextmanager
def served(app: Any, listening: socket.socket, **options: Any) -> Iterator[None]:
    """Serve an application in a thread of this process."""
    server = uvicorn.Server(uvicorn.Config(app, log_config=None, **options))
    thread = threading.Thread(target=server.run, args=([listening],))
    thread.start()
    try:
        yield
    finally:
        server.should_exit = True
        thread.join()


@pytest.fixture(scope="session")
def teaching_url(teaching_app: FastAPI) -> Iterator[str]:
    """Serve it in this process, so that tests can replace functions; yield the URL."""
    with socket.create_server(("127.0.0.1", 0)) as listening, served(teaching_app, listening, ws="none"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(engine, "POINT_BUCKETS", (engine.MIN_BATCH_POINTS,))  # the tests send small clouds
            wait_until(lambda: teaching_app.state.service.state != "starting")
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"


@pytest.fixture
def service(teaching_url: str, teaching_app: FastAPI) -> Service:
    """The service behind this URL, for tests that replace its attributes."""
    return teaching_app.state.service


def remove_gallery(service: Service) -> None:
    """Let the service forget its objects, which it would keep if only their directory were removed."""
    objects = service.engine.objects
    shutil.rmtree(objects.directory, ignore_errors=True)
    objects.gallery = dataclasses.replace(objects.gallery, objects={}, hidden=())


@pytest.fixture
def http(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url, timeout=HANG) as client:
        yield client


@pytest.fixture(scope="session")
def contexts(browser: Browser) -> Callable[[bool], BrowserContext]:
    """The contexts of a computer and of a phone (True), whose pages share a cache."""
    return functools.cache(lambda phone: browser.new_context(is_mobile=phone, has_touch=phone, reduced_motion="reduce"))


@pytest.fixture
def open_page(contexts: Callable[[bool], BrowserContext], request: pytest.FixtureRequest) -> Iterator[Open]:
    """Open the page and upload `files`; afterwards, check that no other server was contacted and no script failed.

    Scripts wait for a tenth of the time.
    """
    pages, sources, urls, errors = [], [], [], []

    def open_one(
        route: Callable[[Route], None] | None = None,
        samples: int = 4,
        url: str = "",
        size: tuple[int, int] = (1280, 720),
        phone: bool = False,
        files: Files | None = None,
    ) -> Page:
        url = url or request.getfixturevalue("server").url
        sources.append(f"{url}/")
        page = contexts(phone).new_page()
        pages.append(page)
        page.set_viewport_size({"width": size[0], "height": size[1]})
        page.add_init_script("const wait = setTimeout; window.setTimeout = (call, ms) => wait(call, ms / 10)")
        page.set_default_timeout(1000 * HANG)
        page.on("request", lambda request: urls.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda line: errors.append(line.text))
        if route is not None:
            page.route("**/v1/**", route)
        page.goto(url)
        expect(page.locator("#samples button")).to_have_count(samples)
        if files is not None:
            upload(page, files)
        return page

    yield open_one
    for page in pages:
        page.unroute_all(behavior="ignoreErrors")
        page.close()
    assert urls and all(url.startswith(tuple(sources)) for url in urls)
    # Error statuses also appear in the console; tests check how the page shows them.
    assert [error for error in errors if "status of" not in error] == []
