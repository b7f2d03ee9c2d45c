"""Galleries as values: names, scores, forgetting, search."""

import dataclasses
import functools
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import threadpoolctl
from refusals import assert_refused
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF
from small_clouds import random_clouds

from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery import search
from thor2_jax.gallery.compact_clouds import CompactClouds
from thor2_jax.gallery.gallery import GAMMA, NEAREST, RIDGE, Gallery, GalleryObject
from thor2_jax.gallery.search import ExactSearch, IndexSearch
from thor2_jax.networks.embedding import BACKGROUND, References
from thor2_jax.surfaces.evidence import sample_points, with_evidence_on_host
from thor2_jax.types import PointClouds
from training.objects.builtin_objects import builtin_objects
from training.objects.surfaces import surfaces_of
from training.rendering.camera import camera_pose
from training.views.mesh_views import view_cloud


def unit(values: np.ndarray) -> np.ndarray:
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def view(seed: int, n: int = 40) -> PreparedInstance:
    (cloud,) = random_clouds(seed, [n])
    return PreparedInstance(1, *cloud, np.random.default_rng(seed).random(n) < 0.2)


def views_around(center: int, count: int = 6, spread: float = 0.3, size: int = 16, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng([seed, center])
    return unit(np.eye(size)[center] + spread * unit(rng.normal(size=(count, size)))).astype(np.float16)


def enrolled(center: int, count: int = 6) -> GalleryObject:
    return GalleryObject(views_around(center, count), CompactClouds.of([view(center)]), "frames", "2026-01-02")


@pytest.fixture(scope="module")
def gallery() -> Gallery:
    return Gallery("fingerprint", {name: enrolled(k, 4 + 20 * k) for k, name in enumerate(("mug", "bowl", "box"))})


def test_surfaces_change_the_scores_of_their_objects_only(gallery: Gallery) -> None:
    """Against `compared` for the two objects with a surface, in float64; all points of a view of a can fit it."""
    mesh = builtin_objects()["soup_can_red"]
    surface = surfaces_of([mesh])
    objects = {name: dataclasses.replace(views, surface=surface.arrays) for name, views in gallery.objects.items()}
    with_surfaces = dataclasses.replace(gallery, objects={**objects, "mug": gallery.objects["mug"]})
    clouds = PointClouds.pack([view_cloud(mesh, camera_pose(0.4, 1.1, mesh.centre)), *random_clouds(0, [500, 0])])
    scores = np.random.default_rng(0).uniform(0.1, 0.3, (3, 3)).astype(np.float32)
    changed = with_surfaces.with_evidence(scores, sample_points(clouds))
    np.testing.assert_array_equal(changed[:, 0], scores[:, 0])
    odds = (scores[:, 1:].astype(np.float64) / 0.2) ** 3
    known = with_evidence_on_host(odds / (1 + odds.sum(axis=1, keepdims=True)), [surface] * 2, sample_points(clouds))
    expected = 0.2 * (known / (1 - known.sum(axis=1, keepdims=True))) ** (1 / 3)
    expected[0] /= expected[0].max()  # it is above 1
    np.testing.assert_allclose(changed[:, 1:], expected, rtol=1e-3)
    assert changed[0, 1] > 2 * scores[0, 1]
    assert with_surfaces.unknown_below[1] == 0.881 and with_surfaces.unknown_below[0] == gallery.unknown_below[0]


def test_thresholds_grow_with_the_views_of_each_object() -> None:
    clouds = {views: CompactClouds.of([view(0)] * views) for views in (1, 2, 3, 4, 5, 7, 10, 120)}
    objects = {f"{views}": dataclasses.replace(enrolled(0), clouds=clouds[views]) for views in clouds}
    gallery = Gallery("fingerprint", objects)
    # Between two numbers of views, the logarithm: .25 + .04 log(2) / log(3), and so on.
    for version, reference_views, scores in (
        (0, None, {1: 0.25, 2: 0.2752, 3: 0.29, 4: 0.3013, 5: 0.31, 7: 0.3294, 10: 0.35, 120: 0.43}),
        (0, references(), {1: 0.05, 2: 0.0879, 3: 0.11, 4: 0.1128, 5: 0.115, 7: 0.1174, 10: 0.12, 120: 0.3}),
        (1, references(), {1: 0.17, 3: 0.24, 5: 0.27, 10: 0.29}),
        (2, None, {1: 0.255, 3: 0.345, 5: 0.375, 10: 0.43, 120: 0.455}),
        (2, references(("mug", 3)), {1: 0.145, 3: 0.235, 5: 0.25, 10: 0.305, 120: 0.39}),
        (2, references(), {1: 0.185, 3: 0.27, 5: 0.305, 10: 0.36, 120: 0.45}),
    ):
        of_version = dataclasses.replace(gallery, references=reference_views, embedding_version=version)
        thresholds = dict(zip(gallery.names, of_version.unknown_below, strict=True))
        for views, score in scores.items():
            odds = (score / 0.2) ** 3
            assert thresholds[f"{views}"] == pytest.approx(odds / (1 + odds), abs=6e-4)
    assert Gallery("fingerprint").unknown_below.shape == (0,)


def references(*classes: tuple[str, int]) -> References:
    """Return 40 views around 9, the background, and 12 around the centre of each class."""
    views = [views_around(center, 12, seed=2) for _, center in classes]
    label = np.repeat(np.arange(len(classes) + 1), [12] * len(classes) + [40])
    return References(
        np.concatenate([*views, views_around(9, 40, seed=2)]),
        np.where(label == len(classes), BACKGROUND, label).astype(np.int32),
        tuple(name for name, _ in classes),
    )


def test_scores_of_views_and_looks_against_a_gaussian_process() -> None:
    """All views are neighbours here, so that the regression is the mean of a Gaussian process of scikit-learn."""
    gallery = Gallery("f", references=references(("class", 5), ("mug", 0), ("forgotten", 6)), hidden=("forgotten",))
    for name, center, count in (("mug", 0, 4), ("bowl", 1, 24)):
        gallery = gallery.with_object(name, enrolled(center, count))
    views = np.concatenate([*(each.embeddings for each in gallery.objects.values()), gallery.references.embeddings])
    owner = np.repeat([0, 1, 2, 0, 4, 4], [4, 24, 12, 12, 12, 40])  # mug, bowl, class, forgotten class, background
    counts = np.array([4, 24, 14, 14, 14])[owner]  # of an owner that is not enrolled, the mean of those that are
    process = GaussianProcessRegressor(RBF(GAMMA**-0.5, "fixed"), alpha=RIDGE * counts / counts.mean(), optimizer=None)
    process.fit(views, np.eye(5)[owner])
    pairs = [(0, 5), (1, 5), (6, 5), (0, 6), (1, 9)]
    queries = np.concatenate([unit(views_around(a, 5, seed=1) + views_around(b, 5, seed=3)) for a, b in pairs])
    values = process.predict(queries).clip(0)
    scores = values[:, :2].clip(0, 1)
    expected = scores * scores / (scores + values[:, 2:3])
    assert len(views) <= NEAREST and (expected.max(axis=1) > 0.05).sum() >= 10
    np.testing.assert_allclose(gallery.scores(queries), expected, atol=8e-4)
    looks, mean = queries.reshape(5, 5, 16), expected.reshape(5, 5, 2).mean(axis=1)
    np.testing.assert_allclose(gallery.scores(looks), mean, atol=8e-4)
    assert gallery.scores(looks[:0]).shape == (0, 2) and gallery.scores(queries).dtype == np.float32
    assert Gallery("").scores(queries).shape == (25, 0)
    # Amid the background, the value of the only class is negative.
    few = Gallery("f", references=references(("class", 5))).with_object("mug", enrolled(0, 4))
    assert few.scores(views_around(9, 5, seed=1)).max() < 0.01


def test_scores_use_one_thread_of_linear_algebra(gallery: Gallery, monkeypatch: pytest.MonkeyPatch) -> None:
    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"}

    search._thread_pools.cache_clear()  # it has the libraries that were loaded when it was made
    before, inside, solve = threads(), [], np.linalg.solve
    monkeypatch.setattr(np.linalg, "solve", lambda a, b: inside.append(threads()) or solve(a, b))
    gallery.scores(views_around(0, 5, seed=1))
    assert inside == [{1}] and threads() == before


def test_an_existing_name_needs_extend_or_replace(gallery: Gallery) -> None:
    gallery = dataclasses.replace(gallery, trained=("a", "b", "c"))
    for name, message in {
        "bowl": "'bowl' is enrolled already",
        " bowl\t": "'bowl' is enrolled already",
        "a": "'a' is a trained class",
        "unknown": "name is 'unknown'",
    }.items():
        assert_refused(message, gallery.with_object, name, enrolled(1))
    assert_refused("extend and replace", gallery.with_object, "bowl", enrolled(1), extend=True, replace=True)
    later = dataclasses.replace(enrolled(1, 5), date="2026-02-03")
    extended = gallery.with_object("bowl", later, extend=True)
    replaced = gallery.with_object("bowl", enrolled(1, 5), replace=True)
    assert [len(g.objects["bowl"].embeddings) for g in (gallery, extended, replaced)] == [24, 29, 5]
    assert [len(g.objects["bowl"].clouds) for g in (gallery, extended, replaced)] == [1, 2, 1]
    assert extended.names == replaced.names == gallery.names and extended.objects["bowl"].date == later.date
    changed = gallery.with_object("a", enrolled(1), extend=True).with_object("b", enrolled(1), replace=True)
    assert changed.hidden == (*replaced.hidden, "b") and changed.answered_names == ("a", "c", *gallery.names, "b")
    cafe = gallery.with_object("cafe\u0301 ", enrolled(0))
    assert cafe.names[-1] == "caf\u00e9"
    assert cafe.with_object("cafe\u0301", enrolled(0), extend=True).names == cafe.names


def test_forgetting_an_unknown_name_is_refused(gallery: Gallery) -> None:
    assert_refused("'cup'", gallery.without, "cup")
    assert_refused("name: None", gallery.without, None)
    hidden = dataclasses.replace(gallery, trained=("b", "cup")).without("cup")
    assert hidden.hidden == ("cup",) and hidden.names == gallery.names
    assert_refused("'cup'.*: b, ", hidden.without, "cup")
    assert_refused("'cups'.* recognizes: cup$", dataclasses.replace(gallery, trained=("b", "cup")).without, "cups")


def test_compact_clouds_keep_points_to_0_05_mm() -> None:
    views = [view(0, 3), view(1, 50)]
    views[1] = dataclasses.replace(views[1], points=views[1].points + np.float32(10))  # far from the camera
    clouds = CompactClouds.of(views[:1]) + CompactClouds.of(views[1:])
    assert len(clouds) == 2 and clouds.points.dtype == np.int16
    for restored, expected in zip(clouds.views(), views, strict=True):
        np.testing.assert_allclose(restored.points, expected.points, atol=3e-5)
        np.testing.assert_array_equal(restored.colors, expected.colors)
        np.testing.assert_array_equal(restored.boundary, expected.boundary)
    np.testing.assert_array_equal(CompactClouds.of(list(clouds.views())).points, clouds.points)


def test_clouds_without_points_or_too_large_are_refused() -> None:
    empty = dataclasses.replace(view(0), points=np.zeros((0, 3), np.float32), reason="too few")
    assert_refused(r"views\[1\] has no points", CompactClouds.of, [view(0), empty])
    large = dataclasses.replace(view(0), points=view(0).points * 50)
    assert_refused(r"views\[0\] is .* m long", CompactClouds.of, [large])


def test_exact_search_in_chunks_equals_one_product(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    embeddings = unit(rng.normal(size=(301, 8))).astype(np.float16)
    embeddings[100] = embeddings[7]
    queries = np.concatenate([unit(rng.normal(size=(4, 8))), embeddings[7:8]]).astype(np.float32)
    similarity, index = ExactSearch(embeddings).nearest(queries, 20)
    products = queries @ embeddings.astype(np.float32).T
    np.testing.assert_allclose(similarity, -np.sort(-products, axis=1)[:, :20], atol=1e-6)
    assert list(index[4, :2]) == [7, 100]
    monkeypatch.setattr("thor2_jax.gallery.search.CHUNK", 64)
    chunked = ExactSearch(embeddings).nearest(queries, 20)
    np.testing.assert_allclose(chunked[0], similarity, atol=1e-6)
    assert [set(row) for row in chunked[1]] == [set(row) for row in index]
    assert ExactSearch(embeddings[:3]).nearest(queries, 20)[1].shape == (5, 3)


@pytest.fixture
def usearch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let one thread build an index: the views that several threads connect depend on how busy the machine is."""
    index_type = pytest.importorskip("usearch.index").Index
    monkeypatch.setattr(index_type, "add", functools.partialmethod(index_type.add, threads=1))


@pytest.mark.usefixtures("usearch")
def test_the_index_finds_the_same_nearest_views(gallery: Gallery) -> None:
    assert_refused("search is 'faiss'", Gallery, "", search="faiss")
    queries = np.concatenate([views_around(k, 3, seed=2) for k in range(3)]).astype(np.float32)
    indexed = dataclasses.replace(gallery, search="usearch")
    np.testing.assert_allclose(indexed.scores(queries), gallery.scores(queries), atol=0.02)
    received = pickle.loads(pickle.dumps(indexed))  # builds its index again
    np.testing.assert_allclose(received.scores(queries[:1]), gallery.scores(queries[:1]), atol=0.02)


@pytest.mark.usefixtures("usearch")
def test_recall_of_the_index() -> None:
    rng = np.random.default_rng(0)
    centers = np.repeat(unit(rng.normal(size=(500, 32))), 10, axis=0)
    embeddings = unit(centers + 0.6 * unit(rng.normal(size=centers.shape))).astype(np.float16)
    queries = embeddings[::50].astype(np.float32)
    _, exact = ExactSearch(embeddings).nearest(queries, 20)
    similarity, index = IndexSearch(embeddings).nearest(queries, 20)
    assert np.mean([len(np.intersect1d(*rows)) / 20 for rows in zip(exact, index, strict=True)]) > 0.98
    np.testing.assert_allclose(similarity, np.einsum("qd,qnd->qn", queries, embeddings[index]), atol=5e-3)


@pytest.mark.usefixtures("usearch")
def test_queries_that_the_index_answers_in_part_are_searched_exactly() -> None:
    rng = np.random.default_rng(0)
    embeddings = unit(rng.normal(size=(40, 16))).astype(np.float16)
    queries = unit(rng.normal(size=(3, 16))).astype(np.float32)
    search = IndexSearch(embeddings)
    whole = search._index

    def search_in_part(vectors: np.ndarray, count: int) -> list:
        """Reach 5 views by the second query, as can be after several threads have built the index."""
        rows = list(whole.search(vectors, count))
        rows[1] = dataclasses.replace(rows[1], keys=rows[1].keys[:5], distances=rows[1].distances[:5])
        return rows

    search._index = SimpleNamespace(search=search_in_part)
    for found, exact in zip(search.nearest(queries, 20), ExactSearch(embeddings).nearest(queries, 20), strict=True):
        np.testing.assert_allclose(found, exact, atol=2e-3)
