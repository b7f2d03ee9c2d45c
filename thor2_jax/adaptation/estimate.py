"""Estimation of a camera's colour transform from unlabelled instances, as the mean of its posterior.

The prior is a normal distribution around no change. The likelihood of an instance is exp(-`EVIDENCE` u), where u is the
uncertainty of its answer. With few instances, or if colours do not matter, the estimate therefore stays near no change.

The uncertainty is the entropy over the classes and "none of them", which has the rest of the probability. An object
that is certainly none of the classes therefore does not influence the colours. To keep the estimate from making all
objects unknown, the term -p log(q) is added, where p and q are the probabilities that the object is known before and
after the change.

While frames arrive, `OnlineAdaptation` estimates the transform again from the latest instances, in a thread.
"""

import dataclasses
import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from colornet.colors import LUMA
from thor2_jax.descriptor.looks import LookDescriptors, describe_looks
from thor2_jax.errors import InputError
from thor2_jax.frames.prepared_instance import EMPTY_INSTANCE, PreparedInstance, pack_instances
from thor2_jax.model.fusion import fused_probabilities
from thor2_jax.model.inference import infer
from thor2_jax.model.model import ColorTransform, Model
from thor2_jax.networks.networks import EMBEDDING
from thor2_jax.types import PointClouds

__all__ = ["Adaptation", "OnlineAdaptation", "adaptation_criterion", "estimate_transform"]

ROWS = 8
"""Number of instances that are described in one call."""

LOOKS = 2
"""Number of looks at an instance; further looks have other colours."""

MIN_KNOWN = 1e-3
"""Smallest probability of being known that is distinguished from 0."""


Criterion = Callable[[PointClouds], jax.Array]
"""Function from clouds [B, N] in metres to the probabilities [B, C] of names, which the estimate makes more certain."""


def entropy(probabilities: jax.Array) -> jax.Array:
    """Return the entropy [B] of probabilities [B, C] and of the rest to 1, in nats."""
    rest = jnp.clip(1 - probabilities.sum(axis=-1, keepdims=True), 0, 1)
    every = jnp.clip(jnp.concatenate([probabilities, rest], axis=-1), 1e-12, 1)
    return -(every * jnp.log(every)).sum(axis=-1)


@jax.jit
def transform_colors(parameters: jax.Array, colors: jax.Array) -> jax.Array:
    """Return transformed colours [..., 3] in [0, 1].

    Args:
        parameters: [4], the fields of `ColorTransform` in their order.
        colors: [..., 3] sRGB in [0, 1].
    """
    gamma, gain, saturation, warmth = parameters
    values = colors ** jnp.exp(gamma) * jnp.exp(gain + warmth * jnp.array([1, 0, -1], jnp.float32))
    grey = (values * LUMA).sum(axis=-1, keepdims=True)
    return jnp.clip(grey + jnp.exp(saturation) * (values - grey), 0, 1)


@jax.jit
def _uncertainties(probabilities: jax.Array, known_before: jax.Array) -> jax.Array:
    known = jnp.clip(probabilities.sum(axis=1), MIN_KNOWN, 1)
    return entropy(probabilities) - known_before * jnp.log(known)


def objective(
    instances: Sequence[PreparedInstance], criterion: Criterion, capacity: int | None = None
) -> Callable[[NDArray[np.floating]], float]:
    """Return the sum of the uncertainties of instances as a function of the parameters [4] of a colour transform.

    Args:
        instances: usable instances with the camera's colours.
        criterion: function that computes the probabilities of the names, see `adaptation_criterion`.
        capacity: N, padded number of points of all chunks, so that only one shape is compiled. By default each chunk
            has the point bucket of its largest cloud.
    """
    ordered = sorted(instances, key=lambda each: len(each.points))
    chunks = []
    for start in range(0, len(ordered), ROWS):
        part = ordered[start : start + ROWS]
        clouds = pack_instances(part, ROWS, capacity)
        chunks.append((len(part), clouds, jnp.minimum(criterion(clouds).sum(axis=1), 1)))

    def total(parameters: NDArray[np.floating]) -> float:
        transform = jnp.asarray(parameters, jnp.float32)
        values = []
        for count, clouds, known_before in chunks:
            transformed = dataclasses.replace(clouds, colors=transform_colors(transform, clouds.colors))
            values.append((count, _uncertainties(criterion(transformed), known_before)))
        return float(sum(np.asarray(value)[:count].sum() for count, value in values))

    return total


PRIOR = 0.085
"""Standard deviation of the warmth."""

GRID = np.linspace(-0.36, 0.36, 25)[:, None] * np.array([0.0, 0.0, 0.0, 1.0])
"""[25, 4] transforms over which the mean is taken. Only the warmth differs: in training, brightness, contrast and
saturation vary far more than red against blue, so that a search over all of them would change correct colours."""

MIN_INSTANCES = 10
"""Smallest number of instances; with fewer, the prior would dominate."""

MAX_INSTANCES = 40
"""Largest number of instances in use; more take longer and change little."""

EVIDENCE = 0.5
"""Weight of an instance's uncertainty, since instances of a few objects are not independent. Chosen on real frames."""

Report = Callable[[int, int], None]
"""Function that is called with the number of evaluated colour transforms and the total number."""


@dataclasses.dataclass(frozen=True)
class Adaptation:
    """An estimated colour transform.

    Attributes:
        transform: the colour transform.
        instances: number of instances that it was estimated from.
        uncertainty_before: mean uncertainty of the answers without the transform, nats, as in `objective`.
        uncertainty_after: mean uncertainty with the transform.
    """

    transform: ColorTransform
    instances: int
    uncertainty_before: float
    uncertainty_after: float


def adaptation_criterion(model: Model) -> Criterion:
    """Return the function from clouds to probabilities that an estimate makes more certain.

    It returns the class probabilities of the embedding, which allow for unknown objects; in runs without an embedding,
    those of the classifiers, fused by the model's rule; and if the gallery answers alone, its scores, divided by their
    sum if it exceeds 1.

    Raises:
        InputError: the model has neither classes nor enrolled objects.
    """
    # Reference views are not used, since the colours shall make the scores certain, whether or not objects are known.
    gallery = dataclasses.replace(model.gallery, references=None)

    def fused(oriented: LookDescriptors) -> jax.Array:
        return fused_probabilities(infer(model, oriented).probabilities, model.rule)

    def of_gallery(oriented: LookDescriptors) -> jax.Array:
        scores = gallery.scores(model.embedding.embed_oriented(oriented))
        return jnp.asarray(scores / np.maximum(scores.sum(axis=1, keepdims=True), 1))

    if model.answers_by() != "gallery":
        network, config, classify = model.run.network, model.run.config, model.classifiers.get(EMBEDDING, fused)
    elif model.gallery.objects:
        network, config, classify = model.embedding.network, model.embedding.config, of_gallery
    else:
        raise InputError("model has neither classes nor enrolled objects; enroll some first")
    config = dataclasses.replace(config, homology="closed_form", relaxation=None)
    return lambda clouds: classify(describe_looks(clouds, network, config, LOOKS).with_balanced(clouds))


def evenly_spread(count: int, most: int) -> NDArray[np.intp]:
    """Return up to `most` evenly spread numbers from 0 to count - 1."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(np.intp))


def estimate_transform(
    instances: Sequence[PreparedInstance],
    criterion: Criterion,
    report: Report = lambda done, total: None,
    capacity: int | None = None,
) -> Adaptation:
    """Estimate the colour transform with which the answers are most certain.

    Args:
        instances: unlabelled instances with the camera's colours; unusable ones are left out.
        criterion: function that computes the probabilities of the names, see `adaptation_criterion`.
        report: function that shows the progress.
        capacity: see `objective`.

    Raises:
        InputError: there are fewer than `MIN_INSTANCES` usable instances.
    """
    usable = [instance for instance in instances if instance.reason is None]
    if len(usable) < MIN_INSTANCES:
        reasons = [instance.reason for instance in instances if instance.reason is not None]
        others = f", or mend the unusable ones ({len(reasons)}); the first has {reasons[0]}" if reasons else ""
        raise InputError(
            f"frames have {len(usable)} usable instances; expected at least {MIN_INSTANCES}: give more frames of this "
            f"camera{others}"
        )
    chosen = [usable[index] for index in evenly_spread(len(usable), MAX_INSTANCES)]
    total = objective(chosen, criterion, capacity)
    totals = np.zeros(len(GRID))
    for number, parameters in enumerate(GRID):
        report(number, len(GRID))
        totals[number] = total(parameters)
    parameters = posterior_mean(totals)
    report(len(GRID), len(GRID))
    before, after = (total(each) / len(chosen) for each in (np.zeros(4), parameters))
    return Adaptation(ColorTransform(*parameters.round(4).tolist()), len(chosen), before, after)


def posterior_mean(totals: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the mean [4] of the posterior from the sums of uncertainties [25] of the transforms of `GRID`."""
    negative_log = EVIDENCE * totals + (GRID[:, 3] / PRIOR) ** 2 / 2
    return np.asarray(softmax(-negative_log) @ GRID)


log = logging.getLogger(__name__)

CAPACITY = 2048
"""Largest number of points of an instance in use, so that only one shape is compiled."""

EVERY = 20
"""Number of new instances after which the transform is estimated again."""


class OnlineAdaptation:
    """The colour transform of one camera, estimated from the instances of its latest frames.

    Estimates run in a thread, one at a time; instances that arrive during an estimate are kept for the next one.
    """

    def __init__(self, criterion: Callable[[], Criterion]) -> None:
        """Create an adaptation without instances.

        Args:
            criterion: function that returns the criterion of the current model, see `estimate_transform`. It is called
                here and at each estimate, since the gallery may change.
        """
        criterion()
        self._criterion = criterion
        self._recent: deque[PreparedInstance] = deque(maxlen=MAX_INSTANCES)
        self._new = 0
        self._thread: threading.Thread | None = None
        self.latest: Adaptation | None = None

    def compile(self) -> None:
        """Compile all functions of an estimate by evaluating an instance."""
        objective([EMPTY_INSTANCE], self._criterion(), CAPACITY)(np.zeros(4))

    def observe(self, instances: Sequence[PreparedInstance]) -> None:
        """Add the instances of a frame, with the camera's colours, and start an estimate if there are enough."""
        usable = [each for each in instances if each.reason is None and len(each.points) <= CAPACITY]
        self._recent.extend(usable)
        self._new += len(usable)
        if self._new < EVERY or (self._thread is not None and self._thread.is_alive()):
            return
        self._new = 0
        self._thread = threading.Thread(target=self._estimate, args=(list(self._recent),), name="adapt", daemon=True)
        self._thread.start()

    def _estimate(self, instances: Sequence[PreparedInstance]) -> None:
        try:
            self.latest = estimate_transform(instances, self._criterion(), capacity=CAPACITY)
        except Exception as error:  # An InputError says that all objects were forgotten.
            log.error("the colour transform is unchanged: %s", error, exc_info=not isinstance(error, InputError))
