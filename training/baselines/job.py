"""Training the baselines of finished runs; each becomes a file in the run directory."""

import contextlib
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from thor2_jax.errors import InputError
from thor2_jax.files import file_digest, remove_leftovers, remove_written
from thor2_jax.model.run_directory import TrainedRun, load_run
from training.baselines.files import StoredBaseline, baseline_file, read_baseline, write_baseline
from training.baselines.fit_forest import fit_forest
from training.baselines.fit_network import fit_network
from training.baselines.fit_pointnet import fit_pointnet
from training.baselines.fit_templates import fit_templates
from training.baselines.fit_thor import fit_thor
from training.baselines.names import CLOUD_BASELINES, NETWORKS, TEMPLATES, check_baselines
from training.baselines.pretrained import pretrained_files, weights_file
from training.baselines.task import FitTask, FittedBaseline
from training.fitting.options import FitOptions
from training.fitting.run_directories import find_run_directories
from training.fitting.temperature import fit_temperature
from training.storage.progress import Progress
from training.views.normalized_views import ViewSource

__all__ = ["train_baselines"]

_FIT: dict[str, Callable[[FitTask], FittedBaseline]] = {
    "thor": fit_thor,
    "forest": fit_forest,
    "pointnet": fit_pointnet,
    **{name: partial(fit_network, name=name) for name in NETWORKS},
    TEMPLATES: fit_templates,
}


def train_baselines(
    path: str | Path,
    source: ViewSource,
    names: Sequence[str] = CLOUD_BASELINES,
    progress: Progress = lambda stage, done, total, note: None,
    options: FitOptions | None = None,
    weights: Path | None = None,
) -> None:
    """Train the baselines that a run lacks.

    An interrupted training of THOR or of an image network resumes, the others start again.

    Args:
        path: run directory, or a directory with the folds of a training: then for each fold.
        source: the views that the run was trained on; those that its fold holds out are held out here too.
        names: any of BASELINES.
        progress: called with (stage, done, total, note).
        options: options of the fits; by default those of the run.
        weights: directory of pretrained weights for the image networks and the templates, see docs/baselines.md; None
            trains the networks from scratch.

    Raises:
        InputError: A baseline is unknown, `path` is not a run directory, the views are not those of the run, or a
            baseline cannot be trained on them; or `weights` lacks a file, or has one of another architecture, or a
            network of the run was trained without it.
        OSError: A file cannot be written.
    """
    names = check_baselines(names)
    for directory in find_run_directories([Path(path)]):
        run = load_run(directory)
        if run.record["dataset"]["digest"] != source.digest:
            raise InputError(
                f"dataset: the views with digest {source.digest[:12]} are not those that {directory} was trained on; "
                "give the dataset of that run"
            )
        for name in names:
            if not baseline_file(directory, name).is_file():
                _train(directory, run, source, name, progress, options, weights)
            elif weights is not None and pretrained_files(name):
                _check_pretrained(directory, run, name, weights)


def _check_pretrained(directory: Path, run: TrainedRun, name: str, weights: Path) -> None:
    """Raise InputError if a trained baseline was not trained from these files of weights."""
    file = baseline_file(directory, name)
    paths = [weights_file(weights, each) for each in pretrained_files(name)]
    if dict(read_baseline(file, run.classes).weights) != {path.name: file_digest(path) for path in paths}:
        raise InputError(
            f"weights is {weights}, but {file} was trained without these files; delete it to train it again, or leave "
            "out weights"
        )


def _train(
    directory: Path,
    run: TrainedRun,
    source: ViewSource,
    name: str,
    progress: Progress,
    options: FitOptions | None,
    weights: Path | None,
) -> None:
    record = run.record
    options = options or FitOptions(
        record["epochs"], tuple(record["learning_rates"]), record["batch_size"], record["seed"]
    )
    file = baseline_file(directory, name)
    remove_leftovers(file.parent)
    scratch = file.with_name(f".{name}")
    scratch.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    task = FitTask(
        source=source,
        network=run.network,
        config=run.config,
        options=options,
        folds=record["folds"],
        fold=record["fold"],
        scratch=scratch,
        run=directory,
        weights=weights,
        progress=progress,
    )
    try:
        fitted = _FIT[name](task)
    except InputError:
        with contextlib.suppress(OSError):  # they stay with a checkpoint or another baseline
            scratch.rmdir()
            file.parent.rmdir()
        raise
    seconds = time.perf_counter() - start
    temperature = fit_temperature(fitted.probabilities, fitted.truth) if len(fitted.truth) else None
    write_baseline(file, StoredBaseline(fitted.model.arrays(), temperature, seconds, fitted.weights), run.classes)
    remove_written(scratch, r"[^/]+/(.*/)?[0-9]+/.*")  # checkpoints
