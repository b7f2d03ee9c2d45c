"""Nearest views: the enrolled views that an instance resembles most."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from thor2_jax.explanation.class_scores import gallery_scores
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.gallery.embedding import Embedding
from thor2_jax.gallery.enrollment import ROWS, embed_looks
from thor2_jax.model.model import Model

__all__ = ["NearestView", "nearest_views"]

OBJECTS = 3
"""Objects of which the nearest view is shown."""


@dataclasses.dataclass(frozen=True, eq=False)
class NearestView:
    """An enrolled view.

    Attributes:
        name: name of the object.
        number: number of the view among those of the object, in the order of enrolment.
        similarity: largest cosine of the embeddings of the looks at both, at most 1.
        view: its cloud.
    """

    name: str
    number: int
    similarity: float
    view: PreparedInstance


def _embedded(embedding: Embedding, views: Sequence[PreparedInstance]) -> Iterator[NDArray[np.float32]]:
    """Yield the embeddings [K, D] of each view."""
    for start in range(0, len(views), ROWS):
        chunk = views[start : start + ROWS]
        yield from np.asarray(embed_looks(embedding, pack_instances(chunk, ROWS)))[: len(chunk)]


def nearest_views(model: Model, instance: PreparedInstance) -> list[NearestView]:
    """Return the nearest view of each of the most similar enrolled objects, the most similar one first.

    Args:
        model: its gallery may be empty; the result then is, too.
        instance: the instance.
    """
    objects = model.gallery.objects
    if not objects:
        return []
    embedding = model.embedding
    scores = gallery_scores(model).of_instances([instance])[0]
    (query,) = _embedded(embedding, [instance])
    nearest = []
    for index in np.argsort(-scores, kind="stable")[:OBJECTS]:
        name = model.gallery.names[index]
        views = list(objects[name].clouds.views())
        cosines = np.array([(query @ one.T).max() for one in _embedded(embedding, views)])
        number = int(cosines.argmax())
        nearest.append(NearestView(name, number, float(cosines[number]), views[number]))
    return sorted(nearest, key=lambda one: -one.similarity)
