"""The compiled answer of a gallery; its entropy measures how well the colours of a camera fit it."""

import jax
import jax.numpy as jnp
import numpy as np

from thor2_jax.descriptor.looks import LookDescriptors
from thor2_jax.gallery.embedding import Embedding
from thor2_jax.gallery.gallery import GAMMA, RIDGE, Gallery
from thor2_jax.model.classifier import Classifier

__all__ = ["MAX_VIEWS", "gallery_classifier"]

MAX_VIEWS = 1024
"""Views of a gallery that answer at most, evenly spread; the regression is solved for all of them at once."""


def gallery_classifier(gallery: Gallery, embedding: Embedding) -> Classifier:
    """Return the classifier whose probabilities are the scores of a gallery, divided by their sum if it exceeds 1.

    Reference views take no part: what matters is which colours make the scores certain, not whether objects are known.

    Args:
        gallery: a gallery with at least one object.
        embedding: the embedding of its views.
    """
    objects = list(gallery.objects.values())
    counts = np.array([len(each.embeddings) for each in objects])
    owner = np.repeat(np.arange(len(objects)), counts)
    kept = np.unique(np.linspace(0, len(owner) - 1, min(len(owner), MAX_VIEWS)).round().astype(int))
    views = np.concatenate([each.embeddings for each in objects])[kept].astype(np.float64)
    ridge = RIDGE * counts[owner[kept]] / counts[owner].mean()
    kernel = np.exp(GAMMA * (views @ views.T - 1)) + np.diag(ridge)
    duals = jnp.asarray(np.linalg.solve(kernel, np.eye(len(objects))[owner[kept]]), jnp.float32)
    fixed = jnp.asarray(views, jnp.float32)

    def classify(oriented: LookDescriptors) -> jax.Array:
        embedded = embedding.embed_oriented(oriented)
        scores = jnp.clip(jnp.exp(GAMMA * (embedded @ fixed.T - 1)) @ duals, 0, 1)
        mean = (oriented.weights[..., None] * scores).sum(axis=1)
        return mean / jnp.maximum(mean.sum(axis=1, keepdims=True), 1)

    return classify
