"""Class scores: the quantity that an explanation explains, as a differentiable function of descriptors.

An answer of the classifiers is explained by its log-odds, an answer of a gallery by its similarity to the enrolled
views. Both are fused over the looks at an instance, as in recognition. If the paper's classifiers choose the answer,
the embedding determines only the confidence and is not explained.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.capacity import batch_points
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.looks import LookDescriptors, aligned_looks, describe_aligned_looks, describe_looks
from thor2_jax.errors import InputError
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.gallery.enrollment import LOOKS
from thor2_jax.model.fusion import fused_probabilities
from thor2_jax.model.inference import infer
from thor2_jax.model.model import Model
from thor2_jax.networks.networks import EMBEDDING
from thor2_jax.types import PointClouds, Strips, matmul

__all__ = ["ClassScores", "classifier_scores", "gallery_scores"]

ROWS = 8
"""Number of versions of a cloud that are described in one call."""


@dataclasses.dataclass(frozen=True, eq=False)
class ClassScores:
    """Scores of all names that an answer can have.

    Attributes:
        names: n names.
        unit: "log-odds": the scores are fused log-probabilities; "similarity": cosines with the nearest enrolled view.
        config: descriptor, in closed form.
        network: colour network of the descriptor.
        count: number K of looks.
        of_descriptors: function of the descriptors of B clouds, from `describe`, that returns scores [B, n];
            differentiable.
    """

    names: tuple[str, ...]
    unit: Literal["log-odds", "similarity"]
    config: DescriptorConfig
    network: ColorNetwork
    count: int
    of_descriptors: Callable[[LookDescriptors], jax.Array]

    def margin(self, scores: jax.Array, index: int) -> jax.Array:
        """Return the margins [B] of the name `index` from scores [B, n], the quantity that is explained.

        For classifiers, the margin is the log-odds log(p / (1 - p)) of the name; for a gallery, it is the difference to
        the score of the most similar other object. If there is only one name, the margin is its score.
        """
        own, others = scores[:, index], jnp.delete(scores, index, axis=1, assume_unique_indices=True)
        if not others.shape[1]:
            return own
        return own - (jax.nn.logsumexp(others, axis=1) if self.unit == "log-odds" else others.max(axis=1))

    def orient(self, instance: PreparedInstance) -> PointClouds:
        """Return the K looks at an instance, [K, N] aligned clouds, the paper's look first; each has its own mask."""
        return jax.tree.map(lambda a: a[: self.count], aligned_looks(packed(instance), self.config, self.count))

    def of_instances(self, instances: Sequence[PreparedInstance]) -> NDArray[np.float32]:
        """Return the scores [B, n] of instances, each in its own frames, as in recognition."""
        capacity = batch_points(len(instance.points) for instance in instances)

        def describe(rows: Sequence[PreparedInstance]) -> LookDescriptors:
            clouds = pack_instances(rows, ROWS, capacity)
            return self._complete(describe_looks(clouds, self.network, self.config, self.count), clouds)

        return self._of_rows(instances, describe)

    def of_masks(self, looks: PointClouds, masks: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Return the exact scores [B, n] of parts of a cloud in the frames of the whole cloud.

        Args:
            looks: [K, N] looks at the cloud, from `orient`.
            masks: [B, n] bool, points of each part.
        """
        repeated = repeat_cloud(looks, ROWS)

        def describe(rows: NDArray[np.bool_]) -> LookDescriptors:
            padded = np.pad(rows, ((0, ROWS - len(rows)), (0, repeated.mask.shape[1] - rows.shape[1])))
            part = dataclasses.replace(repeated, mask=repeated.mask & jnp.repeat(padded, self.count, axis=0))
            return self.describe(part, strips(part, self.network, self.config), self.config)

        return self._of_rows(masks, describe)

    def describe(self, aligned: PointClouds, cut: Strips, config: DescriptorConfig) -> LookDescriptors:
        """Return the descriptors for `of_descriptors`; the arguments are those of `describe_aligned_looks`."""
        first: PointClouds = jax.tree.map(lambda a: a[:: self.count], aligned)
        return self._complete(describe_aligned_looks(aligned, cut, self.network, config, self.count), first)

    def _complete(self, oriented: LookDescriptors, clouds: PointClouds) -> LookDescriptors:
        """Add what only galleries read: the programs of classifiers are those of recognition without it."""
        return oriented.with_balanced(clouds) if self.unit == "similarity" else oriented

    def _of_rows(self, items: Any, describe: Callable[[Any], LookDescriptors]) -> NDArray[np.float32]:
        """Return the scores [B, n] of items, described `ROWS` at a time."""
        starts = range(0, max(len(items), 1), ROWS)
        scores = [np.asarray(self.of_descriptors(describe(items[k : k + ROWS]))) for k in starts]
        return np.concatenate(scores)[: len(items)]


def packed(instance: PreparedInstance) -> PointClouds:
    """Return an instance as the first of `ROWS` clouds in metres, of which the others are empty.

    Recognition has compiled its programs for this size.
    """
    return pack_instances([instance], ROWS, batch_points([len(instance.points)]))


def repeat_cloud(aligned: PointClouds, times: int) -> PointClouds:
    """Repeat the K looks at a cloud, [K, N] to [times * K, N]."""
    return jax.tree.map(lambda a: jnp.tile(a, (times,) + (1,) * (a.ndim - 1)), aligned)


def _checked(config: DescriptorConfig) -> DescriptorConfig:
    if config.convention != "paper":
        raise InputError(
            f"the descriptor's convention is {config.convention!r}; explanations need 'paper', whose slices and strips "
            "have gradients"
        )
    # The closed form computes the same pairs as gudhi without a host callback.
    return dataclasses.replace(config, homology="closed_form", relaxation=None)


def classifier_scores(model: Model) -> ClassScores:
    """Return the fused log-probabilities of the classifiers for all classes that have not been forgotten.

    Raises:
        InputError: the run's descriptor has the convention of the released code.
    """
    default = model.chosen_classifiers()
    names = tuple(name for name in default if name != EMBEDDING) or default
    classes, hidden = model.run.classes, set(model.gallery.hidden)
    columns = np.array([k for k, name in enumerate(classes) if name not in hidden], int)

    def of_descriptors(oriented: LookDescriptors) -> jax.Array:
        fused = fused_probabilities(infer(model, oriented, classifiers=names).probabilities, model.rule)
        return jnp.log(jnp.maximum(fused, np.finfo(np.float32).tiny))[:, columns]

    config = _checked(model.run.config)
    shown = tuple(classes[k] for k in columns)
    return ClassScores(shown, "log-odds", config, model.run.network, config.looks, of_descriptors)


def gallery_scores(model: Model) -> ClassScores:
    """Return the similarity of clouds to the enrolled objects: the cosine with the nearest view of each object.

    Args:
        model: model with at least one enrolled object.

    Raises:
        InputError: the embedding's descriptor has the convention of the released code.
    """
    objects = model.gallery.objects
    embedding, each = model.embedding, [views.embeddings for views in objects.values()]
    views: Any = jnp.asarray(np.concatenate(each), jnp.float32)
    ends = np.cumsum([len(one) for one in each])

    def of_descriptors(oriented: LookDescriptors) -> jax.Array:
        first: LookDescriptors = jax.tree.map(lambda a: a[:, :LOOKS], oriented)
        cosines = jnp.split(matmul(embedding.embed_oriented(first), views.T), ends[:-1], axis=-1)
        nearest = jnp.stack([of_object.max(axis=-1) for of_object in cosines], axis=-1)
        return nearest.mean(axis=1)

    count = max(model.run.config.looks, LOOKS)  # as `infer`
    config = _checked(embedding.config)
    return ClassScores(tuple(objects), "similarity", config, embedding.network, count, of_descriptors)
