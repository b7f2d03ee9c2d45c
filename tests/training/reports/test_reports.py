"""HTML pages, plots and the demo."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from commands import run_thor2
from failures import interrupt_at
from PIL import Image
from playwright.sync_api import Browser
from refusals import assert_refused
from small_runs import SMALL_CONFIG
from written_files import ParsedPage, files_of_the_user

import colornet
from thor2_jax.figures import plain_text
from training import demo
from training.fitting.loop import FitOptions
from training.objects.builtin_objects import builtin_objects
from training.reports import plots
from training.reports.html import Picture, Section, write_page

pytestmark = pytest.mark.usefixtures("drawn_pictures")


def test_page_escapes_its_content(tmp_path: Path) -> None:
    folded = Section("more & more", table=(["all"], [["<i>"]]))
    picture = Picture("p.png", 'the "first"')
    section = Section("A < B", "x & y", (["name", "value"], [["<b>", "1"]]), [picture], folded)
    write_page(tmp_path / "page.html", title="T<script>", lead="l", sections=[section])
    page = ParsedPage((tmp_path / "page.html").read_text())
    assert page.open == [] and {"details", "summary"} <= page.tags
    assert {"more & more", "<i>", "T<script>", "A < B", "x & y", "<b>", 'the "first"'} <= set(page.text)
    assert page.pictures == [{"src": "p.png", "alt": 'the "first"'}]
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]


def test_long_names_fit_a_narrow_page(tmp_path: Path, browser: Browser) -> None:
    write_page(tmp_path / "page.html", title="002_master_chef_can_of_coffee", lead="l" * 50, sections=[])
    page = browser.new_page(viewport={"width": 300, "height": 600})
    page.goto((tmp_path / "page.html").as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == 300
    page.close()


@pytest.mark.parametrize("n_classes", [1, 4, 30])
def test_a_confusion_matrix_shows_all_of_its_label(tmp_path: Path, n_classes: int) -> None:
    """A label that is cut reaches the border of the picture."""
    classes = [f"object {k}" for k in range(n_classes)]
    for name in ("gallery", "embedding + classifiers"):
        plots.draw_confusion(np.eye(n_classes, n_classes + 1, dtype=int), classes, name, tmp_path / "confusion.png")
        pixels = np.asarray(Image.open(tmp_path / "confusion.png").convert("L"))
        padded = np.pad(np.eye(n_classes, n_classes + 1, dtype=int), ((0, 2), (0, 2)))  # two classes do not occur
        plots.draw_confusion(padded, [*classes, "a", "b"], name, tmp_path / "padded.png")
        assert np.array_equal(pixels, np.asarray(Image.open(tmp_path / "padded.png").convert("L")))
        assert all((side == 255).all() for side in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]))


def test_plots_draw_any_name(tmp_path: Path) -> None:
    """Names are no mathtext, and no character is missing from the fonts: matplotlib would raise or warn."""
    names = ["$\\frac{", "$x$", "[red]mug[/x]", "茶碗", "\U0001f34e", "a\u202eb", "Tasse ä"]
    plots.draw_confusion(np.eye(7, 8, dtype=int), names, "THOR2", tmp_path / "confusion.png")
    plots.draw_accuracy(("A",), {name: [0.5] for name in names}, dict.fromkeys(names, 4), tmp_path / "accuracy.png")
    plots.draw_curves({names[0]: [{"epoch": 1, "loss": 1.0, "accuracy": 0.5}]}, tmp_path / "curves.png")
    plots.draw_known_unknown({"kept": [0, 0.5, 1], "named": [0, 0.1, 1]}, (0.5, 0.1), "THOR2", tmp_path / "unknown.png")
    plots.draw_reliability({"answers": [0, 3], "accuracy": [None, 0.5]}, "THOR2", tmp_path / "reliability.png")
    plots.draw_objects(dict.fromkeys(names, builtin_objects()["mug_blue"]), tmp_path / "objects.png")
    points, colors = np.random.default_rng(0).random((200, 3)) * (0.2, 0.1, 0.05) + (0, 0, 1), np.full((200, 3), 200)
    drawn = points, colors.astype(np.uint8), colornet.load_default(), SMALL_CONFIG, names[0]
    plots.draw_descriptor(*drawn, tmp_path / "descriptor.png")
    pictures = [Image.open(path).convert("RGB") for path in tmp_path.iterdir()]
    assert len(pictures) == 7 and all(len(picture.getcolors(2**20)) > 10 for picture in pictures)
    assert plain_text("$x$ a\u202eb") == r"\$x\$ a\u202eb"


def test_pictures_of_the_user_are_not_those_of_a_demo(tmp_path: Path) -> None:
    with files_of_the_user(tmp_path / "pictures" / "scene-0.png"):
        assert_refused("already contains pictures", demo.run_demo, tmp_path)
    assert [path.name for path in tmp_path.rglob("*.*")] == ["scene-0.png"]


@pytest.mark.slow
def test_small_demo_is_interrupted_and_resumes_by_its_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ("mug_blue", "soup_can_red", "cereal_box_yellow", "sponge", "white_bowl")
    everything = builtin_objects()
    monkeypatch.setattr(demo, "builtin_objects", lambda: {name: everything[name] for name in names})
    monkeypatch.setattr(demo, "N_SCENES", 6)
    fit = FitOptions(epochs=4, batch_size=32)
    config = dataclasses.replace(SMALL_CONFIG, n_slices=6, n_strips=16)  # in which the objects do not overflow
    small = {"azimuth_step": 90.0, "polar_step": 45.0, "fit": fit, "config": config}
    monkeypatch.setattr(demo, "PROTOCOL", dataclasses.replace(demo.PROTOCOL, **small))

    for stage, step in (("stage 4 of 5: fit tops", 18), ("recognize scenes", 1)):
        interrupt_at(stage, step, demo.run_demo, tmp_path, 1)
    assert not (tmp_path / "report.html").exists()
    assert_refused("^out: .*seed 1, not 2", demo.run_demo, tmp_path, 2)
    stages: dict[str, tuple[int, int]] = {}
    summaries, run_demo = [], demo.run_demo

    def resumed(out: Path, seed: int, *_: object, workers: int) -> demo.DemoSummary:
        show = lambda stage, done, total, note: stages.update({stage: (done, total)})  # noqa: E731
        summaries.append(run_demo(out, seed, show, workers))
        return summaries[0]

    monkeypatch.setattr(demo, "run_demo", resumed)
    assert run_thor2("demo", "--out", tmp_path, "--seed", 1) == 0
    (summary,) = summaries
    printed = capsys.readouterr().out
    assert f"{summary.accuracy['all'][3]:.3f}" in printed and "report.html" in printed
    assert stages == {"recognize scenes": (6, 6)}
    assert "This call of the command took" in (tmp_path / "report.html").read_text()
    assert_refused("^out: ", run_demo, tmp_path, 1)
    assert summary.names == ("CE", "TOPS", "TOPS2", "THOR2")
    total, *counts = summary.instances.values()
    assert total == sum(counts) > 6 and list(summary.accuracy) == list(summary.instances)
    assert summary.accuracy["all"][3] > 0.4  # chance is 0.2
    page = ParsedPage((tmp_path / "report.html").read_text())
    assert page.open == [] and len(page.pictures) == 11
    assert all((tmp_path / str(picture["src"])).is_file() for picture in page.pictures)
    content = json.loads((tmp_path / "demo.json").read_text())
    assert content["figures"].keys() == dataclasses.asdict(summary).keys()
    assert len(content["instances"]) == summary.instances["all"]
    assert {"frame", "label", "truth", "answers", "occluded", "reason"} <= content["instances"][0].keys()
