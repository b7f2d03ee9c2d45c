"""Train a run directory: samples, one classifier per feature and fold, metrics, curves and the record.

RUN/run.json, network.npz, weights/   the trained model (`run_directory`); with several folds, RUN/fold-0/run.json, ...
RUN/embedding.safetensors             with distractors: the embedding, which is also a classifier
RUN/metrics.jsonl                     one line per epoch, classifier and fold
RUN/curves.png                        plots of the metrics
RUN/checkpoints/                      until the training is finished: its job record and checkpoints
RUN/views/                            until the training is finished: views rendered for this run only

An interrupted training resumes when it is called again. run.json is written last and makes RUN a run directory.
"""

import contextlib
import dataclasses
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from numpy.typing import NDArray

import colornet
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.descriptor.sharding import batch_mesh
from thor2_jax.errors import InputError
from thor2_jax.files import check_output_directory, remove_leftovers, write_text
from thor2_jax.gallery.embedding import Embedding
from thor2_jax.recognition.classifier import MLP, Feature, check_features
from thor2_jax.recognition.confidence import Calibration
from thor2_jax.recognition.run_directory import EMBEDDING_FILE, RUN_FILE, TrainedRun, load_run, save_run
from training.embedding.run_embedding import Distractors, fit_run_embedding
from training.fitting.calibration import temperatures
from training.fitting.checkpoints import CHECKPOINTS, Checkpoints
from training.fitting.confidence import fit_calibration
from training.fitting.fit import check_batch_size, fit
from training.fitting.folds import fold_of_views
from training.fitting.metrics_log import append_metrics, discard_later_epochs, read_metrics
from training.fitting.options import EpochMetrics, FitOptions
from training.fitting.samples import MIRRORS, Samples, build_samples
from training.fitting.steps import FitContext
from training.reports.plots import draw_curves
from training.storage.jobs import check_same_job
from training.storage.locks import locked
from training.storage.progress import Progress
from training.views.normalized_views import ViewSource

__all__ = ["VIEWS", "check_out", "check_trained", "finished_record", "is_finished", "train_run"]

VIEWS = "views"
BEGUN = "begun.json"
METRICS = "metrics.jsonl"
HELD_OUT = 12
"""One view of so many is held out to calibrate the confidence of a run without folds."""

CURVES = "curves.png"

CONFIG = DescriptorConfig(homology="closed_form")
"""Default descriptor: the paper's."""

CURVE = ("epoch", "loss", "accuracy", "held_out_accuracy")
"""Metrics of an epoch that the record keeps: those that a repeated training reproduces."""


@dataclasses.dataclass(frozen=True)
class _Settings:
    """Everything beside the views that determines a trained run; see `train_run` for the fields.

    Attributes:
        features: what the classifiers read.
        options: of every fit.
        config: descriptor.
        network: colour network.
        folds: number of folds.
        mirrors: in which each view is used.
        orientations: samples of each view in random orientations.
        distractors: other objects that an embedding is fitted on, too; None fits no embedding.
    """

    features: tuple[Feature, ...]
    options: FitOptions
    config: DescriptorConfig
    network: colornet.ColorNetwork
    folds: int
    mirrors: Sequence[str]
    orientations: int
    distractors: Distractors | None

    def record(self, digest: str) -> dict[str, Any]:
        """Return everything that determines the run as JSON holds it; `digest` is that of the labelled views."""
        added = {} if self.distractors is None else {"distractors": self.distractors.record}
        return added | {
            "descriptor_version": DESCRIPTOR_VERSION,
            "descriptor_config": dataclasses.asdict(self.config),
            "color_network": self.network.fingerprint,
            "dataset": digest,
            "classifiers": list(self.features),
            "folds": self.folds,
            "mirrors": list(self.mirrors),
            "orientation_copies": self.orientations,
            "epochs": self.options.epochs,
            "learning_rates": list(self.options.learning_rates),
            "batch_size": self.options.batch_size,
            "seed": self.options.seed,
        }


@dataclasses.dataclass(frozen=True)
class _Training(_Settings):
    """The job of one run directory.

    Attributes:
        source: labelled views.
        out: absolute path of the run directory.
    """

    source: ViewSource
    out: Path

    def check_begun(self) -> None:
        """Raise InputError if `out` holds an interrupted training of another job."""
        path = self.out / CHECKPOINTS / BEGUN
        if path.is_file():
            try:
                begun = dict(json.loads(path.read_bytes()))
            except (OSError, ValueError, TypeError, RecursionError) as error:
                raise InputError(f"out: {path} cannot be read ({error}); delete {path.parent} to start anew") from None
            check_same_job(self.out, begun, self.record(self.source.digest))

    def begin(self) -> None:
        """Write the job record unless the training is resumed."""
        path = self.out / CHECKPOINTS / BEGUN
        if not path.is_file():
            write_text(path, json.dumps(self.record(self.source.digest), indent=1) + "\n")


def check_out(out: str | Path) -> None:
    """Raise InputError unless `out` is new, empty, or the directory of an interrupted training."""
    check_output_directory(out, f"{CHECKPOINTS}/{BEGUN}", (VIEWS, CHECKPOINTS))


def is_finished(out: Path) -> bool:
    """Return whether a directory holds a trained run, or all folds of one."""
    trained = any((directory / RUN_FILE).is_file() for directory in (out, *out.glob("fold-*")))
    return trained and not (out / CHECKPOINTS).exists()


def check_trained(
    digest: str,
    out: Path,
    features: Sequence[str],
    options: FitOptions,
    folds: int = 1,
    mirrors: Sequence[str] = MIRRORS,
    config: DescriptorConfig | None = None,
    orientations: int = 0,
    distractors: Distractors | None = None,
) -> None:
    """Raise if a finished run differs from what `train_run` trains for the same arguments.

    Args:
        digest: digest of the labelled views.
        out: directory of the finished run.
        features: as for `train_run`, like the others.
        options: fit options.
        folds: number of folds.
        mirrors: mirrors in which each view is used.
        config: descriptor, see `train_run`.
        orientations: see `train_run`.
        distractors: see `train_run`.

    Raises:
        InputError: The run was trained with another value, which is named, or cannot be read.
    """
    names = check_features(features, "classifiers")
    network = colornet.load_default()
    settings = _Settings(names, options, config or CONFIG, network, folds, mirrors, orientations, distractors)
    requested = settings.record(digest)
    record = finished_record(out)
    stored = {"orientation_copies": 0, **record, "dataset": record["dataset"]["digest"]}
    stored["descriptor_config"] = {"orientations": 1, **record["descriptor_config"]}  # version 0.1.0 has neither
    check_same_job(out, {name: stored.get(name) for name in requested}, requested)


def finished_record(out: Path) -> Mapping[str, Any]:
    """Return the record of a finished run, or of the first fold of one.

    Raises:
        InputError: The run cannot be read.
    """
    return load_run(out if (out / RUN_FILE).is_file() else out / "fold-0").record


def _wait_for_all(point: str) -> None:
    """Wait until all processes are here, so that none reads what the first one has not written."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(point)


def train_run(
    source: ViewSource,
    out: str | Path,
    features: Sequence[str],
    options: FitOptions,
    progress: Progress = lambda stage, done, total, note: None,
    config: DescriptorConfig | None = None,
    folds: int = 1,
    mirrors: Sequence[str] = MIRRORS,
    orientations: int = 0,
    distractors: Distractors | None = None,
) -> list[TrainedRun]:
    """Train one classifier per feature and fold and write the run directory or directories; resume if interrupted.

    Trains on all devices of all processes; each process is called with the same arguments and sees the same files.
    `training.fitting.fit` describes what is equal between two trainings with the same seed.

    Args:
        source: labelled views.
        out: run directory: new, empty, or with the same training interrupted.
        features: any of "ce", "tops", "tops2".
        options: fit options of every classifier.
        progress: called after each step.
        config: descriptor; by default the paper's, with diagrams in closed form.
        folds: with more than one, one model per fold (`out`/fold-0, ...), with the fold as its held-out set.
        mirrors: mirrors in which each view is used.
        orientations: further samples of each view, in random orientations.
        distractors: fit an embedding on the views and on these objects, and calibrate the confidence; without folds,
            one view of `HELD_OUT` is held out for it. None fits none.

    Returns:
        The run of each fold, as read back.

    Raises:
        InputError: Nothing is written if a feature is unknown, `out` holds something else, another process trains in it
            or it was begun with other options or views, a class has no views or fewer than folds, or the batch does not
            divide among the devices. If a loss is not finite, the checkpoints so far stay.
        OSError: A file cannot be written; the last complete checkpoints stay.
    """
    names = check_features(features, "classifiers")
    network = colornet.load_default()
    out = Path(out).absolute()
    if distractors is not None:
        distractors.check(source.classes)
    training = _Training(
        names, options, config or CONFIG, network, folds, tuple(mirrors), orientations, distractors, source, out
    )
    check_out(out)
    training.check_begun()
    check_batch_size(options.batch_size, batch_mesh())
    with contextlib.ExitStack() as locks:
        first, resumed = jax.process_index() == 0, (out / CHECKPOINTS).is_dir()
        if first and resumed:
            locks.enter_context(locked(out / CHECKPOINTS))
        samples = _describe_views(training, progress)
        is_held_out = folds > 1 or distractors is not None
        parts = folds if folds > 1 or distractors is None else _held_out_parts(samples)
        fold_of = fold_of_views(samples.label, samples.view, samples.classes, parts, options.seed)
        _wait_for_all("checked")
        if first:
            if not resumed:
                check_out(out)  # another process may have been quicker
                (out / CHECKPOINTS).mkdir(parents=True, exist_ok=True)
                locks.enter_context(locked(out / CHECKPOINTS))
                training.check_begun()
            training.begin()
            remove_leftovers(out)
        _wait_for_all("begun")
        runs = [
            _train_fold(training, samples, fold, fold_of == fold if is_held_out else None, progress)
            for fold in range(folds)
        ]
        _wait_for_all("trained")
        if first:
            # Renamed first: whenever the process is killed, the run is either interrupted or finished.
            shutil.rmtree((out / CHECKPOINTS).rename(out / f".{CHECKPOINTS}"))
        return runs


def _held_out_parts(samples: Samples) -> int:
    """Return the number of parts of the views of which one is held out; fewer if a class has few views."""
    fewest = min(len(np.unique(samples.view[samples.label == label])) for label in range(len(samples.classes)))
    return max(2, min(HELD_OUT, fewest))


def _describe_views(training: _Training, progress: Progress) -> Samples:
    done, total = 0, sum(shard.views for shard in training.source.shards)

    def advance(count: int) -> None:
        nonlocal done
        done += count
        progress("describe", done, total, "views")

    return build_samples(
        training.source,
        training.network,
        training.config,
        advance,
        training.mirrors,
        training.orientations,
        training.options.seed,
    )


def _train_fold(
    training: _Training, samples: Samples, fold: int, held_out: NDArray[np.bool_] | None, progress: Progress
) -> TrainedRun:
    """Train and publish the run of a fold, unless it is finished, and read it back."""
    out, config, network = training.out, training.config, training.network
    directory = out if training.folds == 1 else out / f"fold-{fold}"
    if not (directory / RUN_FILE).is_file():
        classifiers, best_epochs = _fit_classifiers(training, samples, fold, held_out, progress)
        calibrated = temperatures(classifiers, samples, held_out, network, config)
        if jax.process_index() == 0:
            run = TrainedRun(config, network, samples.classes, classifiers, {})
            embedding, calibration = _fit_embedding(training, samples, fold, held_out, run, progress)
            rows = read_metrics(out / METRICS)
            draw_curves(
                {name: [row for row in rows if row["classifier"] == name] for name in training.features}, out / CURVES
            )
            record = training.record(training.source.digest)
            record |= {"dataset": training.source.record, "samples": len(samples), "fold": fold}
            record |= _outcome([row for row in rows if row["fold"] == fold], best_epochs)
            record["temperatures"] = calibrated
            if calibration is not None:
                record["calibration"] = dataclasses.asdict(calibration)
            _publish(
                dataclasses.replace(run, record=record),
                embedding,
                out / CHECKPOINTS / f"fold-{fold}" / "run",
                directory,
            )
        _wait_for_all("published")
    return load_run(directory)


def _fit_classifiers(
    training: _Training, samples: Samples, fold: int, held_out: NDArray[np.bool_] | None, progress: Progress
) -> tuple[dict[Feature, MLP], dict[Feature, int]]:
    """Fit the classifiers of a fold; return them and the epochs that they are from."""
    first, metrics_file = jax.process_index() == 0, training.out / METRICS
    classifiers: dict[Feature, MLP] = {}
    best_epochs: dict[Feature, int] = {}
    for name in training.features:
        stage = f"fit {name}" if held_out is None else f"fold {fold}: fit {name}"

        def show(done: int, total: int, metrics: EpochMetrics, stage: str = stage) -> None:
            note = (
                f"epoch {metrics.epoch}/{training.options.epochs}, loss {metrics.loss:.3f}, "
                f"accuracy {metrics.accuracy:.3f}, {metrics.samples_per_second:,.0f} samples/s"
            )
            progress(stage, done, total, note)

        def epoch_done(metrics: EpochMetrics, name: Feature = name) -> None:
            if first:
                append_metrics(metrics_file, fold, name, metrics)

        context = FitContext(name, training.network, training.config)
        with Checkpoints(training.out / CHECKPOINTS / f"fold-{fold}" / name) as checkpoints:
            if first:
                discard_later_epochs(metrics_file, fold, name, checkpoints.last_epoch)
            classifiers[name], best_epochs[name] = fit(
                samples, context, training.options, checkpoints, held_out, show, epoch_done
            )
    return classifiers, best_epochs


def _fit_embedding(
    training: _Training,
    samples: Samples,
    fold: int,
    held_out: NDArray[np.bool_] | None,
    run: TrainedRun,
    progress: Progress,
) -> tuple[Embedding | None, Calibration | None]:
    """Fit the embedding of a fold and calibrate the confidence on its held-out set; None and None without distractors.

    An interrupted fit starts again, on the samples of the distractors that are on disk.
    """
    if training.distractors is None or held_out is None:
        return None, None
    embedding, kept = fit_run_embedding(
        training.source,
        {label: np.unique(samples.view[held_out & (samples.label == label)]) for label in np.unique(samples.label)},
        training.distractors,
        training.out / CHECKPOINTS / "distractors",
        training.network,
        training.config,
        training.options.seed,
        progress if training.folds == 1 else lambda stage, *values: progress(f"fold {fold}: {stage}", *values),
    )
    return embedding, fit_calibration(run, embedding, kept)


def _outcome(rows: Sequence[Mapping[str, Any]], best_epochs: Mapping[Feature, int]) -> dict[str, Any]:
    """Return the results of a fold for its record: curves, the epochs kept and the held-out accuracy."""
    curves: dict[str, list[dict[str, Any]]] = {name: [] for name in best_epochs}
    held_out: dict[str, float] = {}
    for row in rows:
        name = row["classifier"]
        curves[name].append({key: row[key] for key in CURVE if row[key] is not None})
        if row["epoch"] == best_epochs[name] and row["held_out_accuracy"] is not None:
            held_out[name] = row["held_out_accuracy"]
    return {"kept_epochs": dict(best_epochs), "held_out_accuracy": held_out, "curves": curves}


def _publish(run: TrainedRun, embedding: Embedding | None, complete: Path, directory: Path) -> None:
    """Write a run to `complete` and move its files into `directory`; run.json is moved last."""
    shutil.rmtree(complete, ignore_errors=True)  # left by a process that was killed just here
    save_run(run, complete)
    directory.mkdir(exist_ok=True)
    shutil.rmtree(directory / "weights", ignore_errors=True)
    if embedding is not None:
        embedding.save(directory / EMBEDDING_FILE)
    for name in ("weights", "network.npz", RUN_FILE):
        (complete / name).rename(directory / name)
