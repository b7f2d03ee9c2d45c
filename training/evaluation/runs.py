"""Trained runs that are evaluated together.

They are the folds of one training, several trainings on the same classes, or one training for each sequence of a
dataset.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
from numpy.typing import NDArray

from thor2_jax.capacity import BATCH_BUCKETS
from thor2_jax.errors import InputError
from thor2_jax.files import content_digest, json_digest
from thor2_jax.gallery.store import GALLERY_DIRECTORY, INDEX_FILE
from thor2_jax.model.inference import infer, object_scores
from thor2_jax.model.model import Model
from thor2_jax.model.run_directory import EMBEDDING_FILE
from thor2_jax.model.run_record import RUN_FILE
from thor2_jax.networks.networks import EMBEDDING
from thor2_jax.printable import first_names
from thor2_jax.recognizer import DescribedFrame, Recognizer
from training.baselines.baseline import BaselineInputs, baseline_file
from training.baselines.image_baselines import ARCHITECTURES
from training.baselines.job import TITLES, TrainedBaseline, load_baselines
from training.evaluation.answers import ALL_CLASSIFIERS, BOTH, GALLERY
from training.readers.labelled import named_path, path_ends, sequence_of
from training.train_run import find_run_directories

__all__ = ["Run", "all_predictors", "load_runs", "load_sequence_runs", "scratch_networks"]


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
    """A trained run.

    Attributes:
        name: name of its directory; for a fold, with the name of the training's directory.
        digest: SHA-256 of the files of its model.
        recognizer: recognizer with the run's classifiers.
        baselines: baselines in the run directory.
        temperatures: temperatures of those classifiers and baselines that were calibrated on a held-out set.
    """

    name: str
    digest: str
    recognizer: Recognizer
    baselines: Mapping[str, TrainedBaseline] = dataclasses.field(default_factory=dict)
    temperatures: Mapping[str, float] = dataclasses.field(default_factory=dict)
    own_objects = False  # whether the classes of a frame are the objects of its sequence

    @property
    def model(self) -> Model:
        """The model of `recognizer`."""
        return self.recognizer.model

    @property
    def has_real_views(self) -> bool:
        """Whether the run was trained on labelled real instances, too."""
        return "frames" in self.model.run.record.get("dataset", {})

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the trained classes and the enrolled objects, in the order of the probabilities."""
        return self.model.names

    @property
    def predictors(self) -> tuple[str, ...]:
        """Names of the classifiers and baselines, and of the columns of the embedding and the enrolled objects."""
        model = self.model
        names = (*model.run.classifiers, *self.baselines)
        if EMBEDDING in model.classifiers:
            names += (EMBEDDING, ALL_CLASSIFIERS) if model.run.classifiers else (EMBEDDING,)
        if model.gallery.objects:
            names += (GALLERY, BOTH) if model.classifiers else (GALLERY,)
        return names

    @property
    def answer_by(self) -> str:
        """Source of the answers: "classifiers", "gallery" or "both"."""
        return self.model.answers_by()

    @property
    def thresholds(self) -> NDArray[np.float64]:
        """Confidence [C], for each class, below which an object is unknown; 0 means no rejection."""
        return self.model.thresholds()

    def probabilities(
        self, frame: str, described: DescribedFrame, inputs: BaselineInputs | None
    ) -> dict[str, NDArray[np.float32]]:
        """Return classifier, baseline or gallery -> [B, C] class probabilities or scores of a frame's instances.

        Args:
            frame: identifier of the frame.
            described: the described frame.
            inputs: inputs of the baselines; None if no run has any.
        """
        model = self.model
        names, embeds = tuple(model.classifiers), GALLERY in self.predictors
        inference = infer(model, described.oriented, described.packed, names, embeds=embeds)
        inference = jax.tree.map(np.asarray, inference)
        default = {name: inference.probabilities[name] for name in model.chosen_classifiers()}
        values = dict(inference.probabilities)
        if EMBEDDING in default:
            column = ALL_CLASSIFIERS if ALL_CLASSIFIERS in self.predictors else EMBEDDING
            values[column] = np.asarray(model.fused(default), np.float32)
        if inputs is not None:
            values |= {name: baseline.predict(inputs) for name, baseline in self.baselines.items()}
        values = {name: model.gallery.of_classifiers(p) for name, p in values.items()}
        if GALLERY in self.predictors:
            scores = object_scores(model, inference)
            values[GALLERY] = model.combined({}, scores)
        if BOTH in self.predictors:
            values[BOTH] = model.combined(default, scores)
        return values


def _digest(path: Path) -> str:
    baselines = baseline_file(path, "[!.]*")  # without the temporary file of a killed process
    weights = [*sorted((path / "weights").rglob("*")), *sorted(baselines.parent.glob(baselines.name))]
    enrolled = path / EMBEDDING_FILE, path / GALLERY_DIRECTORY / INDEX_FILE  # the index has the objects' digests
    files = [file for file in (path / RUN_FILE, path / "network.npz", *weights, *enrolled) if file.is_file()]
    return content_digest(
        part
        for file in files
        for part in (f"{file.relative_to(path).as_posix()}\0{file.stat().st_size}\0", file.read_bytes())
    )


def load_runs(paths: Sequence[Path], frames: Sequence[str] | None = None) -> Sequence[Run]:
    """Load runs that share classes, descriptor and colour network, so that a frame is described once for all runs.

    Args:
        paths: run directories, or directories with the folds of a training; with `frames`, one directory, see
            `load_sequence_runs`.
        frames: identifiers of the frames if there is a run for each sequence; None otherwise.

    Raises:
        InputError: a run cannot be read or is given twice, classes, descriptor or colour network differ, or several
            directories of sequences are given; also as `load_sequence_runs`.
    """
    if frames is not None:
        if len(paths) != 1:
            raise InputError(
                f"per_sequence: {len(paths)} models are given; expected one directory with a run per sequence"
            )
        return load_sequence_runs(paths[0], frames)
    directories = find_run_directories(paths)
    runs = [_load(directory) for directory in directories]
    by_digest: dict[str, Path] = {}
    for directory, run in zip(directories, runs, strict=True):
        if run.digest in by_digest:
            raise InputError(f"model: {by_digest[run.digest]} and {directory} are the same run; give it once")
        by_digest[run.digest] = directory
        if run.classes != runs[0].classes:
            different = sorted(set(run.classes) ^ set(runs[0].classes))
            raise InputError(
                f"model: {directories[0]} and {directory} have different classes "
                f"({first_names(different) or 'in another order'}); evaluate them separately"
            )
        _check_same_descriptor(run, runs[0], directory, directories[0])
    return runs


def _check_same_descriptor(run: Run, first: Run, directory: Path, first_directory: Path) -> None:
    a, b = run.model, first.model
    is_same = a.run.config == b.run.config and a.run.network.fingerprint == b.run.network.fingerprint
    if not is_same or a.color_transform != b.color_transform:
        reason = "are adapted to different cameras" if is_same else "have different descriptors or colour networks"
        raise InputError(f"model: {first_directory} and {directory} {reason}; evaluate them separately")


def all_predictors(runs: Sequence[Run]) -> tuple[tuple[int, str], ...]:
    """Return (index of the run, name) of every classifier and baseline of all runs."""
    return tuple((index, name) for index, run in enumerate(runs) for name in run.predictors)


@dataclasses.dataclass(frozen=True, eq=False)
class SequenceRun(Run):
    """Several runs, each trained on the objects of one sequence and used for the frames of this sequence.

    Attributes:
        recognizer: recognizer of any of the runs, which describes the frames.
        of_sequence: sequence -> its run. The sequence of a frame is its identifier without the last part.
    """

    of_sequence: Mapping[str, Run] = dataclasses.field(default_factory=dict)
    own_objects = True

    @functools.cached_property
    def classes(self) -> tuple[str, ...]:
        """Class names of all runs, sorted."""
        return tuple(sorted({name for run in self.of_sequence.values() for name in run.classes}))

    @property
    def thresholds(self) -> NDArray[np.float64]:
        """Zeros, since the runs of the sequences have different thresholds."""
        return np.zeros(len(self.classes))

    def probabilities(
        self, frame: str, described: DescribedFrame, inputs: BaselineInputs | None
    ) -> dict[str, NDArray[np.float32]]:
        """Return the class probabilities of the sequence's run; 0 for the classes of other runs."""
        run = self.of_sequence[sequence_of(frame)]
        columns = [self.classes.index(name) for name in run.classes]
        padded = {}
        for name, values in run.probabilities(frame, described, inputs).items():
            padded[name] = np.zeros((len(values), len(self.classes)), np.float32)
            padded[name][:, columns] = values
        return padded


def load_sequence_runs(directory: Path, frames: Iterable[str]) -> list[SequenceRun]:
    """Load the runs of a directory that holds a run, or the folds of a run, for each sequence of a dataset.

    The run of the sequence a/b/c is `directory`/a/b/c, `directory`/b/c or `directory`/c, whichever is found first.

    Args:
        directory: directory of the runs.
        frames: identifiers of the dataset's frames.

    Returns:
        One run per fold of the sequences, without temperatures.

    Raises:
        InputError: a sequence has no run, a run cannot be read, or runs differ in their classifiers, baselines, number
            of folds, descriptor or colour network.
    """
    directories = {
        sequence: [directory / end for end in path_ends(sequence) if (directory / end).is_dir()]
        for sequence in dict.fromkeys(map(sequence_of, frames))
    }
    loaded = {path: load_runs([path]) for path in dict.fromkeys(paths[0] for paths in directories.values() if paths)}
    if missing := [sequence for sequence, paths in directories.items() if not paths]:
        raise InputError(
            f"model: {directory} has no run for {', '.join(missing)}; train the missing ones with "
            "`thor2 train --sequences`"
        )
    (first_path, first), *others = loaded.items()
    for path, runs in others:
        if [run.predictors for run in runs] != [run.predictors for run in first]:
            raise InputError(
                f"model: {first_path} and {path} have different folds, classifiers or baselines; train them alike"
            )
        _check_same_descriptor(runs[0], first[0], path, first_path)
    result = []
    for fold, run in enumerate(first):
        of_sequence = {sequence: loaded[paths[0]][fold] for sequence, paths in directories.items()}
        digest = json_digest({sequence: each.digest for sequence, each in of_sequence.items()})
        name = f"{named_path(directory).name}/*" + (f"/fold-{fold}" if len(first) > 1 else "")
        result.append(SequenceRun(name, digest, run.recognizer, run.baselines, of_sequence=of_sequence))
    return result


def scratch_networks(runs: Sequence[Run]) -> list[str]:
    """Return the titles of image networks without pretrained weights, including templates with such a backbone."""
    names = {name for run in runs for name, baseline in run.baselines.items() if not baseline.weights}
    return [TITLES[name] for name in ARCHITECTURES if name in names]


def _load(directory: Path) -> Run:
    recognizer = Recognizer.load(directory, chunk=BATCH_BUCKETS[-1])
    baselines = load_baselines(directory, recognizer.run)
    temperatures = {name: each.temperature for name, each in baselines.items() if each.temperature is not None}
    temperatures |= recognizer.run.record.get("temperatures", {})
    named = named_path(directory)
    name = f"{named.parent.name}/{named.name}" if named.name.startswith("fold-") else named.name
    return Run(name, _digest(directory), recognizer, baselines, temperatures)
