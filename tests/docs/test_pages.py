"""Every command of the documentation is parsed, every page is found, and every notebook runs."""

import functools
import http.server
import json
import os
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import nbformat
import pytest
import typer
from doc_pages import PAGES, ROOT, thor2_commands
from nbclient import NotebookClient
from playwright.sync_api import Browser
from processes import HANG

from training.cli import app
from training.readers.frames import frame_files

PLACEHOLDER = "..."
COMMANDS = [(page, words) for page in PAGES for words in thor2_commands(page)]
"""Page and arguments of every command."""


def parse(words: list[str]) -> None:
    """Parse a command without running it; raises typer.TyperException or KeyError."""
    command = typer.main.get_command(app)
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
    given = [word for word in words if word != PLACEHOLDER]
    with command.make_context("thor2", given, resilient_parsing=PLACEHOLDER in words):
        pass


def test_commands_parse() -> None:
    assert len(COMMANDS) >= 60
    for page, words in COMMANDS:
        try:
            parse(words)
        except (KeyError, typer.TyperException) as error:
            pytest.fail(f"{page}: {' '.join(words)}: {error!r}")


def test_documented_labels_json_is_read(tmp_path: Path) -> None:
    text = "".join((ROOT / page).read_text(encoding="utf-8") for page in PAGES)
    contents = re.findall(r"`labels\.json`[^`]*`(\{[^`]*\})`", text)
    assert len(contents) == 2
    for content in contents:
        (tmp_path / "labels.json").write_text(content)
        assert frame_files(tmp_path).read_names() == {3: "mug"}


def test_every_documented_command_is_run_by_a_test() -> None:
    """A test names it as a word of its own, as in `run_thor2("train", ...)`."""
    names = {words[0] for _, words in COMMANDS}
    paths = [path for path in (ROOT / "tests").rglob("*.py") if path.parent.name != "docs"]
    tests = "".join(path.read_text(encoding="utf-8") for path in paths)
    assert len(names) >= 12 and {name for name in names if f'"{name}",' not in tests} == set()


def test_every_page_is_two_links_from_the_landing_page() -> None:
    """Links in the text alone; the navigation comes on top."""
    docs = ROOT / "docs"

    def links(page: Path) -> set[Path]:
        text = page.read_text(encoding="utf-8") if page.suffix == ".md" and page.is_file() else ""
        return {(page.parent / link).resolve() for link in re.findall(r"\]\(([\w./-]+\.(?:md|ipynb))[)#]", text)}

    first = links(docs / "index.md")
    pages = {path for path in docs.rglob("*") if path.suffix in {".md", ".ipynb"} and path.stem != "index"}
    written = {docs / "reference" / f"{name}.md" for name in ("command-line", "http")}  # when the site is built
    assert not (pages | written) - first.union(*map(links, first))


NAMES = sorted(path.stem for path in (ROOT / "docs" / "tutorials").glob("*.ipynb"))


def read(name: str) -> Any:
    return nbformat.read(ROOT / "docs" / "tutorials" / f"{name}.ipynb", as_version=4)


def printed(notebook: Any) -> list[str]:
    """Return what each code cell printed, with numbers of one digit only: rounding differs between machines."""
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    texts = ["".join(out.text for out in cell.outputs if out.output_type == "stream") for cell in cells]
    return [re.sub(r"\d*\.\d+", lambda found: f"{float(found[0]):.1f}", text) for text in texts]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_notebook_runs(name: str) -> None:
    notebook = read(name)
    stored = printed(notebook)
    NotebookClient(notebook, timeout=HANG, kernel_name="python3", resources={"metadata": {"path": str(ROOT)}}).execute()
    assert printed(notebook) == stored


@pytest.mark.parametrize("name", NAMES)
def test_stored_outputs_name_no_path(name: str) -> None:
    outputs = [output for cell in read(name).cells if cell.cell_type == "code" for output in cell.outputs]
    assert len(outputs) >= 5
    for output in outputs:
        assert output.output_type in {"stream", "display_data", "execute_result"} and output.get("name") != "stderr"
        text = json.dumps({**output, "data": {**output.get("data", {}), "image/png": ""}})
        assert not re.search(r"/(home|root|tmp|usr|opt|work)/|site-packages", text)


QUESTIONS = {
    "depth unit": "frames",
    "two cameras": "cameras",
    "look-alikes": "explanation/failures",
    "no masks": "segmentation",
    "how fast": "explanation/performance",
    "how much memory": "explanation/performance",
    "several robots": "service",
    "update an object": "objects",
    "why unknown": "unknown-objects",
    "licence": "index",
}
"""Search text of a user -> page that is found first."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason="mkdocs is not installed (extra docs)")
    path = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(path)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    subprocess.run(command, cwd=ROOT, env=environment, check=True, timeout=HANG)
    return path


@pytest.mark.slow
def test_reference_has_constructors_and_fields_of_answers(site: Path) -> None:
    python, requests = [(site / "reference" / f"{name}.html").read_text("utf-8") for name in ("python", "http")]
    assert re.search(r"Recognizer\(\s*run: TrainedRun,\s*unknown_below", re.sub("<[^>]+>", "", python))
    assert 'id="frameanswer"' in requests and requests.count("<td>401</td>") == 1


@pytest.mark.slow
def test_questions_find_their_page_first(browser: Browser, site: Path) -> None:
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(site))
    page, first = browser.new_page(), {}
    page.set_default_timeout(1000 * HANG)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()  # ends with a failing test
        address = f"http://127.0.0.1:{server.server_port}/"
        for question in QUESTIONS:
            page.goto(f"{address}index.html?q={question}")
            link = page.locator(".md-search-result__item a.md-search-result__link").first.get_attribute("href") or ""
            first[question] = link.partition("?")[0].partition("#")[0].removeprefix(address).removesuffix(".html")
        server.shutdown()
    page.close()
    assert first == QUESTIONS
