"""From views to a run folder."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import thor2_jax as thor2
from thor2_jax.run_folder import load_run
from training import train as module
from training.dataset import Cloud
from training.fit import FitOptions
from training.train import train_run

CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=3, n_strips=8, image_size=8)
OPTIONS = FitOptions(epochs=2, batch_size=4)


def views() -> dict[str, list[Cloud]]:
    rng = np.random.default_rng(0)
    out: dict[str, list[Cloud]] = {}
    for name, size, level in (("red brick", (0.1, 0.05, 0.03), 0), ("stick", (0.2, 0.01, 0.01), 255)):
        out[name] = [
            ((rng.random((200, 3)) * size + [0, 0, 0.5]).astype(np.float32), np.full((200, 3), level, np.uint8))
            for _ in range(3)
        ]
    return out


def test_a_run_is_written_and_told_of(tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []

    def progress(stage: str, done: int, total: int, note: str) -> None:
        told.append((stage, done, total))
        assert note

    run = train_run(views(), tmp_path / "run", ["tops"], OPTIONS, progress, CONFIG)
    assert run.classes == ("red brick", "stick") and tuple(run.classifiers) == ("tops",)
    assert told == [("describe", 3, 6), ("describe", 6, 6), ("fit tops", 1, 2), ("fit tops", 2, 2)]
    found = load_run(tmp_path / "run")
    assert (found.classes, found.config, found.record) == (run.classes, CONFIG, run.record)
    assert found.record["views"] == {"red brick": 3, "stick": 3} and found.record["samples"] == 24
    assert [row["epoch"] for row in found.record["curves"]["tops"]] == [1, 2]
    for name, model in run.classifiers.items():
        np.testing.assert_array_equal(model.head.kernel[...], found.classifiers[name].head.kernel[...])
    assert json.loads((tmp_path / "run" / "run.json").read_text())["record"]["batch_size"] == 4


def test_bad_input_is_told_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def work(*_: Any, **__: Any) -> None:
        raise AssertionError("work was begun")

    monkeypatch.setattr(module, "build_dataset", work)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "kept").write_text("x")
    with pytest.raises(thor2.InputError, match=f"out: {tmp_path / 'run'} exists already"):
        train_run(views(), tmp_path / "run", ["tops"], OPTIONS)
    with pytest.raises(thor2.InputError, match=r"classifiers is \['shape'\]"):
        train_run(views(), tmp_path / "new", ["shape"], OPTIONS)
    assert [p.name for p in tmp_path.rglob("*")] == ["run", "kept"]


@pytest.mark.parametrize("bad", [{}, {"mug": []}, {"mug": views()["stick"]}])
def test_nothing_is_written_when_training_fails(bad: dict[str, list[Cloud]], tmp_path: Path) -> None:
    with pytest.raises(thor2.InputError):
        train_run(bad, tmp_path / "run", ["tops"], OPTIONS, config=CONFIG)
    assert list(tmp_path.iterdir()) == []
