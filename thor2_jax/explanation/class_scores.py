"""Class scores: the quantity that an explanation explains, as a differentiable function of descriptors.

The classifiers' answer is explained by its log-odds, that of a gallery by its similarity to the enrolled views. Both
are fused over the looks at an instance, as recognition fuses them. Where the paper's classifiers choose the answer, the
embedding, which then gives only its confidence, is not explained.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.capacity import point_bucket
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.looks import (
    LookDescriptors,
    aligned_looks,
    describe_aligned_looks,
    describe_looks,
)
from thor2_jax.errors import InputError
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.gallery.embedding import Embedding
from thor2_jax.gallery.enrollment import LOOKS
from thor2_jax.gallery.gallery import GalleryObject
from thor2_jax.model.classifier import EMBEDDING
from thor2_jax.model.fusion import fused_probabilities
from thor2_jax.model.inference import infer
from thor2_jax.model.model import Model
from thor2_jax.types import PointClouds

__all__ = ["ClassScores", "OrientedCloud", "Unit", "classifier_scores", "gallery_scores"]

Unit = Literal["log-odds", "similarity"]

ROWS = 8
"""Variants of a cloud that are described in one call."""

MIN_CAPACITY = 2048
"""Least padded number of points: smaller clouds are hardly faster, and every further size takes long to compile."""


@dataclasses.dataclass(frozen=True, eq=False)
class OrientedCloud:
    """The looks at a cloud, whose frames are held constant.

    Attributes:
        aligned: [K, N] aligned clouds in scaled units, that of the paper first; each has its own mask.
        weights: [K] float32, weights of the looks.
    """

    aligned: PointClouds
    weights: jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class ClassScores:
    """Scores of all names that an instance may have.

    Attributes:
        names: n names.
        unit: "log-odds": the scores are fused log-probabilities; "similarity": cosines with the nearest enrolled view.
        config: descriptor, in closed form.
        network: colour network of the descriptor.
        count: number K of looks.
        of_descriptors: function of the descriptors of B clouds that returns scores [B, n]; differentiable.
    """

    names: tuple[str, ...]
    unit: Unit
    config: DescriptorConfig
    network: ColorNetwork
    count: int
    of_descriptors: Callable[[LookDescriptors], jax.Array]

    def margin(self, scores: jax.Array, index: int) -> jax.Array:
        """Return the margins [B] of the name `index` from scores [B, n], the quantity that is explained.

        For classifiers it is the log-odds log(p / (1 - p)) of the name, for a gallery the difference to the most
        similar other object. A single name has a margin of its own score.
        """
        own, others = scores[:, index], jnp.delete(scores, index, axis=1, assume_unique_indices=True)
        if not others.shape[1]:
            return own
        return own - (jax.nn.logsumexp(others, axis=1) if self.unit == "log-odds" else others.max(axis=1))

    def orient(self, instance: PreparedInstance) -> OrientedCloud:
        """Return the aligned clouds of an instance."""
        aligned, weights = aligned_looks(pack_instances([instance], 1, capacity_of(instance)), self.config, self.count)
        return OrientedCloud(aligned, weights[0])

    def of_instances(self, instances: Sequence[PreparedInstance]) -> NDArray[np.float32]:
        """Return the scores [B, n] of instances, each in its own frames, as recognition computes them."""
        capacity = max(map(capacity_of, instances), default=MIN_CAPACITY)
        scores = [np.zeros((0, len(self.names)), np.float32)]
        for start in range(0, len(instances), ROWS):
            rows = instances[start : start + ROWS]
            packed = pack_instances(rows, ROWS, capacity)
            oriented = describe_looks(packed, self.network, self.config, self.count)
            scores.append(np.asarray(self.of_descriptors(oriented))[: len(rows)])
        return np.concatenate(scores)

    def of_masks(self, cloud: OrientedCloud, masks: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Return the exact scores [B, n] of parts of a cloud; its frames are those of the whole cloud.

        Args:
            cloud: the cloud.
            masks: [B, n] bool, points of each part.
        """
        scores = [np.zeros((0, len(self.names)), np.float32)]
        size = cloud.aligned.mask.shape[1]
        for start in range(0, len(masks), ROWS):
            rows = masks[start : start + ROWS]
            padded = np.zeros((ROWS, size), bool)
            padded[: len(rows), : rows.shape[1]] = rows
            repeated = repeat_cloud(cloud.aligned, ROWS)
            mask = repeated.mask & jnp.repeat(jnp.asarray(padded), self.count, axis=0)
            part = dataclasses.replace(repeated, mask=mask)
            cut = strips(part, self.network, self.config)
            oriented = describe_aligned_looks(part, jnp.tile(cloud.weights, (ROWS, 1)), cut, self.network, self.config)
            scores.append(np.asarray(self.of_descriptors(oriented))[: len(rows)])
        return np.concatenate(scores)


def capacity_of(instance: PreparedInstance) -> int:
    """Return the padded number of points of an instance."""
    return padded_points(len(instance.points))


def padded_points(n_points: int) -> int:
    """Return the padded number of points of an instance with so many."""
    return max(point_bucket(n_points), MIN_CAPACITY)


def repeat_cloud(aligned: PointClouds, times: int) -> PointClouds:
    """Repeat the K looks at a cloud, [K, N] to [times * K, N]."""
    repeated: PointClouds = jax.tree.map(lambda a: jnp.tile(a, (times,) + (1,) * (a.ndim - 1)), aligned)
    return repeated


def _checked(config: DescriptorConfig) -> DescriptorConfig:
    if config.convention != "paper":
        raise InputError(
            f"the descriptor's convention is {config.convention!r}; explanations need 'paper', whose slices and strips "
            "have gradients"
        )
    # The closed form computes the same pairs as gudhi without a host callback.
    return dataclasses.replace(config, homology="closed_form", relaxation=None)


def classifier_scores(model: Model) -> ClassScores:
    """Return the fused log-probabilities of the classifiers, for all classes that are not forgotten.

    Raises:
        InputError: the run's descriptor has the convention of the released code.
    """
    default = model.classifiers.default
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
    """Return the similarity of clouds to the enrolled objects: the cosine with the nearest view of each.

    Raises:
        InputError: no object is enrolled, or the embedding's descriptor has the convention of the released code.
    """
    objects = model.gallery.objects
    if not objects:
        raise InputError("no object is enrolled; enroll one, or train a run")
    embedding = model.embedding
    of_descriptors = _nearest_cosines(embedding, list(objects.values()))
    config = _checked(embedding.config)
    count = max(model.run.config.looks, LOOKS)  # as `infer`
    return ClassScores(tuple(objects), "similarity", config, embedding.network, count, of_descriptors)


def _nearest_cosines(embedding: Embedding, objects: Sequence[GalleryObject]) -> Callable[[LookDescriptors], jax.Array]:
    views: Any = jnp.asarray(np.concatenate([one.embeddings for one in objects]), jnp.float32)
    ends = np.cumsum([len(one.embeddings) for one in objects])
    starts = ends - [len(one.embeddings) for one in objects]

    def of_descriptors(oriented: LookDescriptors) -> jax.Array:
        first: LookDescriptors = jax.tree.map(lambda a: a[:, :LOOKS], oriented)
        cosines = embedding.embed_oriented(first) @ views.T
        nearest = jnp.stack([cosines[..., a:b].max(axis=-1) for a, b in zip(starts, ends, strict=True)], axis=-1)
        return (first.weights[..., None] * nearest).sum(axis=1) / first.weights.sum(axis=1, keepdims=True)

    return of_descriptors
