"""The trained runs that are evaluated together: folds of one training, or several trainings of the same classes."""

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from thor2_jax.errors import InputError
from thor2_jax.recognizer import Recognizer
from thor2_jax.run_folder import RUN_FILE
from training.baselines.baseline import Baseline
from training.baselines.files import baseline_file
from training.baselines.load import load_baselines
from training.checkpoints import CHECKPOINTS

__all__ = ["Run", "load_runs", "run_folders"]


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
    def asked(self) -> tuple[str, ...]:
        """Classifiers and baselines, in the order of their answers."""
        return (*self.recognizer.run.classifiers, *self.baselines)


def run_folders(paths: Iterable[Path]) -> list[Path]:
    """The run folders among `paths`; of one that holds fold-0, fold-1, ..., those in their order.

    Raises:
        InputError: a folder that is neither, or a training that is not finished.
    """
    folders: list[Path] = []
    for path in map(Path, paths):
        folds = [f.parent for f in path.glob(f"fold-*/{RUN_FILE}") if f.parent.name[5:].isdecimal()]
        if (path / RUN_FILE).is_file() or not folds:
            folders.append(path)  # what is no run folder is refused when it is read
        elif (path / CHECKPOINTS).exists():
            raise InputError(f"model: the training of {path} is not finished; finish it, or name single folds of it")
        else:
            folders += sorted(folds, key=lambda fold: int(fold.name[5:]))
    return folders


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    baselines = baseline_file(path, "*")
    weights = [*sorted((path / "weights").rglob("*")), *sorted(baselines.parent.glob(baselines.name))]
    for file in [path / RUN_FILE, path / "network.npz", *weights]:
        if file.is_file():
            digest.update(f"{file.relative_to(path).as_posix()}\0{file.stat().st_size}\0".encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


def load_runs(paths: Sequence[Path]) -> list[Run]:
    """Read the runs of `paths`, which share classes, descriptor and colour network: a frame is described once for all.

    Raises:
        InputError: no run, one that cannot be read, one given twice, or runs that differ in what they share.
    """
    folders = run_folders(paths)
    if not folders:
        raise InputError("model: no run folder is given")
    runs = [_load(folder) for folder in folders]
    first = runs[0].recognizer.run
    seen: dict[str, Path] = {}
    for folder, run in zip(folders, runs, strict=True):
        if run.digest in seen:
            raise InputError(f"model: {seen[run.digest]} and {folder} are the same run")
        seen[run.digest] = folder
        other = run.recognizer.run
        if other.classes != first.classes:
            different = sorted(set(other.classes) ^ set(first.classes))
            raise InputError(
                f"model: {folders[0]} and {folder} have different classes "
                f"({', '.join(different[:5]) or 'in another order'})"
            )
        if other.config != first.config or other.network.fingerprint != first.network.fingerprint:
            raise InputError(f"model: {folders[0]} and {folder} have different descriptors or colour networks")
    return runs


def _load(folder: Path) -> Run:
    recognizer = Recognizer.load(folder)
    baselines, temperatures = load_baselines(folder, recognizer.run)
    temperatures |= recognizer.run.record.get("temperatures", {})
    return Run(_name(folder), _digest(folder), recognizer, baselines, temperatures)


def _name(folder: Path) -> str:
    folder = folder.absolute()
    return f"{folder.parent.name}/{folder.name}" if folder.name.startswith("fold-") else folder.name
