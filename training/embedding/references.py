"""Choose and embed the reference views of an embedding from the samples that it was fitted on."""

import numpy as np
from numpy.typing import NDArray

from thor2_jax.gallery.embedding import Embedding
from thor2_jax.gallery.references import BACKGROUND, References
from training.embedding.fit import batch_looks
from training.embedding.samples import Samples

__all__ = ["reference_views"]

BACKGROUND_VIEWS = 4096
"""Views of the background; docs/decisions.md says why."""

VIEWS_OF_CLASS = 64
"""Views of each class, fewer if all classes have more than `BACKGROUND_VIEWS` together."""

BATCH = 256


def reference_views(embedding: Embedding, samples: Samples, seed: int = 0) -> References:
    """Return the embedded reference views of an embedding.

    Args:
        embedding: the embedding.
        samples: those that it was fitted on; the first labels are those of its classes.
        seed: seed for the choice of the views.
    """
    rng, n_classes = np.random.default_rng(seed), len(embedding.classes)
    per_class = min(VIEWS_OF_CLASS, BACKGROUND_VIEWS // max(n_classes, 1))
    chosen = [_choose(samples.label == label, per_class, rng) for label in range(n_classes)]
    rows = np.concatenate([*chosen, _choose(samples.label >= n_classes, BACKGROUND_VIEWS, rng)])
    looks = (batch_looks(batch, embedding.network, embedding.config) for batch in samples.batches(rows, BATCH))
    chunks = [embedding.embed_oriented(batch)[:, 0] for batch in looks]
    label = samples.label[rows]
    return References(
        np.concatenate(chunks)[: len(rows)].astype(np.float16),
        np.where(label < n_classes, label, BACKGROUND).astype(np.int32),
        embedding.classes,
    )


def _choose(allowed: NDArray[np.bool_], count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    rows = np.flatnonzero(allowed)
    return np.sort(rng.permutation(rows)[:count])
