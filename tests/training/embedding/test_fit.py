"""Fitting of embeddings: samples, orientations, resumption, determinism, and what a short fit achieves."""

import dataclasses
import functools
import runpy
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np
import pytest
from failures import Interrupted
from flax import nnx
from refusals import assert_refused
from small_clouds import NETWORK
from small_runs import SMALL_CONFIG
from written_files import files_of_the_user

import thor2_jax as thor2
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.looks import N_SCALARS, describe_aligned_looks, is_color
from thor2_jax.networks.embedding import REFERENCES_FILE, Embedding
from thor2_jax.networks.networks import EmbeddingSizes, model_arrays
from training.embedding import build, fit
from training.embedding import distractors as module
from training.embedding.build import build_embedding
from training.embedding.distractors import render_clouds, sample_objects
from training.embedding.fit import fit_embedding
from training.fitting.fit import network_step
from training.fitting.loop import Checkpoints
from training.fitting.samples import Samples, describe_batch
from training.storage.jobs import save_arrays
from training.views import normalized_views

SIZES = EmbeddingSizes(cell=6, hidden=(32,), learned=16, color=10)
OBJECTS = range(2, 26, 3)  # all of their views have enough points
CLASSES = ("a", "b")
EPOCHS = 12

learned_block = nnx.jit(lambda model, *inputs: model.learned(*inputs))


@pytest.fixture(scope="module", autouse=True)
def small_batches(module_patch: pytest.MonkeyPatch) -> None:
    module_patch.setattr(fit, "BATCH_SIZE", 32)
    module_patch.setattr(fit, "RATE", 5e-3)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Samples:
    return sample_objects(OBJECTS, NETWORK, SMALL_CONFIG, views=6, directory=tmp_path_factory.mktemp("samples"))


def test_views_depend_on_their_object_only() -> None:
    """Most views are augmented."""
    with mock.patch.object(module, "augment", wraps=module.augment) as augmented:
        one = render_clouds({3: 15, 4: 20}, 2)
    assert [index for index, _ in one] == [3, 3, 4, 4] and augmented.call_count > 2
    np.testing.assert_equal(render_clouds({4: 20}, 2), one[2:])


def test_unturned_samples_have_the_descriptor_of_their_cloud(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(normalized_views, "_random_axes", lambda *_: np.tile(np.eye(3, dtype=np.float32), (64, 1, 1)))
    rendered = render_clouds({0: 0, 1: 10}, 3)
    order = np.argsort([len(cloud[0]) for _, cloud in rendered], kind="stable")
    samples = sample_objects([0, 10], NETWORK, SMALL_CONFIG, 3, directory=tmp_path)
    rows = np.array([5, 0, 5, 1, 2])
    batch = samples.take(rows, NETWORK, SMALL_CONFIG)
    embedding = Embedding.create(SMALL_CONFIG, sizes=SIZES)
    normal = thor2.view_normalize(thor2.PointClouds.pack([rendered[k][1] for k in order[rows]]), SMALL_CONFIG)
    descriptors = describe_batch(batch, NETWORK, embedding.config)
    actual = nnx.jit(nnx.merge(*embedding._embedder))(descriptors, batch.statistics)
    similarity = []
    for mirror in ("", "x"):
        aligned = thor2.turn(thor2.mirror(normal, mirror), SMALL_CONFIG)
        described = strips(aligned, NETWORK, embedding.config)
        oriented = describe_aligned_looks(aligned, described, NETWORK, embedding.config, 1)
        similarity.append((actual * embedding.embed_oriented(oriented, aligned)[:, 0]).sum(axis=1))
    np.testing.assert_allclose(np.max(similarity, axis=0), 1, atol=1e-3)


def test_samples_depend_on_neither_workers_nor_interruptions(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(module, "OBJECTS_PER_TASK", 3)
    rendered: list[int] = []
    done: list[Any] = []
    sample = functools.partial(sample_objects, OBJECTS, NETWORK, SMALL_CONFIG, 2, progress=lambda *n: done.append(n))
    whole = sample(directory=tmp_path / "whole")
    assert done == [(0, 8), (3, 8), (6, 8), (8, 8)]

    def stopped(function: Callable[[Any], Any], tasks: Iterable[Any]) -> Iterator[Any]:
        for task in tasks:
            if rendered == [0, 3]:
                raise Interrupted
            rendered.append(min(task))
            yield function(task)

    with pytest.raises(Interrupted):
        sample(pool=stopped, directory=tmp_path / "samples")
    damaged = tmp_path / "samples" / "000000.safetensors"
    content = damaged.read_bytes()
    save_arrays(tmp_path / "incomplete", {"label": whole.label}, {})
    last, incomplete = bytes([content[-1] ^ 1]), (tmp_path / "incomplete").read_bytes()
    for bad, expected in ((content[:-1], [0, 6]), (content[:-1] + last, [0]), (incomplete, [0]), (content, [])):
        damaged.write_bytes(bad)
        rendered.clear()
        np.testing.assert_equal(sample(pool=stopped, directory=tmp_path / "samples").arrays(), whole.arrays())
        assert rendered == expected and damaged.read_bytes() == content
    assert done[7:10] == [(3, 8), (6, 8), (8, 8)]


@pytest.fixture(scope="module")
def fitted(views: Samples, tmp_path_factory: pytest.TempPathFactory) -> tuple[Embedding, list[Any]]:
    """A fit of one network, and its progress."""
    losses: list[Any] = []
    show = lambda *numbers: losses.append(numbers)  # noqa: E731
    checkpoints = Checkpoints(tmp_path_factory.mktemp("fit"))
    return fit_embedding(views, NETWORK, SMALL_CONFIG, EPOCHS, checkpoints, SIZES, show, CLASSES), losses


def test_views_of_one_object_become_more_similar(views: Samples, fitted: tuple[Embedding, list[Any]]) -> None:
    embedding, losses = fitted
    assert losses[11][:2] == (36, 36) and losses[11][2].loss < 0.5 * losses[0][2].loss
    batch = views.take(np.arange(len(views)), NETWORK, SMALL_CONFIG)
    descriptors = describe_batch(batch, NETWORK, embedding.config)
    same = batch.label[:, None] == batch.label
    gaps = []
    for one in (Embedding.create(SMALL_CONFIG, sizes=SIZES), embedding):
        learned = np.asarray(learned_block(one.model, descriptors, batch.statistics))
        similarity = learned @ learned.T
        gaps.append(similarity[same].mean() - similarity[~same].mean())
    assert gaps[1] > 1.5 * gaps[0] and len(embedding.references.label) == len(views)  # each view once
    drop_out = nnx.jit(lambda key, model, *inputs: model.learned(*inputs, train=True, rngs=nnx.Rngs(dropout=key)))
    inputs = descriptors, batch.statistics
    drawn = [drop_out(jax.random.key(seed), nnx.clone(embedding.model), *inputs) for seed in (0, 0, 1)]
    assert np.array_equal(*drawn[:2]) and np.abs(drawn[2] - drawn[1]).max() > 0.01
    basis = np.asarray(embedding.model.color_basis[...])
    np.testing.assert_allclose(basis.T @ basis, np.eye(10), atol=1e-3)


def test_further_networks_keep_the_first(views: Samples, fitted: tuple[Embedding, list[Any]], tmp_path: Path) -> None:
    """Each step has other samples, .12 is subtracted from the cosine of a label, and the second reads no colours."""

    def with_margin(graph: Any, state: Any, optimizer: Any, label: Any, outputs_of: Callable[[Any], Any]) -> Any:
        logits, cosines = outputs_of(nnx.merge(graph, state.params, state.rest, copy=True))
        error = cosines - logits / jax.numpy.exp(state.params["log_scale"][...]) - 0.12 * jax.nn.one_hot(label, 8)
        after, (_, accuracy) = network_step(graph, state, optimizer, label, outputs_of)
        return after, (abs(error).max(), accuracy)

    progress = list[Any]()
    show = lambda *numbers: progress.append(numbers)  # noqa: E731
    fit_two = functools.partial(fit_embedding, views, NETWORK, SMALL_CONFIG, EPOCHS, Checkpoints(tmp_path), SIZES, show)
    programs = fit._step._cache_size()
    with mock.patch.multiple(fit, _step=mock.Mock(wraps=fit._step), network_step=with_margin):
        two = fit_two(CLASSES, networks=2)
        assert fit._step._cache_size() == programs + 1  # all steps share one
        calls = [call.args for call in fit._step.call_args_list]
        assert len({args[5].length.tobytes() for args in calls}) == 36
        assert len({str(key) for args in calls for key in jax.random.key_data(args[7]).tolist()}) == 72
    assert [numbers[:2] for numbers in progress] == [(3 * epoch, 36) for epoch in range(1, 13)]
    assert max(metrics.loss for *_, metrics in progress) < 1e-5
    assert dataclasses.replace(two, further=()).fingerprint == fitted[0].fingerprint
    np.testing.assert_equal(model_arrays(two.model), model_arrays(fitted[0].model))
    assert np.abs(two.further[0].proxies[...] - two.model.proxies[...]).max() > 0.1
    colors = np.flatnonzero(is_color(NETWORK.n_regions)) - N_SCALARS - NETWORK.n_regions
    untrained = Embedding.create(SMALL_CONFIG, NETWORK, SIZES, 0, CLASSES, 6).model
    initial, first, second = (each.layers[0].kernel[...][colors] for each in (untrained, two.model, *two.further))
    assert np.ptp(first / initial) > 0.1 and not second.any()


def test_few_samples_and_invisible_objects(views: Samples, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(fit, "BATCH_SIZE", 4096)
    assert_refused("expected at least 4096", fit_embedding, views, NETWORK, SMALL_CONFIG, 1, Checkpoints(tmp_path))
    monkeypatch.setattr(module, "MIN_VIEW_POINTS", 10**6)
    assert_refused("object 3 has no view", sample_objects, [3], NETWORK, SMALL_CONFIG, 1, directory=tmp_path)


def test_a_file_of_the_user_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with files_of_the_user(file := tmp_path / "embedding.safetensors"):
        assert_refused("embedding.safetensors", build_embedding, file)
    (tmp_path / "new.checkpoints").touch()
    monkeypatch.setattr("sys.argv", ["build", "--out", str(tmp_path / "new")])
    with pytest.raises(SystemExit, match="^error: .*new.checkpoints"):
        runpy.run_path(build.__file__, run_name="__main__")


@pytest.mark.slow
def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    out, other = tmp_path / "new" / "embedding.safetensors", tmp_path / "other.safetensors"
    command = functools.partial(build_embedding, objects=24, views=6, epochs=1, workers=1)
    command(out)
    assert capsys.readouterr().out.split()[-1] == Embedding.load(out).fingerprint
    assert {path.name for path in out.parent.iterdir()} == {out.name, REFERENCES_FILE}
    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        patch.setattr(fit, "reference_views", mock.Mock(side_effect=Interrupted))
        command(other)
    assert_refused("epochs 1, not 2", command, other, epochs=2)
    for repeated in ((module, "render_clouds"), (fit, "_step")):
        monkeypatch.setattr(*repeated, mock.Mock(side_effect=AssertionError))
    command(other)
    assert other.read_bytes() == out.read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"new", other.name, REFERENCES_FILE}
