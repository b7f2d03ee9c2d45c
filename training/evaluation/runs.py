"""The trained runs that are evaluated together.

Folds of one training, several trainings of the same classes, or a training for each sequence of a dataset.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import content_digest, json_digest
from thor2_jax.recognition.recognizer import DescribedFrame, Recognizer
from thor2_jax.recognition.run_directory import RUN_FILE
from training.baselines.baseline import Baseline, Seen
from training.baselines.files import baseline_file
from training.baselines.load import load_baselines
from training.fitting.run_directories import find_run_directories
from training.readers.labelled import path_ends, sequence_of

__all__ = ["Run", "SequenceRun", "load_runs", "load_sequence_runs"]


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
    """A trained run, ready to answer.

    Attributes:
        name: its folder's; of a fold, its training's folder too.
        digest: SHA-256 of what the folder holds of the model.
        recognizer: reads the run.
        baselines: those that the folder has.
        temperatures: of the classifiers and baselines that were calibrated on held-out views.
    """

    name: str
    digest: str
    recognizer: Recognizer
    baselines: Mapping[str, Baseline] = dataclasses.field(default_factory=dict)
    temperatures: Mapping[str, float] = dataclasses.field(default_factory=dict)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names, in the order of the probabilities."""
        return self.recognizer.run.classes

    @property
    def asked(self) -> tuple[str, ...]:
        """Classifiers and baselines, in the order of their answers."""
        return (*self.recognizer.run.classifiers, *self.baselines)

    def probabilities(self, frame: str, described: DescribedFrame, seen: Seen | None) -> dict[str, NDArray[np.float32]]:
        """Classifier or baseline -> [B, C] probabilities of a frame's instances.

        Args:
            frame: its identifier.
            described: the frame.
            seen: what baselines read of it; None if no run has any.
        """
        said = {str(name): found for name, found in self.recognizer.probabilities(described.descriptors).items()}
        if seen is not None:
            said |= {name: baseline.probabilities(seen) for name, baseline in self.baselines.items()}
        return said


def _digest(path: Path) -> str:
    baselines = baseline_file(path, "[!.]*")  # without temporary files
    weights = [*sorted((path / "weights").rglob("*")), *sorted(baselines.parent.glob(baselines.name))]
    files = [file for file in (path / RUN_FILE, path / "network.npz", *weights) if file.is_file()]
    return content_digest(
        part
        for file in files
        for part in (f"{file.relative_to(path).as_posix()}\0{file.stat().st_size}\0", file.read_bytes())
    )


def load_runs(paths: Sequence[Path]) -> list[Run]:
    """Read the runs of `paths`, which share classes, descriptor and colour network: a frame is described once for all.

    Raises:
        InputError: no run, one that cannot be read, one given twice, or runs that differ in what they share.
    """
    folders = find_run_directories(paths)
    if not folders:
        raise InputError("model: no run folder is given")
    runs = [_load(folder) for folder in folders]
    seen: dict[str, Path] = {}
    for folder, run in zip(folders, runs, strict=True):
        if run.digest in seen:
            raise InputError(f"model: {seen[run.digest]} and {folder} are the same run")
        seen[run.digest] = folder
        if run.classes != runs[0].classes:
            different = sorted(set(run.classes) ^ set(runs[0].classes))
            raise InputError(
                f"model: {folders[0]} and {folder} have different classes "
                f"({', '.join(different[:5]) or 'in another order'})"
            )
        _check_same_descriptor(run, runs[0], folder, folders[0])
    return runs


def _check_same_descriptor(run: Run, first: Run, folder: Path, first_folder: Path) -> None:
    a, b = run.recognizer.run, first.recognizer.run
    if a.config != b.config or a.network.fingerprint != b.network.fingerprint:
        raise InputError(f"model: {first_folder} and {folder} have different descriptors or colour networks")


@dataclasses.dataclass(frozen=True, eq=False)
class SequenceRun(Run):
    """Runs that were trained on the objects of one sequence each, as one: each answers the frames of its sequence.

    Attributes:
        recognizer: of any of them; describes the frames.
        of_sequence: sequence -> its run. The sequence of a frame is its identifier without the last part.
    """

    of_sequence: Mapping[str, Run] = dataclasses.field(default_factory=dict)

    @functools.cached_property
    def classes(self) -> tuple[str, ...]:
        """Names of all runs, sorted."""
        return tuple(sorted({name for run in self.of_sequence.values() for name in run.classes}))

    def probabilities(self, frame: str, described: DescribedFrame, seen: Seen | None) -> dict[str, NDArray[np.float32]]:
        """As of the sequence's own run, and 0 for objects that it does not know."""
        run = self.of_sequence[sequence_of(frame)]
        columns = [self.classes.index(name) for name in run.classes]
        found = {}
        for name, values in run.probabilities(frame, described, seen).items():
            found[name] = np.zeros((len(values), len(self.classes)), np.float32)
            found[name][:, columns] = values
        return found


def load_sequence_runs(folder: Path, frames: Iterable[str]) -> list[SequenceRun]:
    """Read the runs of a folder that holds one, or the folds of one, for each sequence of a dataset.

    That of the sequence a/b/c is in `folder`/a/b/c, `folder`/b/c or `folder`/c, whichever comes first.

    Args:
        folder: of the runs.
        frames: identifiers of the dataset's frames.

    Returns:
        As many as each sequence has folds; their own temperatures are left out.

    Raises:
        InputError: sequences without a run, a run that cannot be read, or runs that differ in classifiers, baselines,
            folds, descriptor or colour network.
    """
    loaded: dict[Path, list[Run]] = {}
    of_sequence: dict[str, list[Run]] = {}
    lacking = []
    for sequence in dict.fromkeys(map(sequence_of, frames)):
        own = next((folder / end for end in path_ends(sequence) if (folder / end).is_dir()), None)
        if own is None:
            lacking.append(sequence)
        else:
            if own not in loaded:
                loaded[own] = load_runs([own])
            of_sequence[sequence] = loaded[own]
    if lacking or not loaded:
        raise InputError(f"model: {folder} has no run for {', '.join(lacking) or 'any sequence'}")
    (first_folder, first), *others = loaded.items()
    for own, runs in others:
        if [run.asked for run in runs] != [run.asked for run in first]:
            raise InputError(f"model: {first_folder} and {own} have different folds, classifiers or baselines")
        _check_same_descriptor(runs[0], first[0], own, first_folder)
    found = []
    for fold, run in enumerate(first):
        mine = {sequence: runs[fold] for sequence, runs in of_sequence.items()}
        digest = json_digest({sequence: run.digest for sequence, run in mine.items()})
        name = f"{folder.absolute().name}/*" + (f"/fold-{fold}" if len(first) > 1 else "")
        found.append(SequenceRun(name, digest, run.recognizer, run.baselines, of_sequence=mine))
    return found


def _load(folder: Path) -> Run:
    recognizer = Recognizer.load(folder)
    baselines, temperatures = load_baselines(folder, recognizer.run)
    temperatures |= recognizer.run.record.get("temperatures", {})
    return Run(_name(folder), _digest(folder), recognizer, baselines, temperatures)


def _name(folder: Path) -> str:
    folder = folder.absolute()
    return f"{folder.parent.name}/{folder.name}" if folder.name.startswith("fold-") else folder.name
