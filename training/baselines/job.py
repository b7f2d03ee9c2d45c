"""Training and loading the baselines of finished runs, RUN/baselines/NAME.safetensors."""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flax import nnx

from thor2_jax.errors import InputError
from thor2_jax.files import file_digest, remove_leftovers, remove_written
from thor2_jax.model.run_directory import TrainedRun, load_run
from training.baselines.baseline import Baseline, FitTask, FittedBaseline
from training.baselines.files import (
    BASELINES,
    CLOUD_BASELINES,
    NETWORKS,
    TEMPLATES,
    StoredBaseline,
    baseline_file,
    read_baseline,
    write_baseline,
)
from training.baselines.forest import Forest, fit_forest
from training.baselines.image_network import ImageNetwork, fit_image_network
from training.baselines.networks.architectures import ARCHITECTURES, load_weights, weights_file
from training.baselines.pointnet import ColoredPointNet, fit_pointnet
from training.baselines.templates import DINOV2, Templates, create_backbone, fit_templates
from training.baselines.thor import THOR, fit_thor
from training.fitting.loop import FitOptions, find_run_directories
from training.storage.jobs import Progress
from training.views.normalized_views import ViewSource

__all__ = ["check_weights", "load_baselines", "pretrained_files", "train_baselines"]

_FIT: dict[str, Callable[[FitTask], FittedBaseline]] = {
    "thor": fit_thor,
    "forest": fit_forest,
    "pointnet": fit_pointnet,
    **dict.fromkeys(NETWORKS, fit_image_network),
    TEMPLATES: fit_templates,
}

_BUILD: dict[str, Callable[[str, Mapping[str, Any], TrainedRun], Baseline]] = {
    "thor": lambda _, arrays, run: THOR.with_arrays(arrays, run.config, len(run.classes)),
    "forest": lambda _, arrays, run: Forest(arrays, run.network, run.config),
    "pointnet": lambda _, arrays, run: ColoredPointNet.with_arrays(arrays, len(run.classes)),
    **dict.fromkeys(NETWORKS, lambda name, arrays, run: ImageNetwork.with_arrays(name, arrays, len(run.classes))),
    TEMPLATES: lambda _, arrays, run: Templates.with_arrays(arrays, len(run.classes)),
}
"""Functions of a name, arrays and the run that build a trained baseline; they raise ValueError for unfit arrays."""


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
        names: any of BASELINES, in their order.
        progress: called with (stage, done, total, note).
        options: options of the fits; by default those of the run.
        weights: directory of pretrained weights for the image networks and the templates, see docs/baselines.md; None
            trains the networks from scratch.

    Raises:
        InputError: `path` is not a run directory, the views are not those of the run, or a baseline cannot be trained
            on them; or `weights` lacks a file, or has one of another architecture, or a network of the run was trained
            without it.
        OSError: A file cannot be written.
    """
    for directory in find_run_directories([Path(path)]):
        run = load_run(directory)
        if run.record["dataset"]["digest"] != source.digest:
            raise InputError(
                f"dataset: the views with digest {source.digest[:12]} are not those that {directory} was trained on; "
                "give the dataset of that run"
            )
        for name in names:
            if not baseline_file(directory, name).is_file():
                _train(FitTask(name, source, run, options or _options_of(run), directory, weights, progress))
            elif weights is not None and pretrained_files(name):
                _check_pretrained(directory, run, name, weights)


def _options_of(run: TrainedRun) -> FitOptions:
    record, rates = run.record, tuple(run.record["learning_rates"])
    return FitOptions(record["epochs"], rates, record["batch_size"], record["seed"])


def _check_pretrained(directory: Path, run: TrainedRun, name: str, weights: Path) -> None:
    """Raise InputError if a trained baseline was not trained from these files of weights."""
    file = baseline_file(directory, name)
    paths = [weights_file(weights, each) for each in pretrained_files(name)]
    if read_baseline(file, run.classes).weights != {path.name: file_digest(path) for path in paths}:
        raise InputError(
            f"weights is {weights}, but {file} was trained without these files; delete it to train it again, or leave "
            "out weights"
        )


def _train(task: FitTask) -> None:
    file, start = baseline_file(task.directory, task.name), time.perf_counter()
    remove_leftovers(file.parent)
    task.scratch.mkdir(parents=True, exist_ok=True)
    try:
        fitted = _FIT[task.name](task)
    except InputError:
        with contextlib.suppress(OSError):  # they stay with a checkpoint or another baseline
            task.scratch.rmdir()
            file.parent.rmdir()
        raise
    seconds = time.perf_counter() - start
    stored = StoredBaseline(fitted.model.arrays(), fitted.temperature, seconds, fitted.weights)
    write_baseline(file, stored, task.run.classes)
    remove_written(task.scratch, r"[^/]+/[0-9]+(\.safetensors|/.*)")  # checkpoints, also those of earlier versions


def load_baselines(path: Path, run: TrainedRun) -> dict[str, FittedBaseline]:
    """Return name -> baseline of a run directory.

    Raises:
        InputError: a file is damaged or does not match the run.
    """
    loaded = {}
    for name, file in ((name, baseline_file(path, name)) for name in BASELINES):
        if not file.is_file():
            continue
        stored = read_baseline(file, run.classes)
        try:
            model = _BUILD[name](name, stored.arrays, run)
        except ValueError as error:
            raise InputError(
                f"model: {file} does not match its run ({error}); delete it and train the baseline again"
            ) from None
        loaded[name] = FittedBaseline(model, stored.temperature, stored.weights)
    return loaded


def pretrained_files(name: str) -> list[str]:
    """Return the files of pretrained weights that a baseline reads, without the suffix; none for most baselines."""
    if name == TEMPLATES:
        return [DINOV2]
    return sorted(set(ARCHITECTURES[name].weights.values())) if name in ARCHITECTURES else []


def check_weights(directory: Path, name: str) -> None:
    """Read the files of a baseline's pretrained weights, without keeping them.

    Raises:
        InputError: a file is missing, damaged or of another architecture.
    """
    if name == TEMPLATES:
        load_weights(directory, [(nnx.eval_shape(lambda: create_backbone(DINOV2)), DINOV2)])
    elif name in ARCHITECTURES:
        architecture = ARCHITECTURES[name]
        load_weights(directory, architecture.backbones(nnx.eval_shape(lambda: architecture.build(2, 0))))
