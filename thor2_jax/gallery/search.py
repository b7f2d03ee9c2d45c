"""Nearest views: an exact search in chunks, and an approximate index behind the same interface.

>>> search = ExactSearch(np.eye(3, dtype=np.float16))
>>> search.nearest(np.array([[0.6, 0.8, 0]], np.float32), 2)[1]
array([[1, 0]])
"""

import contextlib
import functools
import importlib
from typing import Any

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

from thor2_jax.errors import needs_extra

__all__ = ["ExactSearch", "IndexSearch", "one_blas_thread"]

CHUNK = 2**14
"""Views per matrix product: 16 MB as float32 at 256 numbers each."""

BUILD_CANDIDATES = 64
"""Number of candidate neighbours of a view while the index is built, half of the default of usearch."""

SEARCH_CANDIDATES = 2048
"""Number of candidates for the nearest views of a query; with fewer, an index of millions misses many of them."""

FAST_VIEWS = 2**17
"""Largest number of views that are also stored as float32 (134 MB), since conversion takes half the time of a query."""


_thread_pools = functools.cache(threadpoolctl.ThreadpoolController)


def one_blas_thread() -> contextlib.AbstractContextManager[Any]:
    """Limit NumPy's linear algebra to one thread in the context.

    Small products gain nothing from several threads. On a busy machine the threads wait for one another, and a query of
    10 ms can take seconds.
    """
    return _thread_pools().limit(limits=1, user_api="blas")


class ExactSearch:
    """Exact search by matrix products in chunks, which need little memory beside the embeddings."""

    def __init__(self, embeddings: NDArray[np.float16]) -> None:
        """Store embeddings [N, D] of unit length, as float32 if they are few."""
        self._embeddings = embeddings.astype(np.float32) if len(embeddings) <= FAST_VIEWS else embeddings

    def nearest(self, queries: NDArray[np.float32], count: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
        """Return similarities and indices [Q, min(count, N)] of the nearest views, the nearest first.

        Views of equal similarity are in the order of their indices; if not all of them fit, any may be left out.

        Args:
            queries: [Q, D] of unit length.
            count: number of views.
        """
        parts = []
        with one_blas_thread() if len(self._embeddings) <= FAST_VIEWS else contextlib.nullcontext():
            for start in range(0, len(self._embeddings), CHUNK):
                chunk = self._embeddings[start : start + CHUNK]
                products = queries @ chunk.T.astype(np.float32, copy=False)
                best = _largest(products, count)
                parts.append((np.take_along_axis(products, best, axis=1), best + start))
        similarity, index = (np.concatenate(each, axis=1) for each in zip(*parts, strict=True))
        best = _largest(similarity, count)
        return np.take_along_axis(similarity, best, axis=1), np.take_along_axis(index, best, axis=1)


def _largest(values: NDArray[np.float32], count: int) -> NDArray[np.intp]:
    """Return the indices [Q, min(count, N)] of the largest values [Q, N], the largest first, equal ones by index."""
    count = min(count, values.shape[1])
    chosen = np.sort(np.argpartition(-values, count - 1, axis=1)[:, :count], axis=1)
    order = np.argsort(-np.take_along_axis(values, chosen, axis=1), axis=1, kind="stable")
    return np.take_along_axis(chosen, order, axis=1)


class IndexSearch:
    """Approximate search by a graph of views (HNSW) from the package usearch, for galleries of many objects."""

    def __init__(self, embeddings: NDArray[np.float16]) -> None:
        """Build the index of embeddings [N, D] of unit length, on all cores.

        Raises:
            InputError: usearch is not installed.
        """
        with needs_extra("index is usearch, which", "the package usearch", "index"):
            usearch: Any = importlib.import_module("usearch.index")
        self._embeddings = embeddings
        self._index = usearch.Index(
            ndim=embeddings.shape[1],
            metric="ip",
            dtype="f16",
            expansion_add=BUILD_CANDIDATES,
            expansion_search=SEARCH_CANDIDATES,
        )
        self._index.add(np.arange(len(embeddings)), embeddings)

    def nearest(self, queries: NDArray[np.float32], count: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
        """Return approximately the result of `ExactSearch.nearest`, in which some views may be replaced by others."""
        count = min(count, len(self._embeddings))
        matches = self._index.search(queries.astype(np.float16), count)
        rows = [matches] if len(queries) == 1 else list(matches)
        similarity, index = np.zeros((len(rows), count), np.float32), np.zeros((len(rows), count), np.intp)
        # An index that several threads have built may not reach all views, and then returns too few of them.
        short = np.array([len(row) < count for row in rows])
        for k in np.flatnonzero(~short):
            similarity[k], index[k] = 1 - rows[k].distances, rows[k].keys
        if short.any():
            similarity[short], index[short] = ExactSearch(self._embeddings).nearest(queries[short], count)
        return similarity, index
