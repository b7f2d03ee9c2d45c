"""Class scores: the quantity that an explanation explains, as a differentiable function of descriptors.

An answer of the classifiers is explained by its log-odds, an answer of a gallery by its similarity to the enrolled
views. Both are fused over the looks at an instance, as in recognition. If the paper's classifiers choose the answer,
the embedding determines only the confidence and is not explained.
"""

import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from numpy.typing import NDArray
from scipy.special import logsumexp

from colornet import ColorNetwork
from thor2_jax.capacity import batch_points
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.looks import LookDescriptors, aligned_looks, describe_aligned_looks
from thor2_jax.errors import InputError
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.gallery.enrollment import LOOKS
from thor2_jax.model.fusion import FusionRule, fused_probabilities
from thor2_jax.model.model import Model
from thor2_jax.networks.networks import EMBEDDING, Classifier
from thor2_jax.types import PointClouds, Strips, matmul

__all__ = ["ClassScores", "classifier_scores", "gallery_scores", "jit_gradient"]

ROWS = 8
"""Number of versions of a cloud that are described in one call."""

LEVEL = {} if "optimization_level" in os.environ.get("XLA_FLAGS", "") else {"xla_backend_optimization_level": 1}
jit_gradient = partial(jax.jit, compiler_options={"xla_cpu_use_fusion_emitters": False, **LEVEL})
"""Compiles gradients in half of the time of `jax.jit`; they take little longer. XLA_FLAGS may set another level."""

MIN_VIEWS = 256
"""Smallest number of enrolled views after padding, which is a power of two."""


@dataclasses.dataclass(frozen=True, eq=False)
class ClassScores:
    """Scores of all names that an answer can have.

    Attributes:
        unit: "log-odds": the scores are fused log-probabilities; "similarity": cosines with the nearest enrolled view.
        config: descriptor, in closed form.
        network: colour network of the descriptor.
        count: number K of looks.
        of_descriptors: function of the descriptors of B clouds, from `describe`, that returns scores [B, m], of which
            the first n belong to the names; differentiable, a pytree.
        names: n names.
    """

    unit: Literal["log-odds", "similarity"]
    config: DescriptorConfig
    network: ColorNetwork
    count: int
    of_descriptors: Callable[[LookDescriptors], jax.Array]
    names: tuple[str, ...] = ()

    def margin(self, scores: Any, index: Any) -> Any:
        """Return the margins [B] of the name `index` from scores [B, n], the quantity that is explained.

        For classifiers, the margin is the log-odds log(p / (1 - p)) of the name; for a gallery, it is the difference to
        the score of the most similar other object. If there is only one name, the margin is its score. NumPy arrays
        give a NumPy array, and compile nothing.
        """
        xp, sum_of = (np, logsumexp) if isinstance(scores, np.ndarray) else (jnp, jax.nn.logsumexp)
        own, n = scores[:, index], scores.shape[1]
        others = xp.where(np.arange(n) == index, -np.inf if n > 1 else 0, scores)
        return own - (sum_of(others, axis=1) if self.unit == "log-odds" else others.max(axis=1))

    def orient(self, instance: PreparedInstance) -> PointClouds:
        """Return the K looks at an instance, [K, N] aligned clouds, the paper's look first; each has its own mask."""
        every = aligned_looks(next(packed([instance])), self.config, self.count)
        return jax.tree.map(lambda a: np.asarray(a)[: self.count], every)

    def repeat(self, looks: PointClouds, times: int = ROWS) -> PointClouds:
        """Repeat the K looks at a cloud, [K, N] to [times * K, N]."""
        return jax.tree.map(lambda a: a[None].repeat(times, axis=0).reshape(-1, *a.shape[1:]), looks)

    def of_instances(self, instances: Sequence[PreparedInstance]) -> NDArray[np.float32]:
        """Return the scores [B, n] of instances, each in its own frames, as in recognition."""
        rows = (aligned_looks(row, self.config, self.count) for row in packed(instances))
        return self._of_rows(rows, len(instances))

    def of_masks(self, looks: PointClouds, masks: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Return the exact scores [B, n] of parts of a cloud in the frames of the whole cloud.

        Args:
            looks: [K, N] looks at the cloud, from `orient`.
            masks: [B, n] bool, points of each part.
        """
        repeated, (n_parts, n_points) = self.repeat(looks), masks.shape
        padded = np.pad(masks, ((0, -n_parts % ROWS), (0, repeated.mask.shape[1] - n_points)))
        rows = padded.repeat(self.count, axis=0).reshape(-1, *repeated.mask.shape)
        parts = (dataclasses.replace(repeated, mask=repeated.mask & row) for row in rows)
        return self._of_rows(parts, n_parts)

    def describe(self, aligned: PointClouds, cut: Strips, config: DescriptorConfig) -> LookDescriptors:
        """Return the descriptors for `of_descriptors`; the arguments are those of `describe_aligned_looks`."""
        oriented = describe_aligned_looks(aligned, cut, self.network, config, self.count)
        # Only galleries read the balanced histogram; without it, classifiers use the programs of recognition.
        if self.unit == "log-odds":
            return oriented
        return oriented.with_balanced(jax.tree.map(lambda a: a[:: self.count], aligned))

    def _of_rows(self, rows: Iterable[PointClouds], count: int) -> NDArray[np.float32]:
        """Return the exact scores [B, n] of the first B clouds from their looks, for `ROWS` clouds at a time."""
        described = (self.describe(row, strips(row, self.network, self.config), self.config) for row in rows)
        scores = [np.asarray(self.of_descriptors(each)) for each in described]
        return np.concatenate(scores)[:count, : len(self.names)]


# The functions that are compiled for it do not depend on the names.
jax.tree_util.register_dataclass(ClassScores, ["of_descriptors"], ["unit", "config", "network", "count"], ["names"])


def packed(instances: Sequence[PreparedInstance]) -> Iterator[PointClouds]:
    """Yield instances as batches of `ROWS` clouds in metres; in the last one, empty clouds follow.

    Recognition has compiled its programs for this size.
    """
    capacity = batch_points(len(instance.points) for instance in instances)
    for start in range(0, max(len(instances), 1), ROWS):
        yield pack_instances(instances[start : start + ROWS], ROWS, capacity)


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

    config = _checked(model.run.config)
    of_descriptors = Partial(_log_probabilities(model.rule), {name: model.classifiers[name] for name in names}, columns)
    shown = tuple(classes[k] for k in columns)
    return ClassScores("log-odds", config, model.run.network, config.looks, of_descriptors, shown)


@cache  # so that equal functions are identical, and compile once
def _log_probabilities(rule: FusionRule) -> Callable[..., jax.Array]:
    def scores(classifiers: Mapping[str, Classifier], columns: Any, oriented: LookDescriptors) -> jax.Array:
        fused = fused_probabilities({name: each(oriented) for name, each in classifiers.items()}, rule)
        return jnp.log(jnp.maximum(fused, np.finfo(np.float32).tiny))[:, columns]

    return scores


def gallery_scores(model: Model) -> ClassScores:
    """Return the similarity of clouds to the enrolled objects: the cosine with the nearest view of each object.

    Args:
        model: model with at least one enrolled object.

    Raises:
        InputError: the embedding's descriptor has the convention of the released code.
    """
    objects = model.gallery.objects
    embedding, each = model.embedding, [views.embeddings for views in objects.values()]
    views, owners = np.concatenate(each), np.repeat(np.arange(len(each)), [len(one) for one in each])
    # The last view is repeated up to one of few sizes, which compile few programs.
    padded = np.arange(max(MIN_VIEWS, 1 << len(views).bit_length())).clip(max=len(views) - 1)
    of_descriptors = Partial(_similarities, embedding.embed_described, views[padded].astype(np.float32), owners[padded])
    count = max(model.run.config.looks, LOOKS)  # as `infer`
    config = _checked(embedding.config)
    return ClassScores("similarity", config, embedding.network, count, of_descriptors, tuple(objects))


def _similarities(embed: Any, views: Any, owners: Any, oriented: LookDescriptors) -> jax.Array:
    embeddings = embed(jax.tree.map(lambda a: a[:, :LOOKS], oriented))
    cosines = jnp.moveaxis(matmul(embeddings, views.T), -1, 0)
    nearest = jax.ops.segment_max(cosines, owners, len(owners), indices_are_sorted=True)
    return jnp.maximum(nearest, -2).mean(axis=-1).T  # finite without views, and less than any cosine
