"""The table of levers: its rows, its groups, and a tiny table of built-in objects that is interrupted and resumes."""

import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from commands import run_thor2
from rendered_objects import write_meshes, write_scene

from benchmarks import levers
from benchmarks.levers import LEVERS, Lever
from training.evaluation.answers import RULES

NAMES = ("soup_can_red", "yellow_box")


def test_levers_that_differ_in_fusion_share_trainings() -> None:
    long, base = {"train": "--epochs 2"}, {"render": "--base"}
    rows = [Lever("a"), Lever("b", **long), Lever("c", rule="max"), Lever("d", looks=4), Lever("e", fusion="gallery")]
    rows += [Lever("f", fusion="both"), Lever("g", **base, rule="mean"), Lever("h", **long, fusion="CE")]
    groups = [[lever.name for lever in group] for group in levers.grouped(rows)]
    assert groups == [["a", "c"], ["b", "h"], ["d"], ["e", "f"], ["g"]]
    assert (Lever("x").training, Lever("x", **long, **base).training) == ("default", "base_epochs_2")


def test_rows_of_the_table_differ() -> None:
    assert len({lever.name for lever in LEVERS}) == len(LEVERS)
    rows = [(lever.training, lever.looks, lever.fusion, lever.rule) for lever in LEVERS]
    assert len(set(rows)) == len(rows) and {lever.rule for lever in LEVERS} <= set(RULES)


def run_command(monkeypatch: pytest.MonkeyPatch, *arguments: Any) -> None:
    monkeypatch.setattr("sys.argv", ["levers", *map(str, arguments)])
    levers.main()


@pytest.mark.slow
@pytest.mark.usefixtures("small_classifiers")
def test_a_small_table_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its commands run in this process."""
    meshes, frames = write_meshes(tmp_path / "meshes", NAMES), tmp_path / "frames"
    write_scene(frames / "0", (*NAMES, "mug_white"), 0)
    given = [
        *("--meshes", meshes, "--frames", frames, "--cameras", "none", "--workers", 1),
        "--render=--azimuth-step 180 --polar-step 90 --registration --base --copies 1",
        "--train=--epochs 1 --batch-size 8 --classifiers tops,tops2 --embedding 0",
    ]
    out = tmp_path / "out"
    rows = "default", 'fusion rule "max"'
    small = Lever(rows[0]), Lever(rows[1], rule="max"), Lever("gallery", fusion="gallery")
    monkeypatch.setattr(levers, "LEVERS", small)
    monkeypatch.setattr(levers, "mesh_views", partial(levers.mesh_views, cameras=4))
    monkeypatch.setattr("subprocess.run", lambda command, **_: SimpleNamespace(returncode=run_thor2(*command[3:])))
    run_command(monkeypatch, *given, "--out", out, "--seeds", 1, "--levers", *rows)
    first = {path: path.stat().st_mtime_ns for path in out.rglob("seed-0.json")}
    assert len(first) == 2 and [path.name for path in (out / "runs").iterdir()] == ["default"]

    trained: list[Any] = []
    train = levers.Table.train
    monkeypatch.setattr(levers.Table, "train", lambda *a: trained.append(a[1:]) or train(*a))
    run_command(monkeypatch, *given, "--out", out, "--seeds", 2, "--levers", *rows)
    run_command(monkeypatch, *given, "--out", out, "--seeds", 1, "--levers", "gallery")
    assert [(lever.name, seed) for lever, seed in trained] == [("default", 1), ("gallery", 0)]
    assert sorted(path.name for path in (out / "runs" / "default").iterdir()) == ["seed-0", "seed-1"]
    assert all(path.stat().st_mtime_ns == time for path, time in first.items())
    report = json.loads((out / "levers.json").read_text())
    assert list(report) == [*rows, "gallery"]
    cell = json.loads((out / "cells" / "default" / "seed-0.json").read_text())["results"]["original"]
    assert cell["instances"] == 2 and cell["unknown_instances"] == 1
    assert report["default"]["original"]["accuracy"]["mean"] == cell["accuracy"]
    run_command(monkeypatch, *given, "--out", out, "--seeds", 2, "--levers", *rows)
    report = json.loads((out / "levers.json").read_text())
    assert list(report) == list(rows) and report["default"]["original"]["accuracy"]["runs"] == 2
    assert len((out / "levers.md").read_text().splitlines()) == 2 + 2 and len(trained) == 2

    with pytest.raises(SystemExit):
        run_command(monkeypatch, *given, "--out", out, "--ignore", "mug*")
