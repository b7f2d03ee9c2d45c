"""Run directories: a saved run is loaded unchanged, and a damaged one is refused in one line."""

import dataclasses
import functools
import gc
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import assert_refused
from small_runs import class_probabilities, untrained_embedding_run, with_surfaces
from written_files import files_of

import colornet
import thor2_jax as thor2
from thor2_jax.descriptor.looks import LookDescriptors
from thor2_jax.model.run_directory import EMBEDDING_FILE, TrainedRun, load_run, save_run, weights_file
from thor2_jax.networks.embedding import BACKGROUND, REFERENCES_FILE, References
from thor2_jax.recognizer import Recognizer
from thor2_jax.surfaces.surfaces import SURFACES_FILE

CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=2, n_strips=5, image_size=8, alpha=0.5)
CONSTANTS = dataclasses.asdict(CONFIG)


@functools.cache
def make_run() -> TrainedRun:
    """Return a run with all files: those of classifiers, an embedding, its references, and surfaces."""
    run = untrained_embedding_run(("a mug", "b", "ç"), ("tops", "ce"), CONFIG, {"epochs": 3, "figures": [0.5, 1]})
    views = References(np.zeros((1, run.embedding.size), np.float16), np.full(1, BACKGROUND, np.int32))
    return with_surfaces(dataclasses.replace(run, embedding=dataclasses.replace(run.embedding, references=views)))


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "deep" / "run"
    save_run(make_run(), path)
    return path


def test_saving_and_loading_round_trips(saved: Path) -> None:
    run, loaded = make_run(), load_run(saved)
    assert (loaded.config, loaded.classes, loaded.record) == (run.config, run.classes, run.record)
    assert loaded.network.fingerprint == run.network.fingerprint
    assert tuple(loaded.classifiers) == ("ce", "tops") and loaded.embedding_classifier is not None
    assert loaded.embedding.fingerprint == run.embedding.fingerprint
    jax.tree.map(np.testing.assert_array_equal, loaded.surfaces, run.surfaces)
    rng = np.random.default_rng(0)
    images, color = rng.random((1, 1, 2, 8, 8), np.float32), rng.random((1, 1, 2, 22, 5), np.float32)
    descriptors = thor2.Descriptors(jnp.asarray(images), jnp.asarray(color), jnp.zeros((1, 1), jnp.int32))
    oriented = LookDescriptors(descriptors, jnp.zeros((1, 1, 34)))
    before, after = (class_probabilities(each, oriented) for each in (Recognizer(run), Recognizer.load(saved)))
    for name in run.classifiers:
        assert before[name].shape == (1, 3)
        np.testing.assert_array_equal(before[name], after[name])


def test_a_run_directory_has_its_files_and_is_readable(saved: Path, tmp_path: Path) -> None:
    """A second one, in place of an empty directory, has equal bytes."""
    (tmp_path / "run").mkdir()
    save_run(make_run(), tmp_path / "run")
    assert files_of(tmp_path) == {f"run/{name}": content for name, content in files_of(saved).items()}
    stems = ("embedding", "references", "surfaces", "weights/ce", "weights/tops")
    assert set(files_of(saved)) == {"network.npz", "run.json", *(f"{stem}.safetensors" for stem in stems)}
    assert sorted(p.name for p in saved.parent.iterdir()) == ["run"]
    assert saved.stat().st_mode & 0o777 == 0o755
    description = json.loads((saved / "run.json").read_text())
    assert description["descriptor_version"] == thor2.DESCRIPTOR_VERSION
    assert description["descriptor_config"] == dataclasses.asdict(CONFIG)


def test_an_existing_path_is_refused(saved: Path, tmp_path: Path) -> None:
    before = (saved / "run.json").read_bytes()
    (tmp_path / "file").write_text("x")
    for existing in (saved, tmp_path / "file"):
        assert_refused(f"out: {existing} ", save_run, make_run(), existing)
    assert (saved / "run.json").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def edited(**changes: Any) -> Callable[[Path], None]:
    def edit(path: Path) -> None:
        description = json.loads((path / "run.json").read_text())
        (path / "run.json").write_text(json.dumps(description | changes))

    return edit


def flip_a_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)


def directory_as_weights(path: Path) -> None:
    weights_file(path, "tops").unlink()
    weights_file(path, "tops").mkdir()


def other_network(path: Path) -> None:
    network = colornet.load_default()
    dataclasses.replace(network, mean_rgb=network.mean_rgb + 1).save(path / "network.npz")


def other_embedding(path: Path) -> None:
    dataclasses.replace(make_run().embedding, further=()).save(path / EMBEDDING_FILE)


DAMAGES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "folds": (lambda path: shutil.copytree(path, path / "fold-0") and (path / "run.json").unlink(), "run/fold-0"),
    "cut run.json": (lambda path: (path / "run.json").write_text('{"format": 1,'), "run.json cannot be read"),
    "a directory": (lambda path: (path / "run.json").unlink() or (path / "run.json").mkdir(), "cannot be read: Is a"),
    "a list": (lambda path: (path / "run.json").write_text("[1]"), "run.json has format 'list'"),
    "other format": (edited(format=4), "run.json has format 4"),
    "other version": (edited(descriptor_version=99), "descriptor version 99"),
    "no record": (edited(record=[1]), "run.json: TypeError"),
    "empty classes": (edited(classes=[]), "classes is []"),
    "one string": (edited(classes="abc"), "classes is 'abc'"),
    "unknown classifier": (edited(classifiers=["shape"]), "classifiers is ['shape']"),
    "missing classifier": (edited(classifiers=["ce", "tops", "tops2"]), "run.json: KeyError: 'tops2'"),
    "bad constant": (edited(descriptor_config={**CONSTANTS, "sigma_s": -1}), "DescriptorConfig.sigma_s is -1"),
    "other constant": (edited(descriptor_config={**CONSTANTS, "n_slices": 3}), "weights/ce.safetensors does not fit"),
    "no network": (lambda path: (path / "network.npz").unlink(), "network.npz cannot be read"),
    "other network": (other_network, "network.npz is not the colour network"),
    "flipped bit": (lambda path: flip_a_bit(weights_file(path, "ce")), "weights/ce.safetensors is damaged"),
    "flipped reference": (lambda path: flip_a_bit(path / REFERENCES_FILE), "references.safetensors is damaged: its"),
    "other embedding": (other_embedding, "embedding.safetensors is not the embedding"),
    "no embedding": (lambda path: (path / EMBEDDING_FILE).unlink(), "embedding.safetensors is missing"),
    "no references": (lambda path: (path / REFERENCES_FILE).unlink(), "references.safetensors is missing; copy"),
    "other surfaces": (lambda path: (path / SURFACES_FILE).write_bytes(b"0"), "surfaces.safetensors is damaged: its"),
    "a directory as weights": (directory_as_weights, "weights/tops.safetensors cannot be read (Is a directory)"),
    "no weights": (lambda path: weights_file(path, "tops").unlink(), "weights/tops.safetensors is missing"),
}


def test_references_of_earlier_versions_have_no_digest(saved: Path, tmp_path: Path) -> None:
    edited(references=True)(shutil.copytree(saved, tmp_path / "run"))
    assert load_run(tmp_path / "run").embedding.references is not None


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_run_directory_is_refused_in_one_line(name: str, saved: Path, tmp_path: Path) -> None:
    """A failed read leaves no open file, which would warn at garbage collection; warnings are errors here."""
    damage, expected = DAMAGES[name]
    damage(shutil.copytree(saved, tmp_path / "run"))
    with pytest.raises(thor2.InputError) as caught:
        load_run(tmp_path / "run")
    gc.collect(0)
    message = str(caught.value)
    assert message.startswith("model: ") and expected in message and "\n" not in message and len(message) < 700


def test_a_run_without_classifiers_needs_its_embedding(tmp_path: Path) -> None:
    run = untrained_embedding_run(("a", "b"))
    save_run(run, tmp_path / "run")
    loaded = load_run(tmp_path / "run")
    assert loaded.classes == ("a", "b") and not loaded.classifiers and loaded.embedding_classifier is not None
    save_run(dataclasses.replace(run, classes=("b", "a")), tmp_path / "renamed")
    expected = r"^model: .*embedding\.safetensors does not recognize the classes [^\n]*$"
    assert_refused(expected, load_run, tmp_path / "renamed")


def test_every_class_has_a_surface(tmp_path: Path) -> None:
    run = make_run()
    few = dataclasses.replace(run, surfaces=jax.tree.map(lambda field: field[:1], run.surfaces))
    save_run(few, tmp_path / "few")
    expected = rf"^model: .*{SURFACES_FILE} has surfaces of 1 classes; expected 3; copy [^\n]*$"
    assert_refused(expected, load_run, tmp_path / "few")
