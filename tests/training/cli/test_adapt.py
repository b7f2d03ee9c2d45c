"""`thor2 adapt`, and the commands that use the adapted run; the run's weights are random."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import Command, json_lines, run_thor2
from image_files import write_frame
from refusals import assert_refused
from small_runs import save_untrained_run

from thor2_jax import recognizer as module
from thor2_jax.adaptation.estimate import Adaptation
from thor2_jax.model.model import ColorTransform
from thor2_jax.recognizer import Recognizer
from training.evaluation.runs import load_runs
from training.readers.frames import frame_files

pytestmark = pytest.mark.usefixtures("small_classifiers", "small_embedding")

OBJECTS = {1: "brick", 2: "book", 3: "leaf"}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = save_untrained_run(tmp_path_factory.mktemp("model"), tuple(OBJECTS.values()), ("tops", "tops2"), seed=1)
    (directory / "metrics.jsonl").write_text("{}\n")
    (directory / "checkpoints").mkdir()
    return directory


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("frames")
    for number in range(4):
        write_frame(directory / f"{number}", OBJECTS, number)
        (directory / f"{number}" / "labels.json").unlink()
    return directory


@pytest.fixture(scope="module", params=["given", pytest.param("estimated", marks=pytest.mark.slow)])
def adapted(request: pytest.FixtureRequest, model: Path, video: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("adapted") / "run"
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "given":  # tests/thor2_jax/adaptation has those of the estimate
            transform = ColorTransform(warmth=0.2)
            patch.setattr(module, "estimate_transform", lambda each, *_: Adaptation(transform, len(each), 0.5, 0.4))
        assert run_thor2("adapt", "--model", model, video, "--out", out, "--quiet") == 0
    return out


def test_the_copy_differs_in_its_record_only(model: Path, adapted: Path) -> None:
    transform = Recognizer.load(adapted).color_transform
    assert transform is not None and transform != type(transform)()
    before, after = (json.loads((run / "run.json").read_bytes()) for run in (model, adapted))
    assert after["record"].pop("color_transform") == vars(transform)
    assert after["record"].pop("adapted_to") == {"instances": 12}
    assert before == after
    assert {path.name for path in adapted.iterdir()} == {path.name for path in model.iterdir()} - {"checkpoints"}


def test_recognize_corrects_the_colors(model: Path, adapted: Path, video: Path, printed: Command) -> None:
    confidences = []
    for run in (model, adapted):
        (answer,) = json_lines(printed("recognize", "--model", run, video / "0", "--json"))
        confidences.append([one["confidence"] for one in answer["instances"]])
    assert np.abs(np.subtract(*confidences)).max() > 1e-4
    assert_refused("adapted to different cameras", load_runs, [model, adapted])


@pytest.mark.slow
def test_enrolled_frames_are_corrected(adapted: Path, tmp_path: Path) -> None:
    folder = write_frame(tmp_path / "labelled", {1: "brick"})
    frame, gallery = frame_files(folder).read(), tmp_path / "gallery"
    run = ("--model", adapted, "--gallery", gallery)
    assert run_thor2("enroll", "mug", "--label-name", "brick", *run, "--frames", folder) == 0
    recognizer = Recognizer.load(adapted, gallery=gallery)
    stored = next(iter(recognizer.gallery.objects["mug"].clouds.views()))
    transform = recognizer.model.color_transform
    assert transform is not None
    expected = transform(frame.color[frame.labels == 1]).mean(axis=0)
    np.testing.assert_allclose(stored.colors.mean(axis=0), expected, atol=4)


def test_uncertainty_that_does_not_decrease_is_noted(
    model: Path, video: Path, tmp_path: Path, printed: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    for after, is_noted in ((0.6, True), (0.4, False)):
        monkeypatch.setattr(Recognizer, "adapt", lambda *_, after=after: Adaptation(ColorTransform(), 12, 0.5, after))
        out = printed("adapt", "--model", model, video, "--out", tmp_path / f"{after}", "--quiet")
        assert ("a run without one may serve as well" in out) == is_noted


def test_bad_input_writes_nothing(
    model: Path, video: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of few or unlabelled frames, and of runs that cannot be copied: with a device, or with folders without end."""
    few, unlabelled = tmp_path / "few", tmp_path / "unlabelled"
    write_frame(few, OBJECTS)
    for number in range(4):
        (write_frame(unlabelled / f"{number}", OBJECTS, number) / "mask.png").unlink()
    for folder, message in ((few, "3 usable instances; expected at least 10"), (unlabelled, "0: labels is None")):
        assert message in refused("adapt", "--model", model, folder, "--out", tmp_path / "out", "--quiet")
    assert "already contains" in refused("adapt", "--model", model, video, "--out", model)
    run = Path(shutil.copytree(model, tmp_path / "run"))
    monkeypatch.setattr(Recognizer, "adapt", lambda *_: Adaptation(ColorTransform(), 12, 0.5, 0.4))
    for name, target in (("curves.png", "/dev/zero"), ("again", ".")):
        (run / name).symlink_to(target)
        assert name in refused("adapt", "--model", run, video, "--out", tmp_path / "out")
        (run / name).unlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["few", "run", "unlabelled"]
