"""Training, storing and loading the baselines of a run directory."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import Command
from refusals import assert_refused
from small_clouds import NETWORK, brick_and_stick
from small_runs import random_classifier, save_trained_run
from written_files import killed

import thor2_jax as thor2
from thor2_jax.descriptor.describe import describe
from thor2_jax.model.run_directory import load_run
from training.baselines import job, thor
from training.baselines.baseline import BaselineInputs, FitTask, StoredBaseline, baseline_file
from training.baselines.cloud_baselines import load_forest
from training.baselines.job import CLOUD_BASELINES, check_baselines, load_baselines, train_baselines
from training.evaluation.runs import load_runs
from training.views.normalized_views import MemoryViews, fold_of_views

pytestmark = pytest.mark.usefixtures("small_classifiers")

CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=1, image_size=8)
NAMES = ("red brick", "stick")


class Views(MemoryViews):
    """Views in memory with camera angles, like a rendered dataset: 4 azimuths, 5 polar angles."""

    @property
    def record(self) -> Any:
        return {**super().record, "job": {"azimuth_step": 90, "polar_step": 45}}


SOURCE = Views(brick_and_stick(20), CONFIG)


def write_run(folder: Path, folds: int = 2, fold: int = 1) -> Path:
    return save_trained_run(folder, SOURCE, CONFIG, {"tops": 1.5}, epochs=4, folds=folds, fold=fold)


@pytest.fixture(scope="module")
def trained(module_patch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with the forest, whose training compiles least."""
    folder = write_run(tmp_path_factory.mktemp("baselines") / "run")
    module_patch.setattr("training.baselines.cloud_baselines.TREES", 20)
    train_baselines(folder, SOURCE, ["forest"])
    return folder


@pytest.mark.parametrize("names", [("forest",), pytest.param(CLOUD_BASELINES, marks=pytest.mark.slow)])
def test_baselines_are_calibrated(trained: Path, names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Baselines that a run has are not trained again."""
    monkeypatch.setitem(job._METHODS, "forest", (lambda task: pytest.fail("trained again"), load_forest))
    (trained / "baselines" / ".forest" / "fit").mkdir(parents=True)  # left by a process that was killed at its end
    train_baselines(trained, SOURCE, names)
    killed(trained / "baselines")
    train_baselines(trained, SOURCE, names)
    assert {path.name for path in (trained / "baselines").iterdir()} == {f"{name}.safetensors" for name in names}
    (run,) = load_runs([trained])
    assert run.predictors == ("tops", *names)
    assert set(run.temperatures) == {"tops", *names} and run.temperatures["tops"] == 1.5
    packed = thor2.PointClouds.pack([cloud for each in brick_and_stick(4, 5).values() for cloud in each])
    described: Any = SimpleNamespace(packed=packed, descriptors=describe(packed, NETWORK, CONFIG))
    inputs = BaselineInputs.of_frame(described, CONFIG, None)
    for name, baseline in run.baselines.items():
        probabilities = baseline.predict(inputs)
        np.testing.assert_allclose(probabilities.sum(axis=1), 1, atol=1e-5)
        assert (probabilities.argmax(axis=1) == np.repeat([0, 1], 4)).mean() == 1, name


def test_held_out_set_is_that_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    label, view, marks, stages = np.repeat([0, 1], 20), np.tile(np.arange(20), 2), list[Any](), list[str]()

    def interrupted(task: Any) -> Any:
        marks.append(task.held_out(label, view))
        task.progress("grow forest", 1, 1, "")
        assert_refused("another process", train_baselines, task.directory, SOURCE, ["forest"])
        raise KeyboardInterrupt

    monkeypatch.setattr(job, "_METHODS", {"forest": (interrupted, None)})
    for folds, fold in ((5, 3), (1, 0)):
        folder = write_run(tmp_path / f"{folds}", folds, fold)
        with pytest.raises(KeyboardInterrupt):
            train_baselines(folder, SOURCE, ["forest"], lambda stage, *_: stages.append(stage))
        assert not list((folder / "baselines").glob("*.safetensors"))
    np.testing.assert_array_equal(marks[0], fold_of_views(label, view, NAMES, 5, 0) == 3)
    assert marks[0].sum() == 8 and not marks[1].any() and stages == ["fold 3: grow forest", "grow forest"]


def test_each_view_type_has_every_class(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All views of a class from above are held out, as can happen to a few random ones."""
    above = np.array(["top" in types for types in thor.types_of_views(SOURCE.record["job"])])
    trained: list[set[int]] = []

    def fit(samples: Any, *args: Any, rows: Any) -> Any:
        trained.append(set(samples.label[rows[~args[3][rows]]]))
        return random_classifier(64, 2, 0), 1

    monkeypatch.setattr(thor, "fit", fit)
    monkeypatch.setattr(FitTask, "held_out", lambda task, label, view: (label == 1) & above[view])
    train_baselines(write_run(tmp_path / "run"), SOURCE, ["thor"])
    assert trained == [{0, 1}] * 3


def test_invalid_arguments_are_refused(trained: Path, tmp_path: Path, refused: Command) -> None:
    assert_refused("^dataset: ", train_baselines, trained, Views(brick_and_stick(20, 1), CONFIG), ["forest"])
    assert check_baselines(["pointnet", "thor"], None, tmp_path) == ("thor", "pointnet")
    command = ("train", "--dataset", tmp_path, "--out", tmp_path / "run", "--baselines", "forest, tree")
    assert refused(*command).startswith("error: --baselines is forest, tree; ")
    assert not (tmp_path / "run").exists()


def test_damaged_and_foreign_files_are_refused(trained: Path, tmp_path: Path) -> None:
    folder, whole = write_run(tmp_path / "run"), baseline_file(trained, "forest")
    file, content, stored = baseline_file(folder, "forest"), whole.read_bytes(), StoredBaseline.read(whole, NAMES)
    for write, message in (
        (lambda: stored.write(file, ("a", "b"), 1.0), r"cannot be read \(it has other classes"),
        (lambda: StoredBaseline({}, None).write(file, NAMES, 1.0), "does not match its run"),
        (lambda: file.write_bytes(content[:-9]), "cannot be read"),
        (lambda: file.write_bytes(content[:-1] + bytes([content[-1] ^ 1])), "cannot be read"),
    ):
        write()
        assert_refused(f"forest.safetensors {message}", load_baselines, folder, load_run(folder))
