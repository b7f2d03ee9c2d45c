"""A trained model on disk: everything that recognition needs, checked on loading, written whole or not at all.

RUN/run.json       format, descriptor version and constants, class names, classifiers with digests, how it was trained,
                   and a digest of all that
RUN/network.npz    the colour network whose regions the descriptors use
RUN/weights/NAME/  one classifier's parameters and batch statistics (orbax)
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
from thor2_jax.files import check_output_directory, directory_digest, json_digest
from thor2_jax.recognition.classifier import MLP, Feature, check_features

__all__ = ["RUN_FILE", "TrainedRun", "input_size", "load_run", "save_run"]

FORMAT = 1

RUN_FILE = "run.json"


@dataclasses.dataclass(frozen=True)
class TrainedRun:
    """What a run folder holds.

    Attributes:
        config: the descriptor's constants.
        network: the colour network.
        classes: class names; a classifier's outputs are in this order.
        classifiers: feature -> trained MLP.
        record: how the run was made (options, counts, training figures): any JSON.
    """

    config: DescriptorConfig
    network: colornet.ColorNetwork
    classes: tuple[str, ...]
    classifiers: Mapping[Feature, MLP]
    record: Mapping[str, Any]


def _checkpointer() -> Any:
    """Orbax for this process alone: in a job of several it would wait for the others."""
    me = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(primary_host=me, active_processes={me})
    return ocp.StandardCheckpointer(multiprocessing_options=alone)


def input_size(feature: Feature, config: DescriptorConfig, n_regions: int) -> int:
    """Floats in the descriptor of that name."""
    image, embedding = config.image_size**2, n_regions * config.n_strips
    return config.n_slices * {"ce": embedding, "tops": image, "tops2": image + embedding}[feature]


def _digest(path: Path, n_inputs: int, n_classes: int) -> str:
    """SHA-256 of a classifier's files and sizes, in hexadecimal.

    Checked before orbax reads anything: it does not notice every damage, and where it does, its unfinished reads go on
    to print tracebacks from their threads.
    """
    return directory_digest(path, f"{n_inputs} {n_classes}")


def save_run(run: TrainedRun, path: str | Path) -> None:
    """Write a run folder. It appears under its name only when it is complete.

    Raises:
        InputError: something of that name exists already and is not an empty folder.
        OSError: it cannot be written; nothing is left behind.
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
        sizes = {
            name: (input_size(name, run.config, run.network.n_regions), len(run.classes)) for name in run.classifiers
        }
        description = {
            "format": FORMAT,
            "descriptor_version": DESCRIPTOR_VERSION,
            "descriptor_config": dataclasses.asdict(run.config),
            "color_network": run.network.fingerprint,
            "classes": list(run.classes),
            "classifiers": list(run.classifiers),
            "weights": {name: _digest(partial / "weights" / name, *sizes[name]) for name in run.classifiers},
            "record": run.record,
        }
        description["digest"] = json_digest(description)
        (partial / RUN_FILE).write_text(json.dumps(description, indent=2) + "\n")
        partial.rename(path)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _description(path: Path) -> dict[str, Any]:
    try:
        found = json.loads((path / RUN_FILE).read_text())
    except FileNotFoundError:
        raise InputError(f"model: {path} is no run folder (it has no run.json)") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"model: {path / RUN_FILE} cannot be read: {error}") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        given = found.get("format") if isinstance(found, dict) else type(found).__name__
        raise InputError(f"model: {path / RUN_FILE} has format {given!r}; this version reads {FORMAT}")
    if found.get("descriptor_version") != DESCRIPTOR_VERSION:
        raise InputError(
            f"model: {path} was trained on descriptor version {found.get('descriptor_version')!r}; "
            f"this version computes {DESCRIPTOR_VERSION}; train it again"
        )
    if found.get("digest") != json_digest(found):
        raise InputError(f"model: {path / RUN_FILE} is damaged, or was changed after the training")
    return found


def _config(constants: Mapping[str, Any]) -> DescriptorConfig:
    relaxation = constants["relaxation"]
    return DescriptorConfig(**{**constants, "relaxation": None if relaxation is None else Relaxation(**relaxation)})


def load_run(path: str | Path) -> TrainedRun:
    """Read a run folder.

    Raises:
        InputError: no run folder, a damaged file, another format or descriptor version, or parts that do not belong
            together; one line that names the file and what is wrong.
    """
    path = Path(path).absolute()
    found = _description(path)
    where = f"model: {path / RUN_FILE}"
    try:
        config = _config(found["descriptor_config"])
        classes = tuple(found["classes"])
        names = check_features(found["classifiers"], "classifiers")
        fingerprint, record = found["color_network"], found["record"]
        digests = {name: found["weights"][name] for name in names}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: {type(error).__name__}: {error}") from None
    if not isinstance(found["classes"], list) or not classes or not all(isinstance(name, str) for name in classes):
        raise InputError(f"{where}: classes is {found['classes']!r}; expected a list of names")
    try:
        network = colornet.load(path / "network.npz")
    except (OSError, ValueError) as error:
        raise InputError(f"model: {path / 'network.npz'} cannot be read: {error}") from None
    if network.fingerprint != fingerprint:
        raise InputError(f"model: {path / 'network.npz'} is another colour network than run.json names")
    classifiers = {}
    for name in names:
        n_inputs = input_size(name, config, network.n_regions)
        classifiers[name] = _restore(path / "weights" / name, n_inputs, len(classes), digests[name])
    return TrainedRun(config, network, classes, classifiers, record)


def _restore(path: Path, n_inputs: int, n_classes: int, digest: str) -> MLP:
    if not path.is_dir():
        raise InputError(f"model: {path} is missing")
    if digest != _digest(path, n_inputs, n_classes):
        raise InputError(f"model: {path} is damaged, or not of {n_inputs} inputs and {n_classes} classes")
    return _restore_weights(path, n_inputs, n_classes)


def _restore_weights(path: Path, n_inputs: int, n_classes: int) -> MLP:
    try:
        with _checkpointer() as checkpointer:
            model = MLP(n_inputs, n_classes, rngs=nnx.Rngs(0))
            state = nnx.state(model, (nnx.Param, nnx.BatchStat))
            restored = checkpointer.restore(path, jax.tree.map(np.asarray, nnx.to_pure_dict(state)))
    except Exception as error:  # orbax raises whatever its storage layers raise
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(f"model: {path} cannot be read: {reason[0][:300]}") from None
    nnx.replace_by_pure_dict(state, jax.tree.map(jnp.asarray, restored))
    nnx.update(model, state)
    return model
