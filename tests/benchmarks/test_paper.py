"""The paper's comparison: paired differences by hand, and a tiny comparison with every part that resumes."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_thor2
from rendered_objects import write_meshes, write_scene

from benchmarks import paper
from benchmarks.paper import report_text
from benchmarks.paper_measurement import CLAIMS, paired_difference
from training.baselines.job import TITLES
from training.evaluation.answers import fusions


def marks(n_both: int, n_first: int, n_second: int, n_none: int) -> tuple[np.ndarray, np.ndarray]:
    """Return [1, N] marks of two methods by the numbers of instances on which both, one or none is correct."""
    first = np.repeat([1, 1, 0, 0], [n_both, n_first, n_second, n_none]).astype(bool)[None]
    second = np.repeat([1, 0, 1, 0], [n_both, n_first, n_second, n_none]).astype(bool)[None]
    return first, second


def test_independent_instances_match_the_formulas() -> None:
    """The interval is about the normal one, and the test counts the instances on which one method is correct."""
    first, second = marks(120, 45, 20, 15)
    result = paired_difference(first, second, np.arange(200))
    difference = np.repeat([0, 1, -1], [135, 45, 20])
    error = difference.std() / math.sqrt(200)
    assert result.difference == pytest.approx(0.125)
    assert result.low == pytest.approx(0.125 - 1.96 * error, abs=0.1 * error)
    assert result.high == pytest.approx(0.125 + 1.96 * error, abs=0.1 * error)
    tail = sum(math.comb(65, k) for k in range(21)) / 2**65
    assert (result.better, result.worse) == (45, 20) and result.p_value == pytest.approx(2 * tail)
    assert result.verdict == "holds"
    reverse = paired_difference(second, first, np.arange(200))
    assert reverse.verdict == "does not hold" and reverse.difference == -result.difference


def test_neighbouring_frames_do_not_narrow_the_interval() -> None:
    first, second = marks(12, 9, 6, 3)
    once = paired_difference(first, second, np.arange(30))
    often = paired_difference(np.repeat(first, 10, axis=1), np.repeat(second, 10, axis=1), np.repeat(np.arange(30), 10))
    assert (often.low, often.high, often.p_value) == (once.low, once.high, once.p_value)
    assert (often.instances, often.placements) == (300, 30) and once.verdict == "undecided"


def test_folds_are_averaged_before_they_are_compared() -> None:
    """Over three folds, a difference of one third counts for the better method, and thirds that cancel for none."""
    first = np.array([[1, 1, 0, 1], [1, 0, 1, 1], [1, 1, 1, 1]], bool)
    second = np.array([[1, 0, 1, 1], [1, 1, 0, 1], [1, 1, 0, 1]], bool)
    result = paired_difference(first, second, np.arange(4))
    assert result.difference == pytest.approx(1 / 12) and (result.better, result.worse) == (1, 0)


def test_equal_methods_and_single_placements_are_undecided() -> None:
    first, second = marks(3, 0, 0, 2)
    result = paired_difference(first, second, np.arange(5))
    assert (result.low, result.high, result.p_value, result.verdict) == (0, 0, 1, "undecided")
    one = paired_difference(*marks(0, 4, 0, 0), np.zeros(4, int))
    assert one.placements == 1 and one.verdict == "undecided"


NAMES = ("soup_can_red", "yellow_box")


def test_claims_name_columns() -> None:
    titles = fusions([*TITLES, "tops", "tops2", "ce"])
    assert CLAIMS.keys() <= titles.keys() and "THOR2" in titles


def test_weights_are_checked_before_the_comparison_begins(tmp_path: Path) -> None:
    write_meshes(tmp_path / "meshes", NAMES)
    write_scene(tmp_path / "frames" / "0", NAMES, 0)
    names = ["meshes", "frames", "weights", "out"]
    options = [*(f"--{name}={tmp_path / name}" for name in names), "--baselines=rcfusion,thor"]
    with pytest.raises(SystemExit, match=r"^error: weights: .*resnet18\.safetensors does not exist"):
        paper.main(options)
    assert not (tmp_path / "out").exists()


def test_documented_figures_are_those_of_the_results() -> None:
    """The tables of docs/baselines.md and the stored report have the figures of the stored results."""
    root = Path(paper.__file__).parents[1]
    report = json.loads((root / "benchmarks" / "results" / "paper.json").read_text())
    page = (root / "docs" / "baselines.md").read_text()
    scenes, frames = report["datasets"]["scenes"], report["datasets"]["frames"]

    def accuracy(title: str) -> str:
        values = [each["accuracy"]["log-mean"][0]["cells"][0]["accuracy"][title]["mean"] for each in (scenes, frames)]
        return " | ".join(f"{value:.3f}".lstrip("0") for value in values)

    names = {"THOR2": "THOR2 (TOPS + TOPS2)", "CE+TOPS+TOPS2": "CE + TOPS + TOPS2", "TOPS": "TOPS, shape alone"}
    for title in (*names, *(title for title in TITLES.values() if title in scenes["fusions"])):
        name = (names | {"forest": "random forest"}).get(title, title)
        assert f"| {name} | {accuracy(title)} |" in page
    for pair in list(zip(*(each["claims"]["log-mean"] for each in (scenes, frames)), strict=True))[:6]:
        cells = [
            f"{100 * c['difference']:+.1f} ({100 * c['low']:+.1f} to {100 * c['high']:+.1f}), {c['verdict']}"
            for c in pair
        ]
        assert f"| {pair[0]['claim']} | {' | '.join(cells)} |" in page
    text = report_text(report)
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    stored = (root / "benchmarks" / "results" / "paper.md").read_text().splitlines()
    assert lines == [line for line in stored if line.startswith("| ")]
    assert "RGB-D ViT-small, templates: trained from scratch" in text


@pytest.mark.slow
@pytest.mark.usefixtures("small_classifiers", "small_transformers")
def test_a_small_comparison_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model that is lost is trained again, and nothing else; THOR cannot use real views.

    Only the views are rendered in a process of their own.
    """
    meshes, frames = write_meshes(tmp_path / "meshes", NAMES), tmp_path / "frames"
    write_scene(frames / "0", NAMES, 0)
    given = [
        *(f"--meshes={meshes}", f"--frames={frames}", f"--real={frames}", "--folds=1", "--workers=1"),
        *("--baselines=thor,forest,rgbd-vit-small,templates", "--render=--azimuth-step 90 --polar-step 90"),
        "--train=--epochs 1 --batch-size 8",
    ]
    out, commands, popen = tmp_path / "out", [], paper.subprocess.Popen

    def start(command: list[str], **options: Any) -> Any:
        commands.append(command)
        assert "render" in command or run_thor2(*command[3:]) == 0
        return popen(command if "render" in command else "true", **options)

    monkeypatch.setattr(paper.subprocess, "Popen", start)
    paper.main([*given, f"--out={out}"])
    report: dict[str, Any] = json.loads((out / "paper.json").read_text())
    results = report["datasets"]["frames"]
    labelled = [len(json.loads(path.read_text())["labels"]) for path in tmp_path.glob("frames/*/labels.json")]
    assert results["instances"]["scored"] == sum(labelled) > 0
    assert results["scratch"] == ["RGB-D ViT-small", "templates"]
    claims = results["claims"]["max"]
    assert "THOR" not in results["fusions"]
    assert [claim["other"] for claim in claims] == ["TOPS", "CE+TOPS+TOPS2", "RGB-D ViT-small", "templates", "forest"]
    assert list(results["costs"]) == ["render", "THOR2", "forest", "rgbd-vit-small", "templates"]
    assert all(cost["peak_memory_mb"] > 100 and cost["seconds"] > 0 for cost in results["costs"].values())
    accuracy = results["accuracy"]["max"][0]["cells"][0]["accuracy"]
    assert claims[0]["difference"] == pytest.approx(accuracy["THOR2"]["mean"] - accuracy["TOPS"]["mean"])
    assert "joined the views: frames" in (out / "paper.md").read_text()
    assert (out / "paper.png").stat().st_size > 1000

    commands.clear()
    paper.main([*given, f"--out={out}"])
    assert commands == []
    (out / "frames" / "run" / "baselines" / "forest.safetensors").unlink()
    stored = json.loads((out / "frames" / "costs.json").read_text())
    del stored["forest"]
    (out / "frames" / "costs.json").write_text(json.dumps(stored))
    paper.main([*given, f"--out={out}"])
    assert len(commands) == 1 and "forest" in commands[0]
    with pytest.raises(SystemExit, match="folds"):
        paper.main([*given, f"--out={out}", "--folds=2"])
