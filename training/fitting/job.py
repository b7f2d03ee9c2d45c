"""From labelled views to a run folder: samples, one classifier a feature and fold, figures, curves, record.

RUN/run.json, network.npz, weights/   the trained model (`run_folder`); of several folds, RUN/fold-0/run.json and so on
RUN/metrics.jsonl                     a line an epoch, classifier and fold
RUN/curves.png                        the same, drawn
RUN/checkpoints/                      while it is in the making: what it was begun with, and how far it is
RUN/views/                            the same: its views, where they were rendered for this run alone

A run that was stopped goes on when it is asked for again. It is a run folder once run.json is there, which comes last.
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
from thor2_jax.files import check_output_directory, write_text
from thor2_jax.recognition.classifier import MLP, Feature, check_features
from thor2_jax.recognition.run_directory import RUN_FILE, TrainedRun, load_run, save_run
from training.fitting.calibration import temperatures
from training.fitting.checkpoints import CHECKPOINTS, Checkpoints
from training.fitting.fit import check_batch_size, fit
from training.fitting.folds import fold_of_views
from training.fitting.metrics_log import append_metrics, discard_later_epochs, read_metrics
from training.fitting.options import EpochMetrics, FitOptions, Progress
from training.fitting.samples import MIRRORS, Samples, build_samples
from training.reports.plots import draw_curves
from training.storage.jobs import check_same_job
from training.storage.locks import locked
from training.views.normalized_views import ViewSource

__all__ = ["VIEWS", "check_out", "check_trained", "is_finished", "train_run"]

VIEWS = "views"
BEGUN = "begun.json"
METRICS = "metrics.jsonl"
CURVES = "curves.png"

CONFIG = DescriptorConfig(homology="closed_form")
"""The descriptor, unless another one is asked for: the paper's."""

CURVE = ("epoch", "loss", "accuracy", "held_out_accuracy")
"""What a record keeps of an epoch's figures: what another run gives again."""


def check_out(out: str | Path) -> None:
    """Raise InputError unless `out` is new, empty, or the directory of an interrupted training."""
    check_output_directory(out, f"{CHECKPOINTS}/{BEGUN}", (VIEWS, CHECKPOINTS))


def is_finished(out: Path) -> bool:
    """Whether a folder holds a trained run, or all folds of one."""
    found = any((folder / RUN_FILE).is_file() for folder in (out, *out.glob("fold-*")))
    return found and not (out / CHECKPOINTS).exists()


def _check_same(out: Path, begun: Mapping[str, Any]) -> None:
    path = out / CHECKPOINTS / BEGUN
    if not path.is_file():
        return
    try:
        found = dict(json.loads(path.read_bytes()))
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise InputError(f"out: {path} cannot be read: {error}") from None
    check_same_job(out, found, begun)


def check_trained(
    source: ViewSource,
    out: str | Path,
    features: Sequence[str],
    options: FitOptions,
    folds: int = 1,
    mirrors: Sequence[str] = MIRRORS,
) -> None:
    """Refuse a finished run that is not what `train_run` gives for the same arguments.

    Raises:
        InputError: naming what differs, or a run that cannot be read.
    """
    names, network = check_features(features, "classifiers"), colornet.load_default()
    asked = _asked(source, names, options, CONFIG, network, folds, mirrors)
    out = Path(out).absolute()
    record = load_run(out if (out / RUN_FILE).is_file() else out / "fold-0").record
    found = {**record, "dataset": record["dataset"]["digest"]}
    check_same_job(out, {name: found.get(name) for name in asked}, asked)


def _asked(
    source: ViewSource,
    names: Sequence[Feature],
    options: FitOptions,
    config: DescriptorConfig,
    network: colornet.ColorNetwork,
    folds: int,
    mirrors: Sequence[str],
) -> dict[str, Any]:
    """All that a trained run follows from."""
    return {
        "descriptor_version": DESCRIPTOR_VERSION,
        "descriptor_config": dataclasses.asdict(config),
        "color_network": network.fingerprint,
        "dataset": source.digest,
        "classifiers": list(names),
        "folds": folds,
        "mirrors": list(mirrors),
        "epochs": options.epochs,
        "learning_rates": list(options.learning_rates),
        "batch_size": options.batch_size,
        "seed": options.seed,
    }


def _begin(out: Path, begun: Mapping[str, Any]) -> None:
    if not (out / CHECKPOINTS / BEGUN).is_file():
        write_text(out / CHECKPOINTS / BEGUN, json.dumps(begun, indent=1) + "\n")


def _wait_for_all(point: str) -> None:
    """Wait until all processes are here, so that none reads what the first has not written."""
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
) -> list[TrainedRun]:
    """Train one classifier a feature and fold, and write the run folder or folders; or go on where that was stopped.

    Trains on all devices of all processes; each process is called with the same arguments and sees the same files.

    Args:
        source: of labelled views.
        out: the run folder; must not exist, be empty, or hold the same run in the making.
        features: any of "ce", "tops", "tops2".
        options: of the fit; the same for every classifier.
        progress: told of each step.
        config: the descriptor; by default the paper's, with diagrams in closed form.
        folds: with more than one, a model each (`out`/fold-0, ...), trained on the views of the others and measured on
            its own.
        mirrors: in which each view is used.

    Returns:
        The run of each fold, as read back.

    Raises:
        InputError: unknown features, `out` holds something else, a run in the making with other options or views
            (told before any work) or one that another process trains; classes without views, or with fewer than folds;
            a batch that does not divide among the devices: nothing is written then. A loss that is not finite: the
            checkpoints so far stay.
        OSError: something cannot be written; the last complete checkpoints stay.
    """
    names = check_features(features, "classifiers")
    config = config or CONFIG
    network = colornet.load_default()
    out = Path(out).absolute()
    begun = _asked(source, names, options, config, network, folds, mirrors)
    check_out(out)
    _check_same(out, begun)
    check_batch_size(options.batch_size, batch_mesh())
    done, total = 0, sum(shard.views for shard in source.shards)

    def described(count: int) -> None:
        nonlocal done
        done += count
        progress("describe", done, total, "views")

    with contextlib.ExitStack() as held:
        first, before = jax.process_index() == 0, (out / CHECKPOINTS).is_dir()
        if first and before:
            held.enter_context(locked(out / CHECKPOINTS))
        samples = build_samples(source, network, config, described, mirrors)
        fold_of = fold_of_views(samples.label, samples.view, samples.classes, folds, options.seed)
        _wait_for_all("checked")
        if first:
            if not before:
                check_out(out)  # another process may have been quicker
                (out / CHECKPOINTS).mkdir(parents=True, exist_ok=True)
                held.enter_context(locked(out / CHECKPOINTS))
                _check_same(out, begun)
            _begin(out, begun)
        _wait_for_all("begun")

        runs = []
        for fold in range(folds):
            folder = out if folds == 1 else out / f"fold-{fold}"
            if not (folder / RUN_FILE).is_file():
                held_out = fold_of == fold if folds > 1 else None
                classifiers, kept = _fit_fold(samples, held_out, out, fold, network, config, names, options, progress)
                calibrated = temperatures(classifiers, samples, held_out, network, config)
                if first:
                    rows = read_metrics(out / METRICS)
                    draw_curves(
                        {name: [row for row in rows if row["classifier"] == name] for name in names}, out / CURVES
                    )
                    record = begun | {"dataset": source.record, "samples": len(samples), "fold": fold}
                    record |= _outcome([row for row in rows if row["fold"] == fold], kept)
                    record["temperatures"] = calibrated
                    run = TrainedRun(config, network, samples.classes, classifiers, record)
                    _publish(run, out / CHECKPOINTS / f"fold-{fold}" / "run", folder)
                _wait_for_all("published")
            runs.append(load_run(folder))
        _wait_for_all("trained")
        if first:
            # Renamed first: wherever a kill strikes, the run is in the making or finished, and nothing in between.
            shutil.rmtree((out / CHECKPOINTS).rename(out / f".{CHECKPOINTS}"))
        return runs


def _fit_fold(
    samples: Samples,
    held_out: NDArray[np.bool_] | None,
    out: Path,
    fold: int,
    network: colornet.ColorNetwork,
    config: DescriptorConfig,
    names: Sequence[Feature],
    options: FitOptions,
    progress: Progress,
) -> tuple[dict[Feature, MLP], dict[Feature, int]]:
    """The classifiers of a fold, and which epochs they are of."""
    first = jax.process_index() == 0
    classifiers: dict[Feature, MLP] = {}
    kept: dict[Feature, int] = {}
    for name in names:
        stage = f"fit {name}" if held_out is None else f"fold {fold}: fit {name}"

        def told(done: int, total: int, figures: EpochMetrics, stage: str = stage) -> None:
            note = (
                f"epoch {figures.epoch}/{options.epochs}, loss {figures.loss:.3f}, accuracy {figures.accuracy:.3f}, "
                f"{figures.samples_per_second:,.0f} samples/s"
            )
            progress(stage, done, total, note)

        def epoch_done(figures: EpochMetrics, name: Feature = name) -> None:
            if first:
                append_metrics(out / METRICS, fold, name, figures)

        with Checkpoints(out / CHECKPOINTS / f"fold-{fold}" / name) as checkpoints:
            if first:
                discard_later_epochs(out / METRICS, fold, name, checkpoints.last_epoch)
            classifiers[name], kept[name] = fit(
                samples, network, config, name, options, checkpoints, held_out, told, epoch_done
            )
    return classifiers, kept


def _outcome(rows: Sequence[Mapping[str, Any]], kept: Mapping[Feature, int]) -> dict[str, Any]:
    """What a fold's record tells of its classifiers: curves, the epoch kept, and its accuracy on the views held out."""
    curves: dict[str, list[dict[str, Any]]] = {name: [] for name in kept}
    held_out: dict[str, float] = {}
    for row in rows:
        curves[row["classifier"]].append({key: row[key] for key in CURVE if row[key] is not None})
        if row["epoch"] == kept[row["classifier"]] and row["held_out_accuracy"] is not None:
            held_out[row["classifier"]] = row["held_out_accuracy"]
    return {"kept_epochs": dict(kept), "held_out_accuracy": held_out, "curves": curves}


def _publish(run: TrainedRun, whole: Path, folder: Path) -> None:
    """Write a run folder to `whole` and move its parts into `folder`; run.json, the last, makes that a run folder."""
    shutil.rmtree(whole, ignore_errors=True)  # of a process that was stopped just here
    save_run(run, whole)
    folder.mkdir(exist_ok=True)
    shutil.rmtree(folder / "weights", ignore_errors=True)
    for name in ("weights", "network.npz", RUN_FILE):
        (whole / name).rename(folder / name)
