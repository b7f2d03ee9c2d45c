"""The Python code of the landing page and the first tutorial runs, and the tutorial's command."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from doc_pages import python_blocks
from helpers import run_thor2, untrained_run

import thor2_jax as thor2
from thor2_jax.model.run_directory import save_run

DOCS = Path(__file__).parents[2] / "docs"
SAMPLES = Path(thor2.__path__[0], "service/page/samples")
NAMES = ["mug_blue", "mug_white"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to an empty folder with an untrained run where the demo writes its own."""
    monkeypatch.chdir(tmp_path)
    Path("demo-report").mkdir()
    save_run(untrained_run(NAMES), "demo-report/run")
    return tmp_path


def run_code(page: str, **names: Any) -> dict[str, Any]:
    blocks = python_blocks((DOCS / page).read_text())
    assert len(blocks) == 1
    exec(compile(blocks[0], page, "exec"), names)
    return names


@pytest.mark.slow
def test_landing_page(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_code("index.md")
    assert len(capsys.readouterr().out.splitlines()) == 5


@pytest.mark.slow
def test_first_tutorial(folder: Path) -> None:
    text = (DOCS / "tutorials/first-table.md").read_text()
    (command,) = re.findall(r"thor2 (recognize .*?)^```$", text, re.DOTALL | re.MULTILINE)
    words = shlex.split(command.replace("$samples", str(SAMPLES)).replace("\\\n", " "))
    assert run_thor2(*words) == 0
    answers = json.loads((folder / "answer" / "recognition.json").read_text())
    names = run_code("tutorials/first-table.md")["names"]
    assert len(names) == 5 and str(sorted(names)[0]) in json.dumps(answers)
    assert (folder / "answer" / "overlay.png").is_file()
