"""Run directories: a trained model on disk with everything that recognition needs.

    RUN/run.json                  format, descriptor version and constants, class names, classifiers and SHA-256 of
                                  their weights, and a record of the training
    RUN/network.npz               the colour network whose regions the descriptors use
    RUN/weights/NAME.safetensors  parameters and batch statistics of one classifier
    RUN/embedding.safetensors     the embedding of the gallery, in place of the packaged one, which may also recognize
                                  the classes
    RUN/references.safetensors    its reference views, with which galleries reject unknown objects
    RUN/surfaces.safetensors      surfaces of the classes, if all were trained from meshes, see `surfaces`

These files are the model: none of them may be deleted or edited. `thor2 train` adds files that recognition does not
read, and each of them may be deleted: `baselines/` (models that `thor2 evaluate` compares with), `metrics.jsonl` and
`curves.png` (loss and accuracy of each epoch; for an embedding, each distractor is a class, too) and, while a training
is unfinished, `checkpoints/` and `views/`, from which an interrupted training resumes. `gallery/` has enrolled objects
(see `gallery.store`). A run whose embedding recognizes the classes may have no classifiers; a run that `thor2 enroll`
created has neither classes nor classifiers. With several folds, each of `fold-0/`, `fold-1/`, ... is a run directory.

A run directory appears under its name only when it is complete, and all files are checked when it is loaded. Two
equal trainings (see `training.fitting.fit`) write the same bytes to these files.
"""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flax import nnx

import colornet
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.errors import InputError, decoding
from thor2_jax.files import (
    as_path,
    atomic_directory,
    check_output_directory,
    content_digest,
    pack_arrays,
    read_file,
    unpack_arrays,
)
from thor2_jax.model.run_record import FORMAT_WITH_SURFACES, RUN_FILE, RUN_FORMAT, read_description
from thor2_jax.networks.embedding import REFERENCES_FILE, Embedding
from thor2_jax.networks.networks import (
    MLP,
    Classifier,
    Feature,
    check_features,
    input_size,
    model_arrays,
    model_from_arrays,
)
from thor2_jax.surfaces.surfaces import SURFACES_FILE, Surfaces

__all__ = ["EMBEDDING_FILE", "TrainedRun", "load_run", "save_run", "weights_file"]

EMBEDDING_FILE = "embedding.safetensors"
"""File of a run's embedding, which replaces the packaged one."""

EXPECTED_FILE = "the file of this run; copy the whole run directory"
"""What messages about damaged files expect."""


@dataclasses.dataclass(frozen=True)
class TrainedRun:
    """The content of a run directory.

    Attributes:
        config: constants of the descriptor.
        network: the colour network.
        classes: class names, in the order of a classifier's outputs; none in a run of enrolled objects only.
        classifiers: feature -> trained MLP.
        record: record of the training (options, counts, metrics) as JSON values.
        embedding: embedding of the run, which may recognize its classes, too; None for the packaged one.
        surfaces: surfaces of the classes, with which instances are compared; None if a class has no mesh.
    """

    config: DescriptorConfig
    network: colornet.ColorNetwork
    classes: tuple[str, ...]
    classifiers: Mapping[Feature, MLP]
    record: Mapping[str, Any]
    embedding: Embedding | None = None
    surfaces: Surfaces | None = None

    @property
    def embedding_classifier(self) -> Classifier | None:
        """`class_probabilities` of the embedding; None if it does not recognize exactly the classes of the run."""
        if self.embedding is None or not self.classes or self.embedding.classes != self.classes:
            return None
        return self.embedding.class_probabilities

    def without_callback(self) -> "TrainedRun":
        """Return this run with diagrams in closed form: the same pairs as gudhi's, without a host callback."""
        return dataclasses.replace(self, config=dataclasses.replace(self.config, homology="closed_form"))


def save_run(run: TrainedRun, path: str | Path) -> None:
    """Write a run directory. It appears under its name only when it is complete.

    Raises:
        InputError: the path exists and is not an empty directory.
        OSError: the directory cannot be written; nothing is left behind.
    """
    path = as_path(path, "out").resolve()
    check_output_directory(path)
    with atomic_directory(path) as unfinished:
        colornet.save(run.network, unfinished / "network.npz")
        (unfinished / "weights").mkdir()
        if run.embedding is not None:
            run.embedding.save(unfinished / EMBEDDING_FILE)
        if run.surfaces is not None:
            (unfinished / SURFACES_FILE).write_bytes(run.surfaces.content)
        contents = {name: pack_arrays(model_arrays(model)) for name, model in run.classifiers.items()}
        for name, content in contents.items():
            weights_file(unfinished, name).write_bytes(content)
        embedding, references = run.embedding, unfinished / REFERENCES_FILE
        description = {
            "format": RUN_FORMAT if run.surfaces is None else FORMAT_WITH_SURFACES,
            "descriptor_version": DESCRIPTOR_VERSION,
            "descriptor_config": dataclasses.asdict(run.config),
            "color_network": run.network.fingerprint,
            "classes": list(run.classes),
            "classifiers": list(run.classifiers),
            "weights": {name: content_digest([content]) for name, content in contents.items()},
            **({} if embedding is None else {"embedding": embedding.fingerprint}),
            **({"references": content_digest([references.read_bytes()])} if references.exists() else {}),
            **({} if run.surfaces is None else {"surfaces": content_digest([run.surfaces.content])}),
            "record": run.record,
        }
        (unfinished / RUN_FILE).write_text(json.dumps(description, indent=2) + "\n")


def load_run(path: str | Path) -> TrainedRun:
    """Read a run directory.

    Raises:
        InputError: the path is not a run directory, a file is damaged, the format or the descriptor version is not
            supported, or the files do not belong together. The message names the file.
    """
    path = as_path(path, "model").absolute()
    description = read_description(path)
    try:
        config = DescriptorConfig.of_record(description["descriptor_config"])
        classes, record = description["classes"], dict(description["record"])
        # A run with enrolled objects only has no classifiers.
        names = check_features(description["classifiers"]) if description["classifiers"] else ()
        fingerprint = description["color_network"]
        digests = {name: description["weights"][name] for name in names}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"model: {path / RUN_FILE}: {type(error).__name__}: {error}") from None
    if names and not classes:
        raise InputError(f"model: {path / RUN_FILE}: classes is {classes!r}; expected a list of names")
    with decoding(f"model: {path / 'network.npz'} cannot be read", EXPECTED_FILE):
        network = colornet.load(path / "network.npz")
    if network.fingerprint != fingerprint:
        raise InputError(f"model: {path / 'network.npz'} is not the colour network that run.json names")
    classifiers = {}
    for name in names:
        sizes = input_size(name, config, network.n_regions), len(classes)
        classifiers[name] = _load_classifier(weights_file(path, name), *sizes, digests[name])
    file = path / EMBEDDING_FILE
    embedding = Embedding.load(file, network) if file.is_file() else None
    actual = None if embedding is None else embedding.fingerprint
    if description.get("embedding", actual) != actual:
        raise _unfit(file, "is missing" if embedding is None else "is not the embedding that run.json names")
    if digest := description.get("references"):
        _intact(path / REFERENCES_FILE, digest)
    surfaces = None
    if description["format"] == FORMAT_WITH_SURFACES:
        surfaces = Surfaces.of_content(_intact(path / SURFACES_FILE, description.get("surfaces", "")))
        if (count := len(surfaces.table)) != len(classes):
            raise _unfit(path / SURFACES_FILE, f"has surfaces of {count} classes; expected {len(classes)}")
    run = TrainedRun(config, network, tuple(classes), classifiers, record, embedding, surfaces)
    if classes and not classifiers and run.embedding_classifier is None:
        raise _unfit(file, "is missing" if embedding is None else "does not recognize the classes of run.json")
    return run


def _unfit(path: Path, state: str) -> InputError:
    """Return the error of a file that does not fit the rest of its run directory."""
    return InputError(f"model: {path} {state}; copy the whole run directory")


def weights_file(run: Path, name: str) -> Path:
    """Return the path of a classifier's weights in a run directory."""
    return run / "weights" / f"{name}.safetensors"


def _intact(path: Path, digest: str | bool) -> bytes:
    """Return the content of a file; raise InputError if it is missing or its SHA-256 is not `digest`.

    Runs of earlier versions have True in place of the digest of references.
    """
    try:
        content = read_file(path)
    except FileNotFoundError:
        raise _unfit(path, "is missing") from None
    except OSError as error:
        raise InputError(f"model: {path} cannot be read ({error.strerror})") from None
    if digest is not True and content_digest([content]) != digest:
        raise _unfit(path, f"is damaged: its SHA-256 is not the one in {RUN_FILE}")
    return content


def _load_classifier(path: Path, n_inputs: int, n_classes: int, digest: str) -> MLP:
    content = _intact(path, digest)
    with decoding(f"model: {path} does not fit the classifier", EXPECTED_FILE):
        return model_from_arrays(lambda: MLP(n_inputs, n_classes, rngs=nnx.Rngs(0)), unpack_arrays(content)[0])
