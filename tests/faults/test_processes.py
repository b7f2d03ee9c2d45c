"""Two trainings that write to the same run directory."""

from pathlib import Path
from typing import Any

import pytest
from failures import Interrupted, stop_when
from refusals import assert_refused
from small_clouds import brick_and_stick
from written_files import files_of

import thor2_jax as thor2
from thor2_jax.model.run_directory import TrainedRun, load_run
from training.fitting.loop import FitOptions
from training.protocol import Protocol
from training.train_run import train_run
from training.views.normalized_views import MemoryViews

CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=3, n_strips=8, image_size=8)

pytestmark = pytest.mark.usefixtures("small_classifiers")


def train(out: Path, **more: Any) -> TrainedRun:
    views = MemoryViews(brick_and_stick(3), CONFIG)
    (run,) = train_run(views, out, Protocol(("tops",), FitOptions(epochs=2, batch_size=4), CONFIG), **more)
    return run


def test_a_second_training_is_refused(tmp_path: Path) -> None:
    """At every stage of the first training, a second one is refused and changes nothing."""
    out, refusals = tmp_path / "run", []

    def meanwhile(stage: str, done: int, total: int, note: str) -> None:
        if stage == "describe" or done not in (1, total):
            return
        before = files_of(out)
        assert_refused(str(out), train, out)
        refusals.append(stage)
        assert files_of(out) == before

    train(out, progress=meanwhile)
    assert refusals and load_run(out).classes == ("red brick", "stick")
    assert not list(out.rglob(".lock"))


@pytest.mark.slow
def test_a_training_that_another_one_overtakes(tmp_path: Path) -> None:
    """Both start with a new directory, and the slower one is refused or resumes the other one."""
    out, done = tmp_path / "run", []

    def quicker(stage: str, count: int, total: int, note: str) -> None:
        if stage == "describe" and not done:
            done.append(train(out))

    assert_refused("already contains", train, out, progress=quicker)
    assert load_run(out).record == done[0].record

    other, begun = tmp_path / "other", []

    def dies(stage: str, count: int, total: int, note: str) -> None:
        if stage == "describe" and not begun:
            begun.append(1)
            with pytest.raises(Interrupted):
                train(other, progress=stop_when("fit tops", 3))

    assert train(other, progress=dies).record == done[0].record  # resumes the other training
