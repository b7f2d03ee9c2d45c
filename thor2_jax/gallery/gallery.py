"""The gallery: embedded views of enrolled objects, and their scores for the views of unknown instances.

>>> gallery = Gallery("embedding-1").with_object("mug", mug)                        # doctest: +SKIP
>>> gallery.scores(embeddings).argmax(axis=-1)                                      # doctest: +SKIP

A score is a kernel ridge regression on the views that are nearest to the query (`NEAREST`), with one indicator as the
target of each object: about 1 amid the views of the object, about 0 far from them or amid the views of others. Its cost
does not grow with the gallery, and nothing is fitted when an object is enrolled or forgotten.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thor2_jax.errors import InputError
from thor2_jax.gallery.clouds import CompactClouds
from thor2_jax.gallery.search import ExactSearch, IndexSearch, ViewSearch, one_blas_thread

__all__ = ["Gallery", "GalleryObject"]

NEAREST = 128
"""Views of the gallery in the regression of a query; all views give the same accuracy on held-out frames."""

GAMMA = 4.0
"""The kernel of two views is exp(GAMMA (cosine - 1)); chosen on held-out frames."""

RIDGE = 0.3
"""Regularization; chosen on held-out frames."""

KEPT = {1: 0.25, 3: 0.29, 5: 0.31, 10: 0.35, 120: 0.43}
"""Views of an object -> score that 95 % of the correct answers reach: up to ten views from held-out frames, 120 views
from meshes."""


@dataclasses.dataclass(frozen=True, eq=False)
class GalleryObject:
    """The views of an enrolled object.

    Attributes:
        embeddings: [E, D] float16 of unit length: each view in several orientations, and its augmented copies.
        clouds: the views as they were enrolled.
        source: where the views come from: "mesh", "frames" or "mesh and frames".
        date: date of the last enrolment, ISO 8601.
    """

    embeddings: NDArray[np.float16]
    clouds: CompactClouds
    source: str
    date: str

    def __add__(self, other: "GalleryObject") -> "GalleryObject":
        return GalleryObject(
            np.concatenate([self.embeddings, other.embeddings]),
            self.clouds + other.clouds,
            self.source if self.source == other.source else "mesh and frames",
            other.date,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Gallery:
    """Enrolled objects; an immutable value.

    Attributes:
        embedding: fingerprint of the embedding that the views are embedded by.
        objects: name -> its views, in the order of enrolment.
        hidden: trained classes that were forgotten or replaced; no classifier answers by them.
        search: kind of search, "exact" or "usearch". An index answers queries among millions of views in milliseconds,
            but is built again, in minutes, after every change.
    """

    embedding: str
    objects: Mapping[str, GalleryObject] = dataclasses.field(default_factory=dict)
    hidden: tuple[str, ...] = ()
    search: str = "exact"

    def __post_init__(self) -> None:
        if self.search not in ("exact", "usearch"):
            raise InputError(f"search is {self.search!r}; expected 'exact' or 'usearch'")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects, in the order of the scores."""
        return tuple(self.objects)

    def with_object(self, name: str, views: GalleryObject, *, extend: bool = False, replace: bool = False) -> "Gallery":
        """Return the gallery with an object more.

        Args:
            name: name of the object.
            views: its views.
            extend: add the views to those of an object that exists.
            replace: discard the views of an object that exists.

        Raises:
            InputError: the name is empty, or exists and neither `extend` nor `replace` is given, or both are.
        """
        check_name(name)
        if extend and replace:
            raise InputError("extend and replace are both given; choose one")
        if name in self.objects and not (extend or replace):
            raise InputError(f"name: {name!r} is enrolled already; add views to it (extend) or replace it (replace)")
        if name in self.objects and extend:
            views = self.objects[name] + views
        return dataclasses.replace(self, objects={**self.objects, name: views})

    def without(self, name: str, *, hide: bool = False) -> "Gallery":
        """Return the gallery without an object; with `hide`, a trained class of this name is not answered any more.

        Raises:
            InputError: no object has the name, and `hide` is not given.
        """
        if name not in self.objects and not hide:
            raise InputError(f"name: {name!r} is not enrolled; expected one of {shown_names(self.names)}")
        objects = {other: views for other, views in self.objects.items() if other != name}
        hidden = (*self.hidden, name) if hide and name not in self.hidden else self.hidden
        return dataclasses.replace(self, objects=objects, hidden=hidden)

    def reembed(self, embedding: str, embed: Callable[[CompactClouds, str], NDArray[np.float16]]) -> "Gallery":
        """Return the gallery with all views embedded again.

        Args:
            embedding: fingerprint of the new embedding.
            embed: function of an object's clouds and their source that returns embeddings [E, D].
        """
        objects = {
            name: dataclasses.replace(views, embeddings=embed(views.clouds, views.source))
            for name, views in self.objects.items()
        }
        return dataclasses.replace(self, embedding=embedding, objects=objects)

    @functools.cached_property
    def _embeddings(self) -> NDArray[np.float16]:
        return np.concatenate([views.embeddings for views in self.objects.values()])

    @functools.cached_property
    def _counts(self) -> NDArray[np.intp]:
        return np.array([len(views.embeddings) for views in self.objects.values()])

    @functools.cached_property
    def _object_of_view(self) -> NDArray[np.intp]:
        return np.repeat(np.arange(len(self._counts)), self._counts)

    @functools.cached_property
    def unknown_below(self) -> NDArray[np.float64]:
        """[n_objects] least score of an answer with the name of each object, by default.

        It grows with the logarithm of the object's views between the numbers of `KEPT`.
        """
        views = [len(views.clouds) for views in self.objects.values()]
        return np.interp(np.log(views), np.log(list(KEPT)), list(KEPT.values())).round(3)

    @functools.cached_property
    def _search(self) -> ViewSearch:
        return IndexSearch(self._embeddings) if self.search == "usearch" else ExactSearch(self._embeddings)

    def scores(self, embeddings: ArrayLike, weights: ArrayLike | None = None) -> NDArray[np.float32]:
        """Return the scores [B, n_objects] of each object, from 0 to 1, in the order of `names`.

        Args:
            embeddings: [B, D] of unit length, or [B, K, D] for K candidate orientations, whose scores are averaged.
            weights: [B, K] weights of the orientations, which sum to 1; equal by default.
        """
        queries = np.asarray(embeddings, np.float32)
        if not self.objects or not len(queries):
            return np.zeros((len(queries), len(self.objects)), np.float32)
        if queries.ndim == 3:
            each = self.scores(queries.reshape(-1, queries.shape[-1])).reshape(*queries.shape[:2], -1)
            if weights is None:
                return each.mean(axis=1)
            return np.einsum("bkn,bk->bn", each, np.asarray(weights, np.float32))
        similarity, index = self._search.nearest(queries, NEAREST)
        views, owners = self._embeddings[index].astype(np.float32), self._object_of_view[index]
        # Objects of many views are regularized more, so that they do not outweigh those of few.
        ridge = RIDGE * self._counts[owners] / self._counts[self._object_of_view].mean()
        with one_blas_thread():
            kernel = np.exp(GAMMA * (views @ views.transpose(0, 2, 1) - 1)).astype(np.float64)
            kernel[:, np.arange(kernel.shape[1]), np.arange(kernel.shape[1])] += ridge
            duals = np.linalg.solve(kernel, np.exp(GAMMA * (similarity.astype(np.float64) - 1))[..., None])[..., 0]
        scores = np.zeros((len(queries), len(self.objects)))
        np.add.at(scores, (np.arange(len(queries))[:, None], owners), duals)
        return scores.clip(0, 1).astype(np.float32)


def check_name(name: object) -> str:
    """Return an object's name.

    Raises:
        InputError: it is no text, empty, longer than 200 characters or has control characters.
    """
    if not isinstance(name, str) or not name.strip() or len(name) > 200 or not name.isprintable():
        raise InputError(f"name is {name!r}; expected a printable text of 1 to 200 characters")
    return name


def shown_names(names: tuple[str, ...], count: int = 5) -> str:
    """Return the first names for an error message."""
    more = f" and {len(names) - count} more" if len(names) > count else ""
    return (", ".join(map(repr, names[:count])) or "none") + more
