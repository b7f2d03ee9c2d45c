"""The times of the commands of README and tutorials, in a table of docs/explanation/performance.md.

THOR2_TIMES=1 pytest -n 0 tests/docs/test_times.py    # runs the commands, for ten minutes, and writes the table again
"""

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import trimesh
from doc_pages import ROOT, thor2_commands
from image_files import SAMPLES
from rendered_objects import write_meshes, write_scene

PAGES = ["README.md", *(f"docs/tutorials/{name}.md" for name in ("first-table", "own-objects"))]
UNTIMED = {"fetch": "a download", "serve": "runs until it is ended"}
TABLE = ROOT / "docs" / "explanation" / "performance.md"
ROW = re.compile(r"^\| `(thor2 [^|]*)` \| (–|[\d,]+ s) \| ([\d,]+ s) \|$", re.MULTILINE)
OBJECTS = ["mug_blue", "mug_white", "banana", "soup_can_red", "soup_can_green", "cereal_box_blue"]


def timed_commands() -> dict[str, list[str]]:
    """Return the arguments of the commands that end, by what the table calls them."""
    commands = {}
    for page in PAGES:
        for words in thor2_commands(page):
            if words[0] not in UNTIMED:
                called = " ".join(["thor2", *words])
                commands[called if len(called) < 90 else called.partition(" --color")[0] + " ..."] = words
    return commands


def test_every_command_has_a_time() -> None:
    assert [row[0] for row in ROW.findall(TABLE.read_text(encoding="utf-8"))] == list(timed_commands())


@pytest.mark.skipif("THOR2_TIMES" not in os.environ, reason="THOR2_TIMES is not set; it takes ten minutes")
def test_renew_times(tmp_path: Path) -> None:
    """Run the commands in a folder with the files that they name, and write their times to the table."""
    mesh = trimesh.load_mesh(write_meshes(tmp_path / "meshes", OBJECTS) / "mug_blue.ply")
    mesh.export(tmp_path / "mug.glb")
    for number in range(6):
        write_scene(tmp_path / "my-labelled-frames" / f"{number}", OBJECTS[:4], number)
    for number in range(1, 4):
        write_scene(tmp_path / f"table-{number}", OBJECTS[:4], 10 + number)
    for name, source in {"c.png": "color", "d.png": "depth", "l.png": "mask", "k.json": "intrinsics"}.items():
        shutil.copy(tmp_path / "table-1" / f"{source}{Path(name).suffix}", tmp_path / name)
    rows = []
    for called, words in timed_commands().items():
        if "--out" in words:
            shutil.rmtree(tmp_path / words[words.index("--out") + 1], ignore_errors=True)
        start, before = time.monotonic(), sum(os.times()[2:4])  # of the processes that have ended
        command = [sys.executable, "-m", "training.cli", *(word.replace("$samples", str(SAMPLES)) for word in words)]
        environment = {**os.environ, "XLA_FLAGS": "", "THOR2_CACHE": str(tmp_path / "cache")}
        subprocess.run(command, cwd=tmp_path, env=environment, check=True)
        used = sum(os.times()[2:4]) - before
        rows.append(f"| `{called}` | {time.monotonic() - start:,.0f} s | {used:,.0f} s |")
    text = TABLE.read_text(encoding="utf-8")
    written = list(ROW.finditer(text))
    TABLE.write_text(text[: written[0].start()] + "\n".join(rows) + text[written[-1].end() :], encoding="utf-8")
