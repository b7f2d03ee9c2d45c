"""The gallery: embedded views of enrolled objects beside the trained classes, and their scores for instances.

The views are kept as compact clouds with a few bytes per point, from which any embedding can be computed again.

>>> gallery = Gallery("embedding-1").with_object("mug", mug)                        # doctest: +SKIP
>>> gallery.scores(embeddings).argmax(axis=-1)                                      # doctest: +SKIP

A score is a kernel ridge regression on the views that are nearest to the query (`NEAREST`), with one indicator as the
target of each name: about 1 among the views of the object, about 0 far from them or among the views of others. The
regression includes the views of the enrolled objects and the references of the embedding: views of the trained classes
and of background objects. The cost does not grow with the gallery, and nothing is fitted when an object is enrolled or
forgotten. `Gallery.combine` combines the scores with the confidences of the classifiers.
"""

import dataclasses
import difflib
import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thor2_jax.errors import InputError
from thor2_jax.gallery.compact_clouds import CompactClouds
from thor2_jax.gallery.search import ExactSearch, IndexSearch, one_blas_thread
from thor2_jax.printable import check_name, find_name, first_names

if TYPE_CHECKING:
    from thor2_jax.networks.embedding import References
    from thor2_jax.surfaces.evidence import Sample
    from thor2_jax.surfaces.surfaces import Surfaces

__all__ = ["Gallery", "GalleryObject", "known_probability"]

NEAREST = 128
"""Number of views in the regression of a query; using all views gives the same accuracy on held-out frames."""

GAMMA = 4.0
"""The kernel of two views is exp(GAMMA (cosine - 1)); chosen on held-out frames."""

RIDGE = 0.3
"""Regularization; chosen on held-out frames."""

KEPT: tuple[tuple[dict[int, float], ...], ...] = (
    ({1: 0.25, 3: 0.29, 5: 0.31, 10: 0.35, 120: 0.43}, {1: 0.05, 3: 0.11, 5: 0.115, 10: 0.12, 120: 0.3}),
    ({1: 0.24, 3: 0.31, 5: 0.34, 10: 0.355, 120: 0.43}, {1: 0.17, 3: 0.24, 5: 0.27, 10: 0.29, 120: 0.3}),
    (
        {1: 0.255, 3: 0.345, 5: 0.375, 10: 0.43, 120: 0.455},
        {1: 0.145, 3: 0.235, 5: 0.25, 10: 0.305, 120: 0.39},
        {1: 0.185, 3: 0.27, 5: 0.305, 10: 0.36, 120: 0.45},
    ),
)
"""For each `EmbeddingSizes.version`: number of views of an object -> score that 95 % of the correct answers reach, for
the default threshold. The entries of a version are for embeddings without reference views, with them, and with those of
background objects only. Up to 10 views are from held-out frames, 120 from meshes."""

KEPT_WITH_SURFACE = 0.39
"""Score that 95 % of the correct answers for objects with a surface reach, in held-out frames."""

TOYS = frozenset(
    ("apple banana cereal_box_blue cereal_box_yellow hammer mug_blue mug_white screwdriver soup_can_green soup_can_red "
     "sponge tennis_ball white_bowl white_cup white_plate wooden_spoon yellow_bottle yellow_box").split()
)  # fmt: skip
"""The built-in objects, the classes of the demo's model."""

EVEN, STEEPNESS = 0.2, 3
"""A score s has the odds (s / EVEN) ** STEEPNESS against everything that is not enrolled; chosen on held-out frames."""

TINY = 1e-6
"""Probabilities that an object is unknown are clipped to at least this value."""


@dataclasses.dataclass(frozen=True, eq=False)
class GalleryObject:
    """The views of an enrolled object.

    Attributes:
        embeddings: [E, D] float16 of unit length: several looks at each view, and its augmented copies.
        clouds: the views as they were enrolled.
        source: source of the views: "mesh", "frames" or "mesh and frames".
        date: date of the last enrollment, ISO 8601.
        surface: `Surfaces.arrays` of its mesh; None without a mesh, and for objects of earlier versions.
        file: name of its file in the gallery on disk; None until it is written.
    """

    embeddings: NDArray[np.float16]
    clouds: CompactClouds
    source: str
    date: str
    surface: Mapping[str, NDArray[Any]] | None = None
    file: str | None = None

    def __add__(self, other: "GalleryObject") -> "GalleryObject":
        return GalleryObject(
            np.concatenate([self.embeddings, other.embeddings]),
            self.clouds + other.clouds,
            self.source if self.source == other.source else "mesh and frames",
            other.date,
            other.surface or self.surface,
        )


Values = NDArray[np.floating[Any]]


def _score_odds(scores: NDArray[Any]) -> NDArray[Any]:
    """Return the odds of scores against everything that is not enrolled."""
    return np.asarray((scores / EVEN) ** STEEPNESS)


def known_probability(confidence: Any, share: Any) -> Any:
    """Return the probability that an object is known, from the confidence of its best class and its gallery share."""
    return (confidence + share) / (1 + share)


@dataclasses.dataclass(frozen=True, eq=False)
class Gallery:
    """Enrolled objects; an immutable value.

    Attributes:
        embedding: fingerprint of the embedding of the views.
        objects: name -> its views, in the order of enrollment.
        trained: class names of the run, in the order of the classifiers' outputs.
        hidden: trained classes that were forgotten or replaced; the classifiers' outputs for them are ignored.
        references: reference views of the embedding; None if it has none.
        embedding_version: version of the embedding, see `EmbeddingSizes`.
        search: kind of search, "exact" or "usearch". An index answers queries among millions of views in milliseconds,
            but is built again, in minutes, after every change.
        generation: number of changes on disk so far.
        stamp: `store.gallery_stamp` of this state; None if the gallery is not on disk.
    """

    embedding: str
    objects: Mapping[str, GalleryObject] = dataclasses.field(default_factory=dict)
    hidden: tuple[str, ...] = ()
    trained: tuple[str, ...] = ()
    search: str = "exact"
    references: "References | None" = None
    embedding_version: int = 0
    generation: int = 0
    stamp: tuple[int, int, int] | None = None

    def __post_init__(self) -> None:
        if self.search not in ("exact", "usearch"):
            raise InputError(f"search is {self.search!r}; expected 'exact' or 'usearch'")

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields without cached properties, to send the gallery to another process."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects, in the order of the scores."""
        return tuple(self.objects)

    def name_to_enroll(self, name: str, *, extend: bool, replace: bool) -> str:
        """Return the name under which `with_object` adds views; the arguments and errors are those of `with_object`."""
        known = find_name(name, (*self.objects, *self.trained)) or check_name(name)
        if extend and replace:
            raise InputError("extend and replace are both given; choose one")
        if not (extend or replace) and (known in self.objects or self._is_answered_class(known)):
            state = "enrolled already" if known in self.objects else "a trained class"
            raise InputError(f"name: {known!r} is {state}; add views to it (extend) or replace it (replace)")
        return known

    def with_object(
        self, name: str, enrolled: GalleryObject, *, extend: bool = False, replace: bool = False
    ) -> "Gallery":
        """Return the gallery with a further object.

        Args:
            name: name of the object.
            enrolled: its views.
            extend: add the views to an existing object or to a trained class.
            replace: discard the views of an existing object, and hide a trained class with this name.

        Raises:
            InputError: the name exists and neither `extend` nor `replace` is given, or both are; also as `check_name`.
        """
        name = self.name_to_enroll(name, extend=extend, replace=replace)
        if name in self.objects and extend:
            enrolled = self.objects[name] + enrolled
        hidden = (*self.hidden, name) if replace and self._is_answered_class(name) else self.hidden
        objects = {**self.objects, name: dataclasses.replace(enrolled, file=None)}
        return dataclasses.replace(self, objects=objects, hidden=hidden)

    def without(self, name: str) -> "Gallery":
        """Return the gallery without an object, and with a trained class of this name hidden (no longer predicted).

        Raises:
            InputError: no object and no class has the name.
        """
        name = find_name(name, (*self.objects, *self.trained)) or name
        is_class = self._is_answered_class(name)
        if name not in self.objects and not is_class:
            close = first_names(difflib.get_close_matches(str(name), self.answered_names)) or self.summary
            raise InputError(f"name: {name!r} is unknown; expected a name that this model recognizes: {close}")
        objects = {other: enrolled for other, enrolled in self.objects.items() if other != name}
        return dataclasses.replace(self, objects=objects, hidden=(*self.hidden, name) if is_class else self.hidden)

    def _is_answered_class(self, name: str) -> bool:
        return name in self.trained and name not in self.hidden

    @functools.cached_property
    def regression(self) -> tuple[NDArray[np.float16], NDArray[np.intp], NDArray[np.float64]]:
        """Embeddings [N, D] of all views, and for each view the number of its owner and its regularization.

        Owners are the objects, the trained classes and the background. The regularization keeps owners with many views
        from outweighing those with few. Views of a trained class belong to the enrolled object with its name, if there
        is one, and views of a forgotten class to the background.
        """
        embeddings = [enrolled.embeddings for enrolled in self.objects.values()]
        counts = np.array([len(each) for each in embeddings], np.float64)
        owner = np.repeat(np.arange(len(counts)), counts.astype(int))
        if self.references is not None:
            number, background = {name: k for k, name in enumerate(self.names)}, self._n_owners - 1
            of_class = [
                background if name in self.hidden else number.get(name, len(counts) + k)
                for k, name in enumerate(self.references.classes)
            ]
            of_label = np.array([*of_class, background])  # the label BACKGROUND is -1
            owner = np.concatenate([owner, of_label[self.references.label]])
            embeddings.append(self.references.embeddings)
            counts = np.append(counts, np.full(self._n_owners - len(counts), counts.mean()))
        of_owner = counts[owner]
        return np.concatenate(embeddings), owner, RIDGE * of_owner / of_owner.mean()

    @property
    def _n_owners(self) -> int:
        return len(self.objects) + (0 if self.references is None else len(self.references.classes) + 1)

    @functools.cached_property
    def unknown_below(self) -> NDArray[np.float64]:
        """Default thresholds [n_objects]: the lowest confidence of an answer with the name of each object.

        They follow from `KEPT_WITH_SURFACE`. For objects without a surface, they follow from scores that are
        interpolated in `KEPT`, linearly in the logarithm of the number of views.
        """
        views = [len(enrolled.clouds) for enrolled in self.objects.values()]
        entries = KEPT[self.embedding_version]
        kept = entries[0] if self.references is None else entries[1 if self.references.classes else -1]
        scores = np.interp(np.log(views), np.log(list(kept)), list(kept.values()))
        scores[[each.surface is not None for each in self.objects.values()]] = KEPT_WITH_SURFACE
        odds = _score_odds(scores)
        return (odds / (1 + odds)).round(3)

    @functools.cached_property
    def _search(self) -> ExactSearch | IndexSearch:
        return (IndexSearch if self.search == "usearch" else ExactSearch)(self.regression[0])

    def scores(self, embeddings: ArrayLike) -> NDArray[np.float32]:
        """Return the scores [B, n_objects] of each object, from 0 to 1, in the order of `names`.

        A score is v * v / (v + w), where v is the value of the regression for the object, and w the largest value for a
        trained class (0 without references).

        Args:
            embeddings: [B, D] of unit length, or [B, K, D] for K looks, whose scores are averaged.
        """
        queries = np.asarray(embeddings, np.float32)
        if not self.objects or not len(queries):
            return np.zeros((len(queries), len(self.objects)), np.float32)
        if queries.ndim == 3:
            each = self.scores(queries.reshape(-1, queries.shape[-1])).reshape(*queries.shape[:2], -1)
            return each.mean(axis=1)
        similarity, index = self._search.nearest(queries, NEAREST)
        embeddings, owner, ridge = self.regression
        views = embeddings[index].astype(np.float32)
        with one_blas_thread():
            kernel = np.exp(GAMMA * (views @ views.transpose(0, 2, 1) - 1)).astype(np.float64)
            kernel[:, np.arange(kernel.shape[1]), np.arange(kernel.shape[1])] += ridge[index]
            duals = np.linalg.solve(kernel, np.exp(GAMMA * (similarity.astype(np.float64) - 1))[..., None])[..., 0]
        values = np.zeros((len(queries), self._n_owners))
        np.add.at(values, (np.arange(len(queries))[:, None], owner[index]), duals)
        scores, trained = values[:, : len(self.objects)].clip(0, 1), values[:, len(self.objects) : -1]
        if trained.shape[1]:
            scores *= scores / np.maximum(scores + trained.max(axis=1, keepdims=True).clip(0), 1e-12)
        return scores.astype(np.float32)

    @functools.cached_property
    def surfaces(self) -> "dict[int, Surfaces]":
        """The surfaces of those objects that were enrolled with a mesh, by the number of the object."""
        from thor2_jax.surfaces.surfaces import Surfaces  # imports JAX, which a list of the objects does not need

        return {k: Surfaces.of_arrays(each.surface) for k, each in enumerate(self.objects.values()) if each.surface}

    def with_evidence(self, scores: NDArray[np.float32], samples: "Sample") -> NDArray[np.float32]:
        """Return scores [B, n_objects], changed by the evidence of the surfaces, see `surfaces.evidence`.

        The probability of an object is its share of the odds of all objects with a surface and of 1. If a changed score
        exceeds 1, those of all objects with a surface are divided by it. Other objects keep their scores.
        """
        from thor2_jax.surfaces.evidence import with_evidence_on_host

        number, surfaces = list(self.surfaces), list(self.surfaces.values())
        odds = _score_odds(scores[:, number].astype(np.float64))
        known = with_evidence_on_host(odds / (1 + odds.sum(axis=1, keepdims=True)), surfaces, samples)
        odds = known / np.maximum(1 - known.sum(axis=1, keepdims=True), TINY)
        changed = EVEN * odds ** (1 / STEEPNESS)
        result = scores.copy()
        result[:, number] = changed / np.maximum(changed.max(axis=1, keepdims=True), 1)
        return result

    @functools.cached_property
    def _outputs(self) -> tuple[str | None, ...]:
        """The name of each output of the classifiers; None for hidden classes."""
        return tuple(None if name in self.hidden else name for name in self.trained)

    @functools.cached_property
    def answered_names(self) -> tuple[str, ...]:
        """All names that may be answered: trained classes that are not hidden, then further objects."""
        return tuple(dict.fromkeys(name for name in (*self._outputs, *self.names) if name is not None))

    @functools.cached_property
    def has_output(self) -> NDArray[np.bool_]:
        """[n] bool, whether the classifiers have an output for each of `answered_names`."""
        return np.array([self._is_answered_class(name) for name in self.answered_names], bool)

    @functools.cached_property
    def summary(self) -> str:
        """The names as a phrase, such as "21 objects: mug, bowl, ..., cup"."""
        toys = [name for name in self.answered_names if name in TOYS] if set(self.trained) == TOYS else []
        own = [name for name in self.answered_names if name not in toys]
        listed = first_names(own)
        if toys:
            others = f", and {listed}" if own else "; none of yours"
            return f"{len(toys)} toy objects of the demo{others}"
        return f"{len(own)} {'objects' if len(own) != 1 else 'object'}: {listed}" if own else "no object yet"

    def of_classifiers(self, probabilities: Values) -> Values:
        """Return class probabilities [B, C] in the order of `answered_names` [B, n]; 0 for names without an output."""
        return self._spread(probabilities, self._outputs)

    def of_gallery(self, scores: Values) -> Values:
        """Return scores [B, n_objects] in the order of `answered_names` [B, n]; 0 for names without views."""
        return self._spread(scores, self.names)

    def _spread(self, values: Values, owners: tuple[str | None, ...]) -> Values:
        column = {name: index for index, name in enumerate(owners)}
        padded = np.concatenate([values, np.zeros((len(values), 1), values.dtype)], axis=1)
        return np.take(padded, [column.get(name, -1) for name in self.answered_names], axis=1)

    def combine(self, probabilities: Values | None, scores: Values) -> Values:
        """Combine the confidences of the classifiers with the scores of the gallery.

        Each name gets a share. The share of a trained class is its confidence. The share of an enrolled object is 1 - c
        times the odds of its score, where c is the largest confidence of a class; a class with enrolled views gets the
        sum of both. The name with the largest share is the answer. Its value is c if its share is not larger than c.
        Otherwise it is `known_probability(c, m)`, where m is the largest share of an enrolled object. The values of the
        other names are proportional to their shares. So an enrolled object is the answer only if its score is high.

        Args:
            probabilities: [B, C] fused probabilities; None if the gallery alone answers.
            scores: [B, n_objects] scores of the gallery.

        Returns:
            [B, n] from 0 to 1, in the order of `answered_names`; they need not sum to 1.
        """
        nothing: Values = np.zeros((len(scores), len(self.answered_names)))
        trained = nothing if probabilities is None else self.of_classifiers(probabilities)
        c = trained.max(axis=1, keepdims=True, initial=0)
        # Without a score, an object still comes before a class that neither has views nor an output.
        odds = np.maximum(_score_odds(scores), np.finfo(np.float32).tiny)
        enrolled = (1 - c).clip(0) * self.of_gallery(odds)
        shares, m = trained + enrolled, enrolled.max(axis=1, keepdims=True, initial=0)
        largest = shares.max(axis=1, keepdims=True, initial=0)
        value = np.where(largest > c, known_probability(c, m), c)
        return shares / np.maximum(largest, np.finfo(np.float32).tiny) * value
