"""Run directories: a trained model on disk with everything that recognition needs.

RUN/run.json         format, descriptor version and constants, class names, classifiers and SHA-256 of their weights,
                     and a record of the training
RUN/network.npz      the colour network whose regions the descriptors use
RUN/weights/NAME/    parameters and batch statistics of one classifier (Orbax)

These three are the model: none of them may be deleted or edited. `thor2 train` adds files that recognition does not
read, and each of them may be deleted: `baselines/` (models that `thor2 evaluate` compares with), `metrics.jsonl` and
`curves.png` (loss and accuracy of each epoch) and, while a training is unfinished, `checkpoints/` and `views/`, from
which an interrupted training resumes. With several folds, each of `fold-0/`, `fold-1/`, ... is a run directory.

A run directory appears under its name only when it is complete, and everything is checked when it is loaded.
"""

import dataclasses
import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp  # type: ignore[import-untyped]
from flax import nnx

import colornet
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig, Relaxation
from thor2_jax.errors import InputError
from thor2_jax.files import check_output_directory, directory_digest
from thor2_jax.recognition.classifier import MLP, Feature, check_features

__all__ = ["RUN_FILE", "TrainedRun", "input_size", "load_run", "save_run"]

RUN_FORMAT = 1
"""Version of the layout above. Directories of version 0.1 have a `digest` in run.json, which is not read."""

RUN_FILE = "run.json"


@dataclasses.dataclass(frozen=True)
class TrainedRun:
    """The content of a run directory.

    Attributes:
        config: constants of the descriptor.
        network: the colour network.
        classes: class names, in the order of a classifier's outputs.
        classifiers: feature -> trained MLP.
        record: how the run was made (options, counts, training metrics), as JSON holds it.
    """

    config: DescriptorConfig
    network: colornet.ColorNetwork
    classes: tuple[str, ...]
    classifiers: Mapping[Feature, MLP]
    record: Mapping[str, Any]


def input_size(feature: Feature, config: DescriptorConfig, n_regions: int) -> int:
    """Return the number of floats in a descriptor."""
    image, embedding = config.image_size**2, n_regions * config.n_strips
    return config.n_slices * {"ce": embedding, "tops": image, "tops2": image + embedding}[feature]


def _checkpointer() -> Any:
    """Return an Orbax checkpointer for this process alone; in a job of several it would wait for the others."""
    process = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(primary_host=process, active_processes={process})
    return ocp.StandardCheckpointer(multiprocessing_options=alone)


def _weights_digest(path: Path, n_inputs: int, n_classes: int) -> str:
    """Return the SHA-256, in hexadecimal, of a classifier's files and sizes.

    It is compared before Orbax reads anything: Orbax does not notice all damage, and where it does, its unfinished
    reads print tracebacks from their threads.
    """
    return directory_digest(path, f"{n_inputs} {n_classes}")


def save_run(run: TrainedRun, path: str | Path) -> None:
    """Write a run directory. It appears under its name only when it is complete.

    Raises:
        InputError: the path exists and is not an empty directory.
        OSError: the directory cannot be written; nothing is left behind.
    """
    path = Path(path).resolve()
    check_output_directory(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        partial.chmod(0o755)
        colornet.save(run.network, partial / "network.npz")
        with _checkpointer() as checkpointer:
            for name, model in run.classifiers.items():
                state = nnx.to_pure_dict(nnx.state(model, (nnx.Param, nnx.BatchStat)))
                checkpointer.save(partial / "weights" / name, jax.tree.map(np.asarray, state))
            checkpointer.wait_until_finished()
        (partial / RUN_FILE).write_text(json.dumps(_description(run, partial / "weights"), indent=2) + "\n")
        partial.rename(path)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _description(run: TrainedRun, weights: Path) -> dict[str, Any]:
    """Return the content of run.json for a run whose weights are already on disk."""
    n_inputs = {name: input_size(name, run.config, run.network.n_regions) for name in run.classifiers}
    return {
        "format": RUN_FORMAT,
        "descriptor_version": DESCRIPTOR_VERSION,
        "descriptor_config": dataclasses.asdict(run.config),
        "color_network": run.network.fingerprint,
        "classes": list(run.classes),
        "classifiers": list(run.classifiers),
        "weights": {name: _weights_digest(weights / name, n, len(run.classes)) for name, n in n_inputs.items()},
        "record": run.record,
    }


def load_run(path: str | Path) -> TrainedRun:
    """Read a run directory.

    Raises:
        InputError: the path is no run directory, a file is damaged, the format or the descriptor version is another
            one, or the files do not belong together. The message names the file.
    """
    path = Path(path).absolute()
    description = _read_description(path)
    try:
        config = _config(description["descriptor_config"])
        classes, record = description["classes"], dict(description["record"])
        names = check_features(description["classifiers"], "classifiers")
        fingerprint = description["color_network"]
        digests = {name: description["weights"][name] for name in names}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"model: {path / RUN_FILE}: {type(error).__name__}: {error}") from None
    if not isinstance(classes, list) or not classes or not all(isinstance(name, str) for name in classes):
        raise InputError(f"model: {path / RUN_FILE}: classes is {classes!r}; expected a list of names")
    try:
        network = colornet.load(path / "network.npz")
    except (OSError, ValueError) as error:
        raise InputError(f"model: {path / 'network.npz'} cannot be read: {error}") from None
    if network.fingerprint != fingerprint:
        raise InputError(f"model: {path / 'network.npz'} is not the colour network that run.json names")
    classifiers = {}
    for name in names:
        n_inputs = input_size(name, config, network.n_regions)
        classifiers[name] = _load_classifier(path / "weights" / name, n_inputs, len(classes), digests[name])
    return TrainedRun(config, network, tuple(classes), classifiers, record)


def _read_description(path: Path) -> dict[str, Any]:
    try:
        description = json.loads((path / RUN_FILE).read_text())
    except FileNotFoundError:
        raise InputError(f"model: {path} is no run directory (it has no run.json)") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"model: {path / RUN_FILE} cannot be read: {error}") from None
    if not isinstance(description, dict) or description.get("format") != RUN_FORMAT:
        value = description.get("format") if isinstance(description, dict) else type(description).__name__
        raise InputError(f"model: {path / RUN_FILE} has format {value!r}; this version reads {RUN_FORMAT}")
    if description.get("descriptor_version") != DESCRIPTOR_VERSION:
        raise InputError(
            f"model: {path} was trained on descriptor version {description.get('descriptor_version')!r}; "
            f"this version computes {DESCRIPTOR_VERSION}; train it again"
        )
    return description


def _config(constants: Mapping[str, Any]) -> DescriptorConfig:
    relaxation = constants["relaxation"]
    return DescriptorConfig(**{**constants, "relaxation": None if relaxation is None else Relaxation(**relaxation)})


def _load_classifier(path: Path, n_inputs: int, n_classes: int, digest: str) -> MLP:
    if not path.is_dir():
        raise InputError(f"model: {path} is missing")
    if digest != _weights_digest(path, n_inputs, n_classes):
        raise InputError(f"model: {path} is damaged, or not of {n_inputs} inputs and {n_classes} classes")
    return _restore_weights(path, n_inputs, n_classes)


def _restore_weights(path: Path, n_inputs: int, n_classes: int) -> MLP:
    try:
        with _checkpointer() as checkpointer:
            model = MLP(n_inputs, n_classes, rngs=nnx.Rngs(0))
            state = nnx.state(model, (nnx.Param, nnx.BatchStat))
            restored = checkpointer.restore(path, jax.tree.map(np.asarray, nnx.to_pure_dict(state)))
    except Exception as error:  # Orbax raises whatever its storage layers raise
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(f"model: {path} cannot be read: {reason[0][:300]}") from None
    nnx.replace_by_pure_dict(state, jax.tree.map(jnp.asarray, restored))
    nnx.update(model, state)
    return model
