"""The baselines by name, and their training in and loading from run directories: RUN/baselines/NAME.safetensors."""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from flax import nnx

from thor2_jax.errors import InputError, decoding
from thor2_jax.files import locked, remove_leftovers, remove_written
from thor2_jax.model.run_directory import TrainedRun, load_run
from training.baselines import cloud_baselines as clouds
from training.baselines import image_baselines as images
from training.baselines import thor
from training.baselines.baseline import FitTask, Predictor, StoredBaseline, baseline_file
from training.baselines.image_baselines import ARCHITECTURES, TEMPLATES
from training.storage.jobs import Progress, add_prefix
from training.train_run import find_run_directories
from training.views.normalized_views import ViewSource

__all__ = [
    "CLOUD_BASELINES",
    "TITLES",
    "TrainedBaseline",
    "check_baselines",
    "crop_size",
    "load_baselines",
    "pretrained_files",
    "train_baselines",
]

CLOUD_BASELINES = ("thor", "forest", "pointnet")
"""Baselines on point clouds."""

BASELINES = (*CLOUD_BASELINES, *ARCHITECTURES)
"""Names on the command line and in run directories, in the order of training."""

TITLES = {
    "forest": "forest",
    "pointnet": "PointNet",
    "thor": "THOR",
    "rcfusion": "RCFusion",
    "rcfusion-small": "RCFusion-small",
    "vit-cnn": "ViT-CNN",
    "vit-cnn-small": "ViT-CNN-small",
    "rgbd-vit": "RGB-D ViT",
    "rgbd-vit-small": "RGB-D ViT-small",
    TEMPLATES: "templates",
}
"""Column titles of the baselines, in the order of the columns."""

Load = Callable[[Mapping[str, Any], TrainedRun], Predictor]

_METHODS: dict[str, tuple[Callable[[FitTask], StoredBaseline], Load]] = {
    "thor": (thor.fit_thor, thor.load_thor),
    "forest": (clouds.fit_forest, clouds.load_forest),
    "pointnet": (clouds.fit_pointnet, clouds.load_pointnet),
    **{name: (images.fit_image_network, functools.partial(images.load_image_network, name)) for name in ARCHITECTURES},
    TEMPLATES: (images.fit_templates, images.load_templates),
}
"""Name -> function that fits a baseline, and function that builds it from its arrays and run. The second one raises
KeyError or ValueError for unsuitable arrays."""


def pretrained_files(name: str) -> list[str]:
    """Return the files of pretrained weights that a baseline reads, without the suffix; most baselines read none."""
    return sorted(set(ARCHITECTURES[name].weights.values())) if name in ARCHITECTURES else []


def crop_size(names: Sequence[str], weights: bool) -> int | None:
    """Return the largest side in pixels of the crops on which baselines are trained; None if they need no crops.

    Args:
        names: names of the baselines.
        weights: whether there are pretrained weights; templates then use DINOv2, which reads large crops.
    """
    readers = (name if weights or name != TEMPLATES else "rgbd-vit-small" for name in names)
    return max((ARCHITECTURES[name].size for name in readers if name in ARCHITECTURES), default=None)


def check_weights(directory: Path, name: str) -> dict[str, str]:
    """Read the files of a baseline's pretrained weights, without keeping them.

    Returns:
        Name of each file -> its SHA-256; empty for baselines that read none.

    Raises:
        InputError: a file is missing, damaged or of another architecture.
    """
    if not pretrained_files(name):
        return {}
    architecture = ARCHITECTURES[name]
    return architecture.load_weights(nnx.eval_shape(lambda: architecture.build(2, 0)), directory)


def check_baselines(names: Sequence[str], weights: Path | None, out: Path) -> tuple[str, ...]:
    """Return `names` in the order of BASELINES, if they can be trained.

    Args:
        names: names of baselines.
        weights: folder of pretrained weights, see `train_baselines`.
        out: directory that contains the runs.

    Raises:
        InputError: a name is unknown or given twice; `weights` is not needed, lacks a file or has a file of another
            architecture; or templates have no backbone.
    """
    if not set(names) <= set(BASELINES) or len(set(names)) != len(names):
        raise InputError(
            f"baselines is {', '.join(names)}; expected any of {', '.join(BASELINES)}; give each at most once"
        )
    if weights is None:
        images.check_backbone(names, out)
    elif not any(map(pretrained_files, names)):
        raise InputError(f"weights is {weights}, but none of the baselines reads pretrained weights; leave it out")
    else:
        for name in names:
            check_weights(weights, name)
    return tuple(name for name in BASELINES if name in names)


class TrainedBaseline(NamedTuple):
    """A baseline of a run: its function, its temperature (None without a held-out set), and its pretrained weights."""

    predict: Predictor
    temperature: float | None
    weights: Mapping[str, str]


def train_baselines(
    path: str | Path,
    source: ViewSource,
    names: Sequence[str],
    progress: Progress = lambda stage, done, total, note: None,
    weights: Path | None = None,
) -> None:
    """Train the baselines that a run lacks.

    An interrupted fit of a network resumes; the forest and the templates start again.

    Args:
        path: run directory, or a directory with the folds of a training, each of which gets the baselines.
        source: the views on which the run was trained; the held-out views of its fold are held out here, too.
        names: names from BASELINES, in the same order.
        progress: called with (stage, done, total, note).
        weights: folder of pretrained weights for the image networks and the templates, see docs/baselines.md; None
            trains the networks from scratch.

    Raises:
        InputError: `path` is not a run directory; the run was trained on other views; a baseline cannot be trained on
            them; `weights` lacks a file or has a file of another architecture; or a network of the run was trained
            without these weights; or another process is training a baseline.
        OSError: a file cannot be written.
    """
    for directory in find_run_directories([Path(path)]):
        run = load_run(directory)
        if run.record["dataset"]["digest"] != source.digest:
            raise InputError(
                f"dataset: the views with digest {source.digest[:12]} are not those that {directory} was trained on; "
                "give the dataset of that run"
            )
        shown = progress if run.record["folds"] == 1 else add_prefix(progress, f"fold {run.record['fold']}")
        for name in names:
            file, task = baseline_file(directory, name), FitTask(name, source, run, directory, weights, shown)
            if not file.is_file():
                with locked(task.scratch):
                    start = time.perf_counter()
                    _METHODS[name][0](task).write(file, run.classes, time.perf_counter() - start)
            elif weights is not None and StoredBaseline.read(file, run.classes).weights != check_weights(weights, name):
                raise InputError(
                    f"weights is {weights}, but {file} was trained without these files; delete it to train it again, "
                    "or leave out weights"
                )
            # Checkpoints, including those of earlier versions and those of a process that was killed here.
            remove_leftovers(file.parent)
            remove_written(task.scratch, r"\.lock", r"[^/]+/[0-9]+(\.safetensors|/.*)")


def load_baselines(path: Path, run: TrainedRun) -> dict[str, TrainedBaseline]:
    """Return name -> baseline of a run directory.

    Raises:
        InputError: a file is damaged or does not match the run.
    """
    loaded = {}
    for name in BASELINES:
        if (file := baseline_file(path, name)).is_file():
            stored = StoredBaseline.read(file, run.classes)
            with decoding(f"model: {file} does not match its run", advice="delete it and train the baseline again"):
                predict = _METHODS[name][1](stored.arrays, run)
            loaded[name] = TrainedBaseline(predict, stored.temperature, stored.weights)
    return loaded
