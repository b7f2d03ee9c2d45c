"""The Python code of docs/library.md and docs/objects.md runs, section by section."""

import doctest
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from doc_pages import python_blocks
from helpers import random_clouds, untrained_run

import thor2_jax as thor2
from thor2_jax import recognizer
from thor2_jax.model.run_directory import save_run

PAGE = Path(__file__).parents[2] / "docs" / "library.md"
TEXT = PAGE.read_text()


def code_of(section: str) -> list[str]:
    """Return the Python blocks between the heading `section` and the next heading."""
    content = re.split(r"^#+ ", TEXT.split(f"# {section}\n", 1)[1], maxsplit=1, flags=re.MULTILINE)[0]
    return python_blocks(content)


def run_section(section: str, **names: Any) -> dict[str, Any]:
    """Execute the code of a section, in which `names` are defined, and return all names."""
    for block in code_of(section):
        exec(compile(block, f"docs/library.md: {section}", "exec"), names)
    return names


((XYZ, RGB),) = random_clouds(0, [400])

SECTIONS = {
    "Descriptors as a library": 1,
    "scikit-learn": 2,
    "Persistence of functions on lines": 4,
    "Plots": 1,
    "Gradients": 1,
    "Export": 1,
}
"""Sections with code, and their numbers of blocks; each has a test below."""


def test_every_block_belongs_to_a_tested_section() -> None:
    assert {section: len(code_of(section)) for section in SECTIONS} == SECTIONS
    assert sum(SECTIONS.values()) == TEXT.count("```python\n") == TEXT.count("```") / 2


def test_descriptors() -> None:
    result = run_section("Descriptors as a library", xyz=XYZ, rgb=RGB)["descriptors"]
    assert result.tops.shape == (1, 7168) and result.tops2.shape == (1, 11942) and result.overflow.shape == (1,)


@pytest.mark.slow
def test_gradients_of_colours() -> None:
    names = run_section("Descriptors as a library", xyz=XYZ, rgb=RGB)
    names = run_section("Gradients", **names)
    gradient, colors = names["jax"].grad(names["largest"]), names["clouds"].colors
    assert np.abs(gradient(colors, names["soft"])).max() > 0.01
    assert not np.any(gradient(colors, names["config"]))


def test_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    names = run_section("Descriptors as a library", xyz=XYZ, rgb=RGB)
    names = run_section("Plots", **names)
    assert all(axes.collections for axes in names["figure"].axes)
    names["plt"].close(names["figure"])


@pytest.mark.slow
def test_scikit_learn() -> None:
    cubes, bricks = random_clouds(0, [400] * 4, (0.05, 0.05, 0.05)), random_clouds(1, [400] * 4)
    clouds = [cloud for pair in zip(cubes, bricks, strict=True) for cloud in pair]
    names = run_section("scikit-learn", clouds=clouds, labels=["cube", "brick"] * 4)
    assert names["search"].predict(clouds[:2]).tolist() == ["cube", "brick"]
    assert names["frame"].shape == (8, 7168)


def test_pages_that_use_pandas_say_how_to_install_it() -> None:
    for page in (PAGE, PAGE.parent / "tutorials" / "persistence.ipynb"):
        text = page.read_text().replace("\\", "")
        assert 'set_output(transform="pandas")' in text and "pip install -c constraints.txt pandas" in text


@pytest.mark.slow
def test_persistence() -> None:
    names = run_section("Persistence of functions on lines")
    assert names["images"].shape == (2, 16, 16) and len(names["pairs"]) == int(names["diagrams"].mask[0].sum()) > 0
    shallow, noisy, smooth = names["shallow"], names["noisy"], names["smooth"]
    assert shallow(smooth) < 0.2 * shallow(noisy)
    assert float(smooth.min()) == pytest.approx(float(noisy.min()), abs=0.01)


@pytest.mark.slow
def test_export(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_run(untrained_run(["mug", "bowl"]), "demo-report/run")
    run_section("Export")
    assert (tmp_path / "recognizer.export").stat().st_size > 10_000


@pytest.mark.slow
def test_recognizers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_run(untrained_run(["mug", "bowl"]), "run")
    labels = np.zeros((480, 640), np.uint8)
    labels[200:280, 300:380] = 3
    depth = np.full(labels.shape, 1000, np.uint16)
    depth[labels == 3] = 800
    color = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    frame = thor2.RGBDFrame(color, depth, labels, thor2.Intrinsics(fx=600, fy=600, cx=320, cy=240, depth_scale=1000))
    (code,) = python_blocks((PAGE.parent / "objects.md").read_text())
    exec(compile(code, "docs/objects.md", "exec"), {"frame": frame, "thor2": thor2})
    assert (tmp_path / "run" / "gallery").is_dir()
    labels[20:60, 20:60] = 2
    depth[labels == 2] = 800
    names = {
        "Recognizer": thor2.Recognizer,
        "read_frame": lambda **files: thor2.RGBDFrame(color, depth, labels, frame.intrinsics),
    }
    for example in doctest.DocTestParser().get_examples(str(recognizer.__doc__)):
        exec(compile(example.source, "thor2_jax.recognizer", "exec"), names)
