"""Image networks and templates: fitting on crops, resuming, pretrained weights, and bad input."""

from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from flax import nnx
from refusals import assert_refused
from safetensors.numpy import load_file, save_file
from slow_tier import slow
from small_clouds import random_clouds
from small_runs import save_trained_run

import thor2_jax as thor2
from thor2_jax.model.run_directory import load_run
from training.baselines import baseline as module
from training.baselines.baseline import BaselineInputs, StoredBaseline, baseline_file
from training.baselines.image_baselines import ARCHITECTURES, check_backbone, compare, network_inputs, tensors
from training.baselines.job import crop_size, load_baselines, pretrained_files, train_baselines
from training.protocol import DEFAULT
from training.train_job import TrainJob, run_train_job
from training.views.crops import ViewCrops
from training.views.normalized_views import MemoryViews

pytestmark = pytest.mark.usefixtures("small_classifiers", "small_transformers")

CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=1, image_size=8)
NAMES = ("red", "blue")
SMALL = "rgbd-vit-small"


def crops_of(label: int, count: int, size: int, seed: int = 0) -> ViewCrops:
    """Return crops of a red or a blue disc that looks at the camera."""
    rng = np.random.default_rng((seed, label))
    rows, columns = np.indices((size, size)) - size / 2
    disc = np.hypot(rows, columns)[None] < rng.uniform(0.3, 0.5, (count, 1, 1)) * size
    color = np.where(disc[..., None], np.array([[200, 30, 30], [30, 30, 200]][label]), 0).astype(np.uint8)
    return ViewCrops(color, np.where(disc[..., None], np.array([0, 0, -127]), 0).astype(np.int8))


class Views(MemoryViews):
    """Views in memory with crops."""

    def read_crops(self, index: int, size: int) -> ViewCrops:
        return crops_of(index, self.shards[index].views, size)


CLOUDS = random_clouds(0, [40] * 20)
SOURCE = Views(dict.fromkeys(NAMES, CLOUDS), CONFIG)


def write_run(folder: Path, folds: int = 4, epochs: int = 3) -> Path:
    return save_trained_run(folder, SOURCE, CONFIG, epochs=epochs, folds=folds, fold=0)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_run(tmp_path_factory.mktemp("networks") / "run")
    train_baselines(folder, SOURCE, [SMALL])
    return folder


@pytest.mark.parametrize("name", [SMALL, *slow("templates", "rcfusion-small", "vit-cnn-small")])
def test_image_baselines_learn(trained: Path, tmp_path: Path, name: str) -> None:
    """The inputs are a red and a blue instance, and padding; the templates need the backbone of the small network."""
    folder = trained if name in (SMALL, "templates") else write_run(tmp_path / "run", epochs=12)
    train_baselines(folder, SOURCE, [name])
    loaded = load_baselines(folder, load_run(folder))[name]

    def crops(size: int) -> ViewCrops:
        both = [crops_of(label, 1, size, seed=5) for label in (0, 1)]
        return ViewCrops(np.concatenate([c.color for c in both]), np.concatenate([c.normals for c in both]))

    inputs = BaselineInputs(thor2.PointClouds.pack(CLOUDS[:1] * 4), np.zeros((4, 1), np.float32), crops)
    probabilities = loaded.predict(inputs)
    np.testing.assert_allclose(probabilities.sum(axis=1), 1, atol=1e-5)
    assert probabilities[:2].argmax(axis=1).tolist() == [0, 1] and (probabilities[2:] == 0.5).all()
    assert loaded.weights == {} and loaded.temperature is not None and loaded.temperature > 0


def test_an_interrupted_fit_resumes(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_run(tmp_path / "run")
    step = mock.Mock(wraps=module._step, side_effect=[mock.DEFAULT, KeyboardInterrupt, mock.DEFAULT, mock.DEFAULT])
    monkeypatch.setattr(module, "_step", step)
    with pytest.raises(KeyboardInterrupt):
        train_baselines(folder, SOURCE, [SMALL])
    assert not list((folder / "baselines").glob("*.safetensors"))
    train_baselines(folder, SOURCE, [SMALL])
    assert step.call_count == 4  # one step in each of three epochs, one of them interrupted
    resumed, expected = (load_file(run / "baselines" / f"{SMALL}.safetensors") for run in (folder, trained))
    for path in expected:
        np.testing.assert_allclose(resumed[path], expected[path], rtol=1e-5, atol=1e-6)


def write_weights(folder: Path, seed: int = 0) -> Path:
    """Write the files of weights that the small RGB-D ViT reads, with random values."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(seed)
    model: Any = nnx.eval_shape(lambda: ARCHITECTURES[SMALL].build(2, 0))
    for backbone, file in ARCHITECTURES[SMALL].weights.items():
        shapes = {name: shape for name, shape, *_ in tensors(getattr(model, backbone))}
        values = {k: (0.05 * rng.standard_normal(s)).astype(np.float32) for k, s in shapes.items()}
        save_file(values, folder / f"{file}.safetensors")
    return folder


def test_pretrained_weights_are_used_and_recorded(tmp_path: Path) -> None:
    """Also after a training with others that could not be written."""
    weights, (file,) = tmp_path / "weights", pretrained_files(SMALL)
    folder = write_run(tmp_path / "run", folds=1, epochs=1)
    with mock.patch.object(StoredBaseline, "write", side_effect=OSError), pytest.raises(OSError):
        train_baselines(folder, SOURCE, [SMALL], weights=write_weights(weights, seed=2))
    train_baselines(folder, SOURCE, [SMALL], weights=write_weights(weights))
    stored = StoredBaseline.read(folder / "baselines" / f"{SMALL}.safetensors", NAMES)
    assert list(stored.weights) == [f"{file}.safetensors"] and stored.temperature is None
    given = load_file(weights / f"{file}.safetensors")["blocks.0.mlp.fc1.weight"].T
    moved = stored.arrays["color/blocks/0/mlp/fc1/kernel"] - given
    assert 0 < np.abs(moved).max() < 1e-3  # a step of the small learning rate away
    train_baselines(folder, SOURCE, [SMALL], weights=weights)
    write_weights(weights, seed=1)
    message = "^weights is .*was trained without these files"
    assert_refused(message, train_baselines, folder, SOURCE, [SMALL], weights=weights)


def test_weights_of_another_architecture_are_refused(tmp_path: Path) -> None:
    """By the name and the shape of the tensor, in one line, and nothing is left."""
    weights, folder = write_weights(tmp_path / "weights"), write_run(tmp_path / "run")
    path = weights / f"{pretrained_files(SMALL)[0]}.safetensors"
    tensors, qkv = load_file(path), "blocks.0.attn.qkv.weight"
    wide, long = np.zeros(384, np.float32), np.zeros((1, 38, 192), np.float32)
    for damage, message in (
        (lambda: save_file(tensors | {"norm.weight": wide}, path), r"norm\.weight in .* the shape \(384,\).*\(96,\)"),
        (lambda: save_file({k: a for k, a in tensors.items() if k != qkv}, path), f"no tensor {qkv}"),
        (lambda: save_file(tensors | {"pos_embed": long}, path), r"pos_embed .* \(1, 38, 192\)"),
        (lambda: path.write_bytes(b"no tensors"), "cannot be read"),
        (path.unlink, "does not exist"),
    ):
        damage()
        assert_refused(f"^weights: .*{message}", train_baselines, folder, SOURCE, [SMALL], weights=weights)
    assert not (folder / "baselines").exists()


def test_finished_templates_need_no_backbone(tmp_path: Path) -> None:
    """Without one, they are refused before and in the training; networks are refused without crops."""
    message = "^baselines: templates needs a backbone"
    assert_refused(message, check_backbone, ["templates"], tmp_path)
    run, without_crops = write_run(tmp_path / "run"), MemoryViews(dict.fromkeys(NAMES, CLOUDS), CONFIG)
    assert_refused(message, train_baselines, run, SOURCE, ["templates"])
    assert_refused("no crops", train_baselines, run, without_crops, [SMALL])
    check_backbone([SMALL, "templates"], tmp_path)
    for name in (SMALL, "templates"):
        file = baseline_file(tmp_path / name / "fold-0", name)
        file.parent.mkdir(parents=True)
        file.touch()
        check_backbone(["templates"], tmp_path / name)


def test_command_checks_weights_before_any_work(tmp_path: Path) -> None:
    save_file({"conv1.weight": np.zeros((64, 3, 3, 3), np.float32)}, tmp_path / "vit_small_patch14_dinov2.safetensors")
    for names, message in (
        (["forest"], "none of the baselines"),
        (["rcfusion"], "resnet18.safetensors does not exist"),
        (["templates"], r"vit_small_patch14_dinov2\.safetensors has no tensor"),
    ):
        job = TrainJob(tmp_path / "run", DEFAULT, dataset=tmp_path, weights=tmp_path, baselines=names)
        assert_refused(f"^weights.*{message}", run_train_job, job, lambda *_: pytest.fail("work began"))
    assert not (tmp_path / "run").exists()


def test_nearest_template_has_the_largest_cosine() -> None:
    """Against the formula, with two classes and features by hand."""
    features = np.array([[1, 0], [0, 1], [0.6, 0.8]], np.float16)
    similarity = np.array([[0.8, 0.96], [-1.0, -0.6]])
    expected = np.exp(20 * similarity) / np.exp(20 * similarity).sum(axis=1, keepdims=True)
    queries, label = np.array([[0.8, 0.6], [-1, 0]], np.float32), np.array([0, 1, 1], np.int16)
    np.testing.assert_allclose(compare(queries, features, label, 2), expected, atol=1e-3)


def test_inputs_are_scaled_and_the_background_is_zero() -> None:
    crops = crops_of(0, 2, 12)
    color, normals = (np.asarray(values) for values in network_inputs(crops.color, crops.normals))
    mask = crops.normals.any(axis=-1)
    assert not color[~mask].any() and not normals[~mask].any()
    for values, pixel in ((color, np.array([200, 30, 30]) / 255), (normals, np.array([0.5, 0.5, 0]))):
        expected = (pixel - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
        np.testing.assert_allclose(values[mask], np.tile(expected, (mask.sum(), 1)), atol=1e-5)


def test_crop_size_is_that_of_the_largest_reader() -> None:
    assert crop_size(["forest", "thor"], True) is None
    assert crop_size([SMALL, "templates"], False) == 32 and crop_size(["templates"], True) == 224
    assert crop_size([SMALL, "rcfusion"], False) == 224
