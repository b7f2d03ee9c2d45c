"""Training the baselines of finished runs, one file each, beside what the run folders hold already."""

import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from thor2_jax.errors import InputError
from thor2_jax.recognition.run_directory import load_run
from training.baselines.baseline import Fitted, Task
from training.baselines.files import StoredBaseline, baseline_file, write_baseline
from training.baselines.forest import train_forest
from training.baselines.pointnet import train_pointnet
from training.baselines.thor import train_thor
from training.fitting.options import FitOptions
from training.fitting.run_directories import find_run_directories
from training.fitting.temperature import fit_temperature
from training.views.normalized_views import ViewSource

__all__ = ["BASELINES", "check_baselines", "train_baselines"]

_TRAIN: dict[str, Callable[[Task], Fitted]] = {"thor": train_thor, "forest": train_forest, "pointnet": train_pointnet}

BASELINES = tuple(_TRAIN)


def check_baselines(names: Sequence[str]) -> tuple[str, ...]:
    """`names` in the order of BASELINES, or an InputError that names the option."""
    if not set(names) <= set(BASELINES) or len(set(names)) != len(names):
        raise InputError(f"baselines is {', '.join(names)}; expected different ones of {', '.join(BASELINES)}")
    return tuple(name for name in BASELINES if name in names)


def train_baselines(
    path: str | Path,
    source: ViewSource,
    names: Sequence[str] = BASELINES,
    progress: Callable[[str, int, int, str], object] = lambda stage, done, total, note: None,
    options: FitOptions | None = None,
) -> None:
    """Train those baselines that a run lacks; one that was stopped begins again, or, THOR, goes on.

    Args:
        path: run folder, or one that holds the folds of a training: then for each of them.
        source: the views that the run was trained on. Those that its fold holds out are held out here too.
        names: any of BASELINES.
        progress: told (stage, done, total, note).
        options: of the fits; by default those of the run's classifiers.

    Raises:
        InputError: an unknown baseline, no run, other views than the run's, or views that a baseline cannot be trained
            on.
        OSError: a file cannot be written.
    """
    wanted = check_baselines(names)
    for folder in find_run_directories([Path(path)]):
        lacking = [name for name in wanted if not baseline_file(folder, name).is_file()]
        run = load_run(folder)
        record = run.record
        if record["dataset"]["digest"] != source.digest:
            raise InputError(f"dataset: {folder} was trained on other views")
        given = options or FitOptions(
            record["epochs"], tuple(record["learning_rates"]), record["batch_size"], record["seed"]
        )
        for name in lacking:
            file = baseline_file(folder, name)
            scratch = file.with_name(f".{name}")
            scratch.mkdir(parents=True, exist_ok=True)
            start = time.perf_counter()
            task = Task(source, run.network, run.config, given, record["folds"], record["fold"], scratch, progress)
            fitted = _TRAIN[name](task)
            seconds = time.perf_counter() - start
            temperature = fit_temperature(fitted.probabilities, fitted.truth) if len(fitted.truth) else None
            write_baseline(file, StoredBaseline(fitted.model.arrays(), temperature, seconds), run.classes)
            shutil.rmtree(scratch)
