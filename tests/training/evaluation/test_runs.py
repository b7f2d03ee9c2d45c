"""Loading runs, and which runs can be evaluated together."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from image_files import patches, tilted
from refusals import assert_refused
from small_clouds import NETWORK, random_clouds
from small_runs import save_untrained_run, untrained_embedding_run, with_surfaces

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.looks import describe_looks
from thor2_jax.model.fusion import Calibration
from thor2_jax.model.run_directory import save_run
from thor2_jax.recognizer import Recognizer
from thor2_jax.types import PointClouds
from training.baselines.baseline import baseline_file
from training.evaluation.runs import load_runs, load_sequence_runs

pytestmark = pytest.mark.usefixtures("small_classifiers", "small_buckets")

CONFIG = DescriptorConfig(homology="closed_form", n_slices=1, n_strips=3)


def make(folder: Path, classes: Sequence[str] = ("a", "b"), seed: int = 0, config: DescriptorConfig = CONFIG) -> Path:
    """Write an untrained run with CE only."""
    return save_untrained_run(folder, classes, ("ce",), config, seed=seed)


def test_folds_have_names_and_digests(tmp_path: Path) -> None:
    for fold in range(2):
        make(tmp_path / f"both/fold-{fold}", seed=fold)
    runs = load_runs([tmp_path / "both"])
    assert [run.name for run in runs] == ["both/fold-0", "both/fold-1"]
    assert len({run.digest for run in runs}) == 2
    file = baseline_file(tmp_path / "both" / "fold-0", "forest")
    file.parent.mkdir()
    file.with_name(f".{file.stem}.x{file.suffix}").touch()  # left by a killed process
    assert [run.digest for run in load_runs([tmp_path / "both"])] == [run.digest for run in runs]


def test_incompatible_runs_are_refused(tmp_path: Path) -> None:
    first = make(tmp_path / "first")
    for message, other in (
        ("different classes (c, d, e, f, g, ..., i)", make(tmp_path / "classes", tuple("abcdefghi"))),
        ("different classes (in another order)", make(tmp_path / "order", ("b", "a"))),
        ("different descriptors", make(tmp_path / "config", config=dataclasses.replace(CONFIG, alpha=0.5))),
        ("the same run", first),
        ("run.json", tmp_path),
    ):
        assert_refused(f"^model: .*{other}.*{re.escape(message)}", load_runs, [first, other])


def test_each_sequence_is_answered_by_its_run(tmp_path: Path) -> None:
    for fold in range(2):
        make(tmp_path / f"runs/bottom/s1/fold-{fold}", ("b", "c"), seed=fold)
        make(tmp_path / f"runs/s2/fold-{fold}", ("a", "b"), seed=2 + fold)
    runs = load_sequence_runs(tmp_path / "runs", ["x/bottom/s1/f1", "x/bottom/s1/f2", "x/top/s2/f1"])
    assert [run.name for run in runs] == ["runs/*/fold-0", "runs/*/fold-1"]
    assert all(run.classes == ("a", "b", "c") and run.predictors == ("ce",) for run in runs)
    assert runs[0].digest != runs[1].digest
    assert [run.digest for run in load_sequence_runs(tmp_path / "runs", ["x/top/s2/f1"])] != [r.digest for r in runs]

    clouds = PointClouds.pack(random_clouds(0, [50] * 3))
    described = SimpleNamespace(oriented=describe_looks(clouds, NETWORK, CONFIG), packed=clouds)
    for fold, run in enumerate(runs):
        for frame, own, columns in (("x/bottom/s1/f2", "bottom/s1", [1, 2]), ("x/top/s2/f1", "s2", [0, 1])):
            (alone,) = load_runs([tmp_path / "runs" / own / f"fold-{fold}"])
            values = run.probabilities(frame, described, None)["ce"]  # type: ignore[arg-type]
            expected = np.zeros((3, 3))
            expected[:, columns] = alone.probabilities(frame, described, None)["ce"]  # type: ignore[arg-type]
            np.testing.assert_array_equal(values, expected.astype(np.float32))


def test_confidences_are_those_of_recognition(tmp_path: Path) -> None:
    """Instances are compared with surfaces, too, and with an object that is enrolled."""
    record = {"calibration": dataclasses.asdict(Calibration(0.0, 1.0, 1.0, 0.5, 0.1))}
    save_run(with_surfaces(untrained_embedding_run(("a", "b"), record=record)), tmp_path / "run")
    recognizer, frame = Recognizer.load(tmp_path / "run"), tilted(patches())
    for column in ("embedding", "both"):
        if column == "both":
            recognizer.enroll("tall", [(frame, 200)])
        (run,) = load_runs([tmp_path / "run"])
        values = run.probabilities("", recognizer.describe(frame), None)[column]
        expected = [answer.confidence for answer in recognizer.recognize(frame) if answer.confidence is not None]
        assert len(expected) > 1 and values.max(axis=1)[: len(expected)] == pytest.approx(expected, rel=1e-5)


def test_incompatible_sequence_runs_are_refused(tmp_path: Path) -> None:
    make(tmp_path / "runs/s1")
    make(tmp_path / "runs/s2/fold-0")
    make(tmp_path / "runs/s2/fold-1", seed=1)
    make(tmp_path / "runs/s3", config=dataclasses.replace(CONFIG, alpha=0.5))
    (tmp_path / "runs" / "s4").mkdir()
    for other, message in (
        ("s2", "different folds, classifiers or baselines"),
        ("s3", "different descriptors or colour networks"),
        ("s4", "s4"),
        ("s5", "has no run for s5"),
    ):
        assert_refused(f"^model: .*{message}", load_sequence_runs, tmp_path / "runs", ["s1/frame", f"{other}/frame"])
