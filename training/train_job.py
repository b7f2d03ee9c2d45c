"""The job of `thor2 train`: render or open the views, train the runs, train their baselines."""

import dataclasses
import shutil
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import jax

from thor2_jax.recognition.classifier import check_features
from thor2_jax.recognition.run_directory import TrainedRun
from training.baselines.job import train_baselines
from training.baselines.names import check_baselines
from training.fitting.job import VIEWS, check_out, check_trained, is_finished, train_run
from training.fitting.options import Progress
from training.fitting.protocol import Protocol
from training.objects.meshes import find_meshes, read_names
from training.storage.workers import local_workers
from training.views.dataset import ViewDataset
from training.views.left_out import WithoutClasses
from training.views.normalized_views import ViewSource
from training.views.render_job import render_dataset
from training.views.sequences import sequence_sources

__all__ = ["TrainJob", "run_train_job"]

Display = Callable[[], AbstractContextManager[Progress]]
"""Opens a progress display, such as `training.cli.progress.show_progress`."""


@dataclasses.dataclass(frozen=True)
class TrainJob:
    """What to train, and on which views; exactly one of `meshes` and `dataset` is given.

    Attributes:
        out: run directory, or with `sequences` the directory of the run directories.
        protocol: camera steps, augmentations, mirrors and fit options.
        meshes: directory of meshes; their views are rendered for this run and removed afterwards.
        dataset: directory written by `thor2 render`.
        names: table of object name -> mesh in `meshes`; None uses all meshes.
        classifiers: any of "tops", "tops2", "ce".
        folds: number of folds; with more than one, each gets a model and is its held-out set.
        baselines: any of "thor", "forest", "pointnet".
        leave_out: objects to train without.
        sequences: table of sequence -> its objects; one run is trained for each sequence.
        workers: rendering processes.
    """

    out: Path
    protocol: Protocol
    meshes: Path | None = None
    dataset: Path | None = None
    names: Path | None = None
    classifiers: Sequence[str] = ("tops", "tops2", "ce")
    folds: int = 1
    baselines: Sequence[str] = ()
    leave_out: Sequence[str] = ()
    sequences: Path | None = None
    workers: int = 1


def run_train_job(job: TrainJob, display: Display) -> dict[Path, list[TrainedRun]]:
    """Train everything that the job asks for and that is not finished yet.

    Returns:
        Run directory -> the runs of its folds that this call has trained.

    Raises:
        InputError: An option is invalid, or a directory holds the results of another job.
        OSError: A file cannot be written.
    """
    baselines = check_baselines(job.baselines)
    if job.sequences is None and not (baselines and is_finished(job.out)):
        check_out(job.out)
    features = check_features(job.classifiers, "classifiers")
    source = _open_views(job, display)
    if job.leave_out:
        source = WithoutClasses(source, job.leave_out)
    sources = {job.out: source}
    options, mirrors = job.protocol.fit, job.protocol.mirrors
    if job.sequences is not None:
        sources = {job.out / sequence: views for sequence, views in sequence_sources(source, job.sequences).items()}
        for directory in filter(is_finished, sources):
            check_trained(sources[directory], directory, features, options, job.folds, mirrors)
    runs: dict[Path, list[TrainedRun]] = {}
    for directory, views in sources.items():
        runs[directory] = []
        with display() as progress:
            if not is_finished(directory):
                runs[directory] = train_run(
                    views, directory, features, options, progress, folds=job.folds, mirrors=mirrors
                )
            if baselines and jax.process_index() == 0:
                train_baselines(directory, views, baselines, progress)
    if job.meshes is not None and jax.process_index() == 0:
        shutil.rmtree(job.out / VIEWS)
    return runs


def _open_views(job: TrainJob, display: Display) -> ViewSource:
    """Open the dataset, or render the meshes to `out`/views."""
    if job.meshes is None:
        assert job.dataset is not None
        return ViewDataset.open(job.dataset)
    meshes = find_meshes(job.meshes, read_names(job.names) if job.names else None)
    protocol = job.protocol
    with display() as progress:
        return render_dataset(
            meshes,
            job.out / VIEWS,
            protocol.azimuth_step,
            protocol.polar_step,
            local_workers(job.workers),
            lambda done, total: progress("render", done, total, ""),
            protocol.augmentations,
            protocol.fit.seed,
        )
