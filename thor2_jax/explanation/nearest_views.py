"""Nearest views: the enrolled views that an instance resembles most."""

import dataclasses

import numpy as np

from thor2_jax.explanation.class_scores import gallery_scores
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery.enrollment import embed_looks
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


def nearest_views(model: Model, instance: PreparedInstance) -> list[NearestView]:
    """Return the nearest view of each of the most similar enrolled objects, the most similar one first.

    Args:
        model: its gallery may be empty; the result then is, too.
        instance: the instance.
    """
    objects = model.gallery.objects
    if not objects:
        return []
    scores = gallery_scores(model).of_instances([instance])[0]
    query = embed_looks(model.embedding, [instance])[0]
    nearest = []
    for index in np.argsort(-scores, kind="stable")[:OBJECTS]:
        name = model.gallery.names[index]
        views = list(objects[name].clouds.views())
        cosines = (embed_looks(model.embedding, views) @ query.T).max(axis=(1, 2))
        number = int(cosines.argmax())
        nearest.append(NearestView(name, number, float(cosines[number]), views[number]))
    return sorted(nearest, key=lambda one: -one.similarity)
