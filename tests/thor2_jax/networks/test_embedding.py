"""Embeddings: their length, invariances, files, damaged files, and the file of reference views."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
import scipy.special
from refusals import assert_refused
from small_clouds import random_clouds
from small_runs import SMALL_CONFIG

import thor2_jax as thor2
from thor2_jax.descriptor.looks import LookDescriptors, describe_looks
from thor2_jax.networks.embedding import BACKGROUND, REFERENCES_FILE, Embedding, References, load_default
from thor2_jax.networks.networks import EmbeddingSizes

SIZES = EmbeddingSizes(cell=4, hidden=(16, 16), learned=8, color=6)


def random_embedding() -> Embedding:
    embedding = Embedding.create(SMALL_CONFIG, sizes=SIZES)
    basis = embedding.model.color_basis
    basis[...] = jnp.asarray(np.random.default_rng(0).normal(size=basis[...].shape), jnp.float32)
    return embedding


@pytest.fixture(scope="module")
def embedding() -> Embedding:
    return random_embedding()


@pytest.fixture(scope="module")
def clouds() -> thor2.PointClouds:
    return thor2.PointClouds.pack(random_clouds(0, [300] * 3))


@pytest.fixture(scope="module")
def oriented(embedding: Embedding, clouds: thor2.PointClouds) -> LookDescriptors:
    """Two looks at each cloud, for all embeddings of this file, which have the same descriptor."""
    return describe_looks(clouds, embedding.network, embedding.config, 2).with_balanced(clouds)


def test_embeddings_have_unit_length(
    embedding: Embedding, clouds: thor2.PointClouds, oriented: LookDescriptors
) -> None:
    values = np.asarray(embedding.embed(clouds))
    assert values.shape == (3, embedding.size) and embedding.size == 8 + 6
    np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1, atol=1e-5)
    assert (values[0] @ values[1]) < 1 - 1e-4
    np.testing.assert_allclose(embedding.embed_oriented(oriented)[:, 0], values, atol=1e-5)
    empty = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    assert np.isfinite(embedding.embed(thor2.PointClouds.pack([empty, *random_clouds(0, [300]), empty]))).all()


def ensemble() -> Embedding:
    """Three networks of two classes and three distractors."""
    first = Embedding.create(SMALL_CONFIG, sizes=SIZES, classes=("a", "b"), distractors=3)
    return dataclasses.replace(first, further=(first.create_further(1), first.create_further(2)))


@pytest.mark.parametrize("nearest", [True, False])
def test_class_probabilities_are_geometric_means(nearest: bool, oriented: LookDescriptors) -> None:
    embedding = dataclasses.replace(ensemble(), sizes=dataclasses.replace(SIZES, nearest=nearest))
    actual = embedding.class_probabilities(oriented)
    means = []
    for model in (embedding.model, *embedding.further):
        one = dataclasses.replace(embedding, model=model, further=())  # its first block is the learned one
        unit = np.asarray(one.embed_oriented(oriented)[..., : SIZES.learned], np.float64)
        unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
        proxies = np.asarray(model.proxies[...], np.float16).astype(np.float64)
        scale = np.exp(np.float16(model.log_scale[...]).astype(np.float64))
        logits = scale * unit @ (proxies / np.linalg.norm(proxies, axis=0))
        if nearest:
            logits[..., 2:] = logits[..., 2:].max(axis=-1, keepdims=True)
        means.append(scipy.special.log_softmax(logits, axis=-1).mean(axis=1))
    assert all(np.abs(means[a] - means[b]).max() > 0.1 for a, b in ((0, 1), (0, 2), (1, 2)))
    expected = scipy.special.softmax(np.mean(means, axis=0), axis=1)[:, :2]
    np.testing.assert_allclose(actual, expected, atol=1e-4)


def test_nearest_views_of_the_answered_class_raise_the_odds(oriented: LookDescriptors) -> None:
    embedding = ensemble()
    before = np.asarray(embedding.class_probabilities(oriented), np.float64)
    answer = before.argmax(axis=1)
    assert answer.tolist() == [1, 0, 0]

    views, label = np.random.default_rng(2).normal(size=(6, embedding.size)), np.array([0, 1, BACKGROUND, 1, 0, 0])
    references = References(views.astype(np.float16), label.astype(np.int32), ("a", "b"))
    with_views = dataclasses.replace(embedding, references=references)
    learned, of_views = np.asarray(embedding.embed_oriented(oriented))[..., :8], views[:, :8]
    norms = np.linalg.norm(learned, axis=-1)[..., None] * np.linalg.norm(of_views, axis=1)
    cosines = np.einsum("bkl,nl->bkn", learned, of_views) / norms
    nearest = np.array([of[:, label == k].max(axis=-1).mean() for of, k in zip(cosines, answer, strict=True)])
    assert (nearest < cosines.max(axis=-1).mean(axis=1)).any()
    odds = before / (1 - before.sum(axis=1, keepdims=True)) * np.exp(10 * (nearest - 0.8))[:, None]
    expected = odds / (1 + odds.sum(axis=1, keepdims=True))
    np.testing.assert_allclose(with_views.class_probabilities(oriented), expected, rtol=0.02)
    without = dataclasses.replace(with_views, sizes=dataclasses.replace(SIZES, views=False))
    assert np.array_equal(without.class_probabilities(oriented), np.asarray(before, np.float32))


def test_a_file_holds_all_networks(clouds: thor2.PointClouds, oriented: LookDescriptors, tmp_path: Path) -> None:
    embedding, path = ensemble(), tmp_path / "embedding.safetensors"
    embedding.save(path)
    loaded = Embedding.load(path)
    loaded.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == path.read_bytes()
    assert loaded.fingerprint == embedding.fingerprint != random_embedding().fingerprint
    assert (loaded.config, loaded.sizes) == (embedding.config, embedding.sizes)
    assert np.array_equal(loaded.class_probabilities(oriented), embedding.class_probabilities(oriented))
    assert np.array_equal(loaded.embed(clouds), embedding.embed(clouds))
    assert not loaded.without_proxies().further


def test_embeddings_have_gradients(embedding: Embedding, oriented: LookDescriptors) -> None:
    """Most strips have no point of most colours: their colour embeddings are 0, where a square root has no slope."""
    assert not np.asarray(oriented.each.embeddings).all()
    total = lambda looks: embedding.embed_oriented(looks)[..., 0].sum()  # noqa: E731
    gradients = jax.jit(jax.grad(total, allow_int=True))(oriented)
    for gradient in (gradients.each.images, gradients.each.embeddings, gradients.statistics):
        assert np.isfinite(gradient).all() and np.asarray(gradient).any()


def test_block_weights_are_the_shares_of_the_similarity(clouds: thor2.PointClouds) -> None:
    values = []
    for weights in ([1.0, 2.0], [2.0, 0.0]):
        embedding = random_embedding()
        embedding.model.block_weights[...] = jnp.asarray(weights)
        values.append(np.asarray(embedding.embed(clouds)))
    np.testing.assert_allclose(values[0][:, :8] * np.sqrt(3), values[1][:, :8], atol=1e-4)
    assert not values[1][:, 8:].any()


def rewritten(path: Path, keep: Callable[[str], bool] = lambda name: True, **changes: object) -> None:
    """Replace values in the metadata of a file, and keep some of its arrays."""
    with safetensors.safe_open(path, "numpy") as stored:
        about = json.loads(stored.metadata()["embedding"])
        arrays = {name: stored.get_tensor(name) for name in stored.keys() if keep(name)}
    path.write_bytes(safetensors.numpy.save(arrays, {"embedding": json.dumps({**about, **changes})}))


def stored_earlier(embedding: Embedding, directory: Path, *added: str) -> Embedding:
    """Save and load an embedding; the file lacks some sizes, which a later version added."""
    path = directory / "embedding.safetensors"
    embedding.save(path)
    rewritten(path, sizes={name: value for name, value in dataclasses.asdict(SIZES).items() if name not in added})
    return Embedding.load(path)


def test_files_of_earlier_versions_have_a_block_of_regions(tmp_path: Path, clouds: thor2.PointClouds) -> None:
    earlier = Embedding.create(SMALL_CONFIG, sizes=dataclasses.replace(SIZES, balanced=False))
    loaded = stored_earlier(earlier, tmp_path, "balanced", "shape")
    values = np.asarray(loaded.embed(clouds))
    assert not loaded.sizes.balanced and values.shape == (3, 8 + 6 + 22)
    statistics = describe_looks(clouds, loaded.network, loaded.config, 1).statistics[:, 0, 12 : 12 + 22]
    # The basis is zero, so that the learned block and that of the regions have equal shares.
    np.testing.assert_allclose(values[:, 14:], statistics / np.sqrt(2), atol=1e-4)
    learned = Embedding.create(SMALL_CONFIG, sizes=SIZES).embed(clouds)[:, :8]
    np.testing.assert_allclose(learned, values[:, :8] * np.sqrt(2), atol=1e-3)


def test_files_of_earlier_versions_compare_no_images(tmp_path: Path, clouds: thor2.PointClouds) -> None:
    embedding = random_embedding()
    oriented = describe_looks(clouds, embedding.network, embedding.config, 1).with_balanced(clouds)
    flat = dataclasses.replace(oriented.each, images=jnp.ones_like(oriented.each.images))
    earlier = Embedding.create(SMALL_CONFIG, sizes=dataclasses.replace(SIZES, shape=False))
    n_colors = earlier.model.color_basis.shape[0]
    earlier.model.color_basis[...] = embedding.model.color_basis[...][:n_colors]
    loaded = stored_earlier(earlier, tmp_path, "shape")
    assert (loaded.sizes.version, embedding.sizes.version) == (1, 2)
    assert embedding.model.color_basis.shape[0] == n_colors + 2 * 4**2  # cells of two slices
    for each, changes in ((loaded, False), (embedding, True)):
        both = (oriented, dataclasses.replace(oriented, each=flat))
        blocks = (np.asarray(each.embed_oriented(looks)[:, 0, 8:]) for looks in both)
        first, second = (block / np.linalg.norm(block, axis=1, keepdims=True) for block in blocks)
        assert (np.abs(first - second).max() > 1e-3) == changes


def test_files_of_earlier_versions_sum_the_distractors(tmp_path: Path, oriented: LookDescriptors) -> None:
    embedding = ensemble()
    summed = dataclasses.replace(embedding, sizes=dataclasses.replace(SIZES, nearest=False))
    loaded, expected, nearest = (
        np.asarray(each.class_probabilities(oriented))
        for each in (stored_earlier(summed, tmp_path, "nearest"), summed, embedding)
    )
    assert np.array_equal(loaded, expected)
    assert np.abs(nearest.sum(axis=1) - expected.sum(axis=1)).min() > 1e-3
    # The shares of the classes, and therefore the answers, are the same.
    np.testing.assert_allclose(*(p / p.sum(axis=1, keepdims=True) for p in (nearest, expected)), rtol=1e-4)


OTHER_KINDS: list[dict[str, object]] = [
    *({name: 99} for name in ("format", "descriptor_version", "color_network")),
    *({"sizes": sizes} for sizes in (dataclasses.asdict(EmbeddingSizes()), {"cell": 0})),
    {"descriptor_config": {}},
]


def test_other_damaged_and_missing_files_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "embedding.safetensors"
    assert_refused(r"embedding.safetensors", Embedding.load, path)
    ensemble().save(path)
    whole = path.read_bytes()
    for content in (b"", whole[:-1], b"\0" * 400, safetensors.numpy.save({"x": np.zeros(3)})):
        path.write_bytes(content)
        assert_refused(r"embedding.safetensors", Embedding.load, path)
    for changes in OTHER_KINDS:
        path.write_bytes(whole)
        rewritten(path, **changes)
        assert_refused(r"embedding.safetensors", Embedding.load, path)
    for prefix in ("further/1/", "further/", "further/0/head"):  # networks or parts of one are missing
        path.write_bytes(whole)
        rewritten(path, lambda name, prefix=prefix: not name.startswith(prefix))
        assert_refused("embedding.safetensors cannot be used", Embedding.load, path)


def test_the_packaged_embedding_is_small_and_has_references() -> None:
    packaged = load_default()
    assert packaged.size <= 256 and len(packaged._content) <= 5_500_000
    assert packaged.references is not None and packaged.references.embeddings.shape == (1024, packaged.size)
    assert (packaged.references.label == BACKGROUND).all() and packaged.references.classes == ()


VIEWS = np.eye(8 + 6, dtype=np.float16)[[0, 1, 2]]
REFERENCES = References(VIEWS, np.array([0, 1, BACKGROUND], np.int32), ("a", "b"))


def test_references_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "r"
    REFERENCES.save(path, "print")
    assert_refused("of another embedding.*copy both files", References.load, path, "other", 14)
    assert_refused("embeddings are float16", References.load, path, "print", 15)
    path.write_bytes(path.read_bytes()[:-3])
    assert_refused("cannot be used", References.load, path, "print", 14)
    References(VIEWS, np.array([0, 1, 2], np.int32), ("a", "b")).save(path, "print")
    assert_refused("out of range", References.load, path, "print", 14)


def test_an_embedding_keeps_its_references_beside_it(tmp_path: Path) -> None:
    embedding, path = dataclasses.replace(ensemble(), references=REFERENCES), tmp_path / "embedding.safetensors"
    embedding.save(path)
    np.testing.assert_equal(vars(Embedding.load(path).references), vars(REFERENCES))
    (tmp_path / REFERENCES_FILE).unlink()
    assert Embedding.load(path).references is None
