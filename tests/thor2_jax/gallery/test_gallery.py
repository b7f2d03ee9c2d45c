"""Galleries as values: names, scores, forgetting, search."""

import dataclasses

import numpy as np
import pytest
import threadpoolctl

from thor2_jax.errors import InputError
from thor2_jax.gallery.clouds import CompactClouds
from thor2_jax.gallery.gallery import Gallery, GalleryObject
from thor2_jax.gallery.search import CHUNK, ExactSearch, IndexSearch
from thor2_jax.recognition.prepared_instance import PreparedInstance


def unit(values: np.ndarray) -> np.ndarray:
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def view(seed: int, n: int = 40) -> PreparedInstance:
    rng = np.random.default_rng(seed)
    points = (rng.random((n, 3)) * 0.2 + (0.1, -0.3, 0.6)).astype(np.float32)
    return PreparedInstance(1, points, rng.integers(0, 256, (n, 3), np.uint8), rng.random(n) < 0.2)


def views_around(center: int, count: int = 6, spread: float = 0.3, size: int = 16, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng([seed, center])
    return unit(np.eye(size)[center] + spread * unit(rng.normal(size=(count, size)))).astype(np.float16)


def enrolled(center: int, count: int = 6) -> GalleryObject:
    return GalleryObject(views_around(center, count), CompactClouds.of([view(center)]), "frames", "2026-01-02")


@pytest.fixture(scope="module")
def gallery() -> Gallery:
    gallery = Gallery("fingerprint")
    for center, name in enumerate(("mug", "bowl", "box")):
        gallery = gallery.with_object(name, enrolled(center, 4 + 20 * center))
    return gallery


def test_the_nearest_object_scores_highest(gallery: Gallery) -> None:
    queries = np.concatenate([views_around(k, 5, seed=1) for k in range(3)]).astype(np.float32)
    scores = gallery.scores(queries)
    assert scores.shape == (15, 3) and scores.dtype == np.float32
    assert (scores.argmax(axis=1) == np.repeat(np.arange(3), 5)).all()
    assert ((scores >= 0) & (scores <= 1)).all() and (scores.max(axis=1) > 0.5).all()


def test_an_unknown_object_scores_low(gallery: Gallery) -> None:
    known, unknown = views_around(0, 5, seed=1), views_around(9, 5, seed=1)
    assert gallery.scores(unknown).max() < gallery.scores(known).max(axis=1).min() / 2


def test_thresholds_grow_with_the_views_of_each_object() -> None:
    gallery = Gallery("fingerprint")
    for views in (1, 2, 3, 4, 5, 7, 10, 120):
        clouds = CompactClouds.of([view(0)] * views)
        gallery = gallery.with_object(f"{views}", dataclasses.replace(enrolled(0), clouds=clouds))
    # Between two numbers of views, the logarithm: .25 + .04 log(2) / log(3), and so on.
    expected = [0.25, 0.275, 0.29, 0.301, 0.31, 0.329, 0.35, 0.43]
    np.testing.assert_array_equal(gallery.unknown_below, expected)
    assert Gallery("fingerprint").unknown_below.shape == (0,)


def test_scores_use_one_thread_of_linear_algebra(gallery: Gallery, monkeypatch: pytest.MonkeyPatch) -> None:
    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"}

    before, inside, solve = threads(), [], np.linalg.solve
    monkeypatch.setattr(np.linalg, "solve", lambda a, b: inside.append(threads()) or solve(a, b))
    gallery.scores(views_around(0, 5, seed=1))
    assert inside == [{1}] and threads() == before


def test_scores_of_orientations_are_averaged(gallery: Gallery) -> None:
    queries = unit(np.random.default_rng(0).normal(size=(2, 4, 16))).astype(np.float32)
    each = np.stack([gallery.scores(queries[:, k]) for k in range(4)], axis=1)
    np.testing.assert_allclose(gallery.scores(queries), each.mean(axis=1), atol=1e-6)


def test_no_objects_or_no_queries_give_empty_scores(gallery: Gallery) -> None:
    assert Gallery("").scores(np.zeros((2, 16), np.float32)).shape == (2, 0)
    assert gallery.scores(np.zeros((0, 4, 16), np.float32)).shape == (0, 3)


def test_forgetting_restores_scores_exactly(gallery: Gallery) -> None:
    queries = unit(np.random.default_rng(0).normal(size=(7, 16))).astype(np.float32)
    changed = gallery.with_object("new", enrolled(3))
    assert changed.names == ("mug", "bowl", "box", "new") and gallery.names == ("mug", "bowl", "box")
    np.testing.assert_array_equal(changed.without("new").scores(queries), gallery.scores(queries))


def test_an_existing_name_needs_extend_or_replace(gallery: Gallery) -> None:
    with pytest.raises(InputError, match="'bowl'"):
        gallery.with_object("bowl", enrolled(1))
    with pytest.raises(InputError, match="extend and replace"):
        gallery.with_object("bowl", enrolled(1), extend=True, replace=True)
    extended = gallery.with_object("bowl", enrolled(1, 5), extend=True)
    replaced = gallery.with_object("bowl", enrolled(1, 5), replace=True)
    assert [len(g.objects["bowl"].embeddings) for g in (gallery, extended, replaced)] == [24, 29, 5]
    assert [len(g.objects["bowl"].clouds) for g in (gallery, extended, replaced)] == [1, 2, 1]
    assert extended.names == replaced.names == gallery.names


def test_forgetting_an_unknown_name_is_refused(gallery: Gallery) -> None:
    with pytest.raises(InputError, match="'cup'"):
        gallery.without("cup")
    hidden = gallery.without("cup", hide=True).without("cup", hide=True)
    assert hidden.hidden == ("cup",) and hidden.names == gallery.names


@pytest.mark.parametrize("name", ["", " ", "a\nb", "x" * 201, 3])
def test_names_are_printable_texts(name: str, gallery: Gallery) -> None:
    with pytest.raises(InputError, match="name is"):
        gallery.with_object(name, enrolled(0))


def test_reembedding_replaces_all_embeddings(gallery: Gallery) -> None:
    other = gallery.reembed("other", lambda clouds, source: np.full((2, 8), len(clouds), np.float16))
    assert other.embedding == "other" and other.names == gallery.names
    assert all(views.embeddings.shape == (2, 8) for views in other.objects.values())
    assert other.objects["mug"].clouds is gallery.objects["mug"].clouds


def test_compact_clouds_keep_points_to_0_05_mm() -> None:
    views = [view(0, 3), view(1, 50)]
    clouds = CompactClouds.of(views[:1]) + CompactClouds.of(views[1:])
    assert len(clouds) == 2 and clouds.points.dtype == np.int16
    for restored, expected in zip(clouds.views(), views, strict=True):
        np.testing.assert_allclose(restored.points, expected.points, atol=3e-5)
        np.testing.assert_array_equal(restored.colors, expected.colors)
        np.testing.assert_array_equal(restored.boundary, expected.boundary)
    again = CompactClouds.of(list(clouds.views()))
    np.testing.assert_array_equal(again.points, clouds.points)


def test_clouds_without_points_or_too_large_are_refused() -> None:
    empty = dataclasses.replace(view(0), points=np.zeros((0, 3), np.float32), reason="too few")
    with pytest.raises(InputError, match=r"views\[1\] has no points"):
        CompactClouds.of([view(0), empty])
    with pytest.raises(InputError, match=r"views\[0\] is .* m long"):
        CompactClouds.of([dataclasses.replace(view(0), points=view(0).points * 50)])


def test_exact_search_in_chunks_equals_one_product(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    embeddings = unit(rng.normal(size=(301, 8))).astype(np.float16)
    embeddings[100] = embeddings[7]
    queries = np.concatenate([unit(rng.normal(size=(4, 8))), embeddings[7:8]]).astype(np.float32)
    assert len(embeddings) < CHUNK
    similarity, index = ExactSearch(embeddings).nearest(queries, 20)
    products = queries @ embeddings.astype(np.float32).T
    np.testing.assert_allclose(similarity, -np.sort(-products, axis=1)[:, :20], atol=1e-6)
    assert list(index[4, :2]) == [7, 100]
    monkeypatch.setattr("thor2_jax.gallery.search.CHUNK", 64)
    chunked = ExactSearch(embeddings).nearest(queries, 20)
    np.testing.assert_allclose(chunked[0], similarity, atol=1e-6)
    assert [set(row) for row in chunked[1]] == [set(row) for row in index]
    assert ExactSearch(embeddings[:3]).nearest(queries, 20)[1].shape == (5, 3)


def test_the_index_finds_the_same_nearest_views(gallery: Gallery) -> None:
    pytest.importorskip("usearch")
    queries = np.concatenate([views_around(k, 3, seed=2) for k in range(3)]).astype(np.float32)
    indexed = dataclasses.replace(gallery, search="usearch")
    np.testing.assert_allclose(indexed.scores(queries), gallery.scores(queries), atol=0.02)


def test_recall_of_the_index() -> None:
    pytest.importorskip("usearch")
    rng = np.random.default_rng(0)
    centers = np.repeat(unit(rng.normal(size=(500, 32))), 10, axis=0)
    embeddings = unit(centers + 0.6 * unit(rng.normal(size=centers.shape))).astype(np.float16)
    queries = embeddings[::50].astype(np.float32)
    _, exact = ExactSearch(embeddings).nearest(queries, 20)
    similarity, index = IndexSearch(embeddings).nearest(queries, 20)
    assert np.mean([len(np.intersect1d(*rows)) / 20 for rows in zip(exact, index, strict=True)]) > 0.98
    np.testing.assert_allclose(similarity, np.einsum("qd,qnd->qn", queries, embeddings[index]), atol=5e-3)


def test_an_unknown_search_is_refused() -> None:
    with pytest.raises(InputError, match="search is 'faiss'"):
        Gallery("", search="faiss")
