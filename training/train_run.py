"""Train the model of a run directory: an embedding that recognizes the classes, the paper's classifiers, or both.

RUN/run.json, network.npz, weights/   the trained model (`run_directory`); with several folds, RUN/fold-0/run.json, ...
RUN/embedding.safetensors             with distractors: the embedding, which also classifies
RUN/references.safetensors            its reference views, for galleries
RUN/surfaces.safetensors              surfaces of the classes, if all were trained from meshes
RUN/gallery/                          with an embedding: labelled views of classes without a mesh, enrolled
RUN/metrics.jsonl                     appended after each epoch: classifier (or "embedding"), fold and metrics
RUN/curves.png                        plots of the metrics
RUN/checkpoints/                      until the training is finished: its job record and checkpoints
RUN/views/                            until the training is finished: views rendered for this run only

An interrupted training resumes at the next call. run.json is written last: without it, RUN is not a run directory.
"""

import contextlib
import dataclasses
import functools
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError, decoding
from thor2_jax.files import check_output_directory, errors_name, locked, remove_written, write_text
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery.compact_clouds import CompactClouds
from thor2_jax.gallery.enrollment import ObjectGallery, embedded_object
from thor2_jax.gallery.store import GALLERY_DIRECTORY
from thor2_jax.model.run_directory import TrainedRun, load_run, save_run
from thor2_jax.model.run_record import RUN_FILE, run_directories
from thor2_jax.networks.embedding import Embedding
from thor2_jax.networks.networks import EMBEDDING, MLP, Feature
from thor2_jax.types import Cloud
from training.embedding.distractors import Distractors
from training.embedding.fit import RUN_SIZES, fit_embedding
from training.fitting.fit import FitContext, fit, fit_calibration, fit_temperature, sample_probabilities
from training.fitting.loop import Checkpoints, EpochMetrics, fit_progress, wait_for_all
from training.fitting.samples import OF_EMBEDDING, Form, Samples, sample_views
from training.protocol import Protocol, Stage
from training.reports.plots import draw_curves
from training.storage.jobs import Progress, add_prefix, begin_job, check_begun, check_same_job, of_stage
from training.views.normalized_views import ViewSource, check_classes, fold_of_views

__all__ = ["VIEWS", "check_out", "check_trained", "find_run_directories", "finished_record", "is_finished", "train_run"]

VIEWS = "views"

CHECKPOINTS = "checkpoints"
"""Directory of the checkpoints, inside the run directory of an unfinished training."""

BEGUN = "begun.json"
"""File name, in this directory, of the job record of an unfinished training."""

JOB = f"{CHECKPOINTS}/{BEGUN}"
METRICS = "metrics.jsonl"
HELD_OUT = 12
"""In a run without folds, one in this many views is held out to calibrate the confidence."""

CURVES = "curves.png"

CURVE = ("epoch", "loss", "accuracy", "held_out_accuracy")
"""Metrics of an epoch that the record stores: only those that a repeated training reproduces."""


def check_out(out: str | Path) -> None:
    """Raise InputError unless `out` is new, empty, or the directory of an interrupted training."""
    check_output_directory(out, JOB, (VIEWS, CHECKPOINTS))
    check_output_directory(Path(out) / CHECKPOINTS, BEGUN)


def is_finished(out: Path) -> bool:
    """Return whether a directory holds a trained run or all of its folds."""
    return bool(run_directories(out)) and not (out / JOB).exists()


def check_trained(digest: str, out: Path, settings: Protocol) -> None:
    """Check that a finished run was trained with these settings on views with this digest.

    Raises:
        InputError: the run cannot be read, or was trained with another value; the message names it.
    """
    requested, record = settings.record(digest), finished_record(out)
    stored = {"orientation_copies": 0, **record, "dataset": record["dataset"]["digest"]}
    stored["descriptor_config"] = dataclasses.asdict(DescriptorConfig.of_record(record["descriptor_config"]))
    check_same_job(out, {name: stored.get(name) for name in requested}, requested)


def find_run_directories(paths: Iterable[Path]) -> list[Path]:
    """Return the run directories among `paths`; a directory with fold-0, fold-1, ... is replaced by its folds.

    Raises:
        InputError: a training is not finished. Other paths that are not run directories are refused on loading.
    """
    directories: list[Path] = []
    for path in map(Path, paths):
        runs = run_directories(path) or [path]
        if path not in runs and (path / JOB).exists():
            raise InputError(
                f"model: {path} holds an unfinished training; finish it with `thor2 train`, or give single folds of it"
            )
        directories += runs
    return directories


def finished_record(out: Path) -> Mapping[str, Any]:
    """Return the record of a finished run, or of its first fold.

    Raises:
        InputError: the run cannot be read.
    """
    return load_run(find_run_directories([out])[0]).record


def log_metrics(path: Path, fold: int, classifier: str, metrics: EpochMetrics) -> None:
    """Append the metrics of one epoch."""
    row = {"fold": fold, "classifier": classifier, **dataclasses.asdict(metrics)}
    with errors_name(path), path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


def remove_later_metrics(path: Path, fold: int, classifier: str, last_epoch: int) -> None:
    """Remove the metrics that an interrupted training logged after its last checkpoint, and a line that is cut off."""
    key, rows = (fold, classifier), read_metrics(path)
    rows = [row for row in rows if (row["fold"], row["classifier"]) != key or row["epoch"] <= last_epoch]
    if path.exists():
        write_text(path, "".join(json.dumps(row) + "\n" for row in rows))


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Return the metrics of all epochs; a missing file has none, and a last line cut off by a crash is ignored.

    Raises:
        InputError: any other line is damaged.
    """
    content = path.read_bytes() if path.exists() else b""
    with decoding(f"out: {path} is damaged", advice="remove it, or choose another directory"):
        rows = [json.loads(line) for line in content.split(b"\n")[:-1]]
        for row in rows:
            if not (isinstance(row["epoch"], int) and {"fold", "classifier"} <= row.keys()):
                raise ValueError("a line has no fold, classifier and epoch")
    return rows


def train_run(
    source: ViewSource,
    out: str | Path,
    settings: Protocol,
    progress: Progress = lambda stage, done, total, note: None,
    enrolled: Mapping[str, Sequence[PreparedInstance]] | None = None,
) -> list[TrainedRun]:
    """Train the classifiers and the embedding of each fold and write the run directories; resume if interrupted.

    The training uses all devices of all processes. Every process must call this function with the same arguments and
    access the same files. `training.fitting.fit` describes which results two trainings with the same seed share.

    Args:
        source: labelled views.
        out: run directory: new, empty, or of the same training, interrupted; the folds are written to `out`/fold-0, ...
        settings: everything else that determines the runs.
        progress: called with the `stages` of the settings.
        enrolled: class -> views that a run with an embedding also enrolls, in its gallery.

    Returns:
        The run of each fold, loaded from its directory.

    Raises:
        InputError: `out` holds something else, is in use by another process or was begun with other settings or views;
            a class has no views, or fewer views than folds; or the batch size is not a multiple of the number of
            devices. Nothing is written then. If a loss is not finite, the checkpoints written so far are kept.
        OSError: a file cannot be written; the last complete checkpoints are kept.
    """
    out = Path(out).absolute()
    check_out(out)
    job = settings.record(source.digest)
    check_begun(out, job, JOB)
    size = settings.fit.batch_size
    if size % jax.device_count():
        raise InputError(f"batch_size is {size}; it must be a multiple of the {jax.device_count()} devices")
    with contextlib.ExitStack() as locks:
        first, resumed = jax.process_index() == 0, (out / CHECKPOINTS).is_dir()
        if first and resumed:
            locks.enter_context(locked(out / CHECKPOINTS))
        samples = _sample_classes(source, settings, progress)
        if settings.distractors is not None:
            _ = source.surfaces  # a damaged file is reported now rather than after the fit
        parts = settings.folds
        if parts == 1 and settings.distractors is not None:  # fewer parts than `HELD_OUT` if a class has few views
            each = (samples.view[samples.label == index] for index in range(len(source.classes)))
            fewest = min(len(np.unique(view)) for view in each)
            parts = max(2, min(HELD_OUT, fewest))
        fold_of = fold_of_views(samples.label, samples.view, source.classes, parts, settings.fit.seed)
        wait_for_all("checked")
        if first:
            if not resumed:
                check_out(out)  # another process may have begun in the meantime
                locks.enter_context(locked(out / CHECKPOINTS))
            begin_job(out, job, JOB)
        wait_for_all("begun")
        check_begun(out, job, JOB)  # all processes need the options of the first one
        runs = []
        for fold in range(settings.folds):
            held_out = None if parts == 1 else fold_of == fold
            shown = progress if settings.folds == 1 else add_prefix(progress, f"fold {fold}")
            runs.append(_Fold(settings, source, out, fold, samples, held_out, shown, enrolled or {}).train())
        wait_for_all("trained")
        if first:
            remove_written(out / CHECKPOINTS, r"begun\.json", r"\.lock", r"(fold-[0-9]+|distractors)/.*")
        return runs


def _sample_classes(source: ViewSource, settings: Protocol, progress: Progress) -> Samples:
    """Return the samples of the classifiers; without classifiers, one sample of each view, which is empty."""
    if settings.classifiers:
        check_classes(source)
        form = Form(settings.mirrors, settings.orientation_copies)
        show = of_stage(progress, Stage.DESCRIBE, "views")
        return sample_views(source, settings.network, settings.config, form, settings.fit.seed, show)[0]
    views = [source.read(index).view for index in range(len(source.shards))]
    label = np.repeat([shard.label for shard in source.shards], [len(each) for each in views])
    return Samples(csr_array((len(label), 0)), np.zeros((len(label), 0), np.float32), label, np.concatenate(views))


class _Fold(NamedTuple):
    """One fold of a training: the arguments of `train_run`, the fold's number, all samples, and which are held out.

    The stages of `progress` have the fold as a prefix, if there are several.
    """

    settings: Protocol
    source: ViewSource
    out: Path
    number: int
    samples: Samples
    held_out: NDArray[np.bool_] | None
    progress: Progress
    enrolled: Mapping[str, Sequence[PreparedInstance]]

    @property
    def scratch(self) -> Path:
        """The directory of the fold's checkpoints."""
        return self.out / CHECKPOINTS / f"fold-{self.number}"

    def train(self) -> TrainedRun:
        """Train and publish the run unless it is finished, and load it from its directory."""
        directory = self.out if self.settings.folds == 1 else self.out / f"fold-{self.number}"
        if not (directory / RUN_FILE).is_file():
            run = self.fit_classifiers()
            if jax.process_index() == 0:
                self.publish(self.complete_run(run), directory)
            wait_for_all("published")
        return load_run(directory)

    def fit_classifiers(self) -> TrainedRun:
        """Return a run with the fitted classifiers; its record has only the epoch and the temperature of each."""
        settings, samples = self.settings, self.samples
        classifiers: dict[Feature, MLP] = {}
        best_epochs: dict[Feature, int] = {}
        temperatures: dict[Feature, float] = {}
        for name in settings.classifiers:
            context, checkpoints = FitContext(name, settings.network, settings.config), self.checkpoints(name)
            shown = fit_progress(self.progress, f"fit {name}", settings.fit.epochs)
            fitted = fit(samples, context, settings.fit, checkpoints, self.held_out, shown)
            classifiers[name], best_epochs[name] = fitted
            if self.held_out is not None:
                rows = np.flatnonzero(self.held_out)
                probabilities = sample_probabilities(classifiers[name], samples, rows, context)
                temperatures[name] = fit_temperature(probabilities, samples.label[rows])
        record = {"kept_epochs": best_epochs, "temperatures": temperatures}
        return TrainedRun(settings.config, settings.network, self.source.classes, classifiers, record)

    def complete_run(self, run: TrainedRun) -> TrainedRun:
        """Add the embedding and a calibrated confidence, if there are distractors, and the whole record."""
        settings, accuracy, confidence = self.settings, {}, {}
        if settings.distractors is not None:
            embedding, held_out = self.fit_embedding(settings.distractors)
            run = dataclasses.replace(run, embedding=embedding, surfaces=self.source.surfaces)
            self.progress(Stage.CALIBRATE, 0, 1, "")
            calibration, accuracy[EMBEDDING] = fit_calibration(run, held_out)
            self.progress(Stage.CALIBRATE, 1, 1, "")
            confidence = {} if calibration is None else {"calibration": dataclasses.asdict(calibration)}
        rows = read_metrics(self.out / METRICS)
        names = dict.fromkeys(row["classifier"] for row in rows)
        draw_curves({name: [row for row in rows if row["classifier"] == name] for name in names}, self.out / CURVES)
        record = settings.record(self.source.digest)
        record |= {"dataset": self.source.record, "samples": len(self.samples), "fold": self.number}
        record |= _outcome([row for row in rows if row["fold"] == self.number], run.record["kept_epochs"])
        record["held_out_accuracy"] |= accuracy
        record |= {"temperatures": run.record["temperatures"], **confidence}
        return dataclasses.replace(run, record=record)

    def fit_embedding(self, distractors: Distractors) -> tuple[Embedding, list[tuple[int, Cloud]]]:
        """Fit the embedding on the views and the distractors.

        Returns:
            The embedding, which recognizes the classes; and the label and the cloud, in metres, of each view in the
            held-out set. Labels of distractors start at the number of classes.
        """
        settings, checkpoints = self.settings, self.checkpoints(EMBEDDING)
        network, seed, classes = settings.network, settings.fit.seed, self.source.classes
        config = dataclasses.replace(settings.config, homology="closed_form")
        scratch, shown = self.out / CHECKPOINTS / "distractors", of_stage(self.progress, Stage.RENDER_DISTRACTORS)
        others = distractors.samples(scratch, network, config, shown)
        label, view = self.samples.label[self.held_out], self.samples.view[self.held_out]
        kept = {index: np.unique(view[label == index]) for index in range(len(classes))}
        shown = of_stage(self.progress, Stage.DESCRIBE_EMBEDDED)
        samples, known = sample_views(self.source, network, config, OF_EMBEDDING, seed, shown, kept)
        unknown = distractors.held_out_clouds(len(classes))
        samples = distractors.add_fitted(samples, others, len(classes))
        del others  # needs as much memory as the samples
        embedding = fit_embedding(
            samples,
            network,
            config,
            distractors.epochs,
            checkpoints,
            RUN_SIZES,
            fit_progress(self.progress, Stage.FIT_NETWORKS, distractors.epochs),
            classes,
            networks=distractors.networks,
            seed=seed,
        )
        return embedding, known + unknown

    def checkpoints(self, name: str) -> Checkpoints:
        """Open the checkpoints of a fit, which log its metrics."""
        logged = self.out / METRICS, self.number, name
        checkpoints = Checkpoints(self.scratch / name, functools.partial(log_metrics, *logged))
        if jax.process_index() == 0:
            remove_later_metrics(*logged, checkpoints.last_epoch)
        return checkpoints

    def publish(self, run: TrainedRun, directory: Path) -> None:
        """Write a run and its enrolled views, and move the files into `directory`; run.json is moved last."""
        complete = self.scratch / "run"
        shutil.rmtree(complete, ignore_errors=True)  # left by a process that was killed in this function
        save_run(run, complete)
        if self.enrolled and run.embedding is not None:
            objects = ObjectGallery(run.classes, run.embedding)
            objects.open(complete / GALLERY_DIRECTORY)
            clouds = {name: CompactClouds.of(views) for name, views in self.enrolled.items()}
            added = {name: embedded_object(run.embedding, each, "frames") for name, each in clouds.items()}
            objects.add(added, extend=True)
        files = [path for path in complete.rglob("*") if path.is_file()]
        for path in sorted(files, key=lambda path: path.name == RUN_FILE):
            place = directory / path.relative_to(complete)
            place.parent.mkdir(parents=True, exist_ok=True)
            path.rename(place)


def _outcome(rows: Sequence[Mapping[str, Any]], best_epochs: Mapping[Feature, int]) -> dict[str, Any]:
    """Return the results of a fold for its record: curves, selected epochs and held-out accuracy."""
    curves: dict[str, list[dict[str, Any]]] = {}
    held_out: dict[str, float] = {}
    for row in rows:
        name = row["classifier"]
        curves.setdefault(name, []).append({key: row[key] for key in CURVE if row[key] is not None})
        if row["epoch"] == best_epochs.get(name) and row["held_out_accuracy"] is not None:
            held_out[name] = row["held_out_accuracy"]
    return {"kept_epochs": dict(best_epochs), "held_out_accuracy": held_out, "curves": curves}
