"""Fit one classifier with Adam at 1e-2 and then 1e-3 and categorical cross-entropy (paper, section "Training").

On held-out sets, the temperatures of classifiers (Guo et al., ICML 2017) and the confidence of a run are calibrated.

Two trainings with the same seed, views and options have the same folds, initial weights, sample order and dropout. On
the same machine, with the same library versions and number of CPU devices, their weights and metrics are equal bit for
bit, even if one of them was interrupted; only `samples_per_second` differs. On other hardware, on accelerators or with
another number of devices, floating-point sums are rounded differently, and the weights are close but not equal.

Steps are compiled and data-parallel over all devices of all processes (`batch_mesh`). Batches are sharded over the
devices and weights are replicated; loss, gradients and batch normalization are means over the whole batch.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from jax.sharding import NamedSharding, PartitionSpec
from jax.typing import ArrayLike
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax, logit
from sklearn.linear_model import LogisticRegression

from colornet import ColorNetwork
from thor2_jax import DescriptorConfig, InputError
from thor2_jax.descriptor.describe import BATCH_AXIS, batch_mesh
from thor2_jax.model.fusion import MAX_ODDS, Calibration, answer_features
from thor2_jax.model.inference import infer_clouds
from thor2_jax.model.model import Model
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.networks import EMBEDDING, MLP, Feature, feature_of, input_size
from thor2_jax.types import Cloud
from training.fitting.loop import Checkpoints, EpochMetrics, FitOptions, Steps, run_epochs, wait_for_all
from training.fitting.samples import Batch, Samples, describe_batch
from training.views.normalized_views import padded_batches

__all__ = [
    "FitContext",
    "FitState",
    "fit",
    "fit_calibration",
    "fit_temperature",
    "network_step",
    "sample_probabilities",
    "scale_inputs",
    "shard_batch",
    "train_step",
]


class FitState(NamedTuple):
    """The training state of a network: everything that a step changes. A pytree.

    Attributes:
        params: weights.
        rest: batch statistics and constants.
        optimizer: state of the optimizer.
    """

    params: Any
    rest: Any
    optimizer: Any

    @classmethod
    def initial(cls, model: nnx.Module, optimizer: Any) -> tuple[Any, "FitState"]:
        """Return the graph of a network (the network without its arrays) and the state before the first step."""
        split: Any = nnx.split(model, nnx.Param, ...)
        graph, params, rest = split
        return graph, cls(params, rest, optimizer.init(params))


@dataclasses.dataclass(frozen=True)
class FitContext:
    """Constants of a fit; static under jit.

    Attributes:
        feature: part of the descriptor that the classifier reads.
        network: colour network, which defines the colour regions and their similarity.
        config: descriptor of the samples, always in closed form, whose values equal those of gudhi.
    """

    feature: Feature
    network: ColorNetwork
    config: DescriptorConfig

    def __post_init__(self) -> None:
        object.__setattr__(self, "config", dataclasses.replace(self.config, homology="closed_form"))


def shard_batch(batch: Batch) -> Batch:
    """Move a batch to the devices, split along the samples; each process gives its own chunk of the batch."""
    return _to_devices(batch, PartitionSpec(BATCH_AXIS))


def _to_devices(tree: Any, spec: PartitionSpec) -> Any:
    sharding = NamedSharding(batch_mesh(), spec)
    return jax.tree.map(lambda a: jax.make_array_from_process_local_data(sharding, np.asarray(a)), tree)


def _replicated(tree: Any) -> Any:
    """Constrain the arrays to be replicated on all devices."""
    return jax.lax.with_sharding_constraint(tree, NamedSharding(batch_mesh(), PartitionSpec()))


def network_step(
    graph: Any,
    state: FitState,
    optimizer: Any,
    label: ArrayLike,
    outputs_of: Callable[[Any], tuple[jax.Array, jax.Array]],
) -> tuple[FitState, tuple[jax.Array, jax.Array]]:
    """Make one step of an optimizer on the cross-entropy of a network; call it under jit.

    Args:
        graph: the network without its arrays.
        state: state before the step.
        optimizer: optax optimizer.
        label: [B] class indices.
        outputs_of: function of the network that returns logits [B, C] and scores [B, C]; the highest score is the
            predicted class.

    Returns:
        The next state, and the batch's loss and accuracy before the step.
    """

    def loss_of(params: Any) -> Any:
        model = nnx.merge(graph, params, state.rest, copy=True)  # batch normalization changes its statistics
        logits, scores = outputs_of(model)
        loss = optax.softmax_cross_entropy_with_integer_labels(logits, label).mean()
        return loss, ((scores.argmax(axis=-1) == label).mean(), nnx.state(model, nnx.Not(nnx.Param)))

    (loss, (accuracy, rest)), gradients = jax.value_and_grad(loss_of, has_aux=True)(state.params)
    updates, moments = optimizer.update(gradients, state.optimizer, state.params)
    return FitState(optax.apply_updates(state.params, updates), rest, moments), (loss, accuracy)


@partial(jax.jit, static_argnums=(0, 1), donate_argnums=2)
def train_step(
    context: FitContext, graph: Any, state: FitState, batch: Batch, rate: ArrayLike, seed: ArrayLike, step: ArrayLike
) -> tuple[FitState, tuple[jax.Array, jax.Array]]:
    """Make one step of Adam.

    Args:
        context: constants of the fit. Static.
        graph: the classifier without its arrays, from `FitState.initial`. Static.
        state: state before the step; it is donated and cannot be used afterwards.
        batch: batch on the devices, from `shard_batch`.
        rate: learning rate.
        seed: seed for the dropout.
        step: number of the step, which determines the dropout together with the seed.

    Returns:
        The next state, and the batch's loss and accuracy before the step.
    """
    x = feature_of(describe_batch(batch, context.network, context.config), context.feature)
    key = jax.random.fold_in(jax.random.key(seed), step)

    def outputs_of(model: MLP) -> tuple[jax.Array, jax.Array]:
        logits = model(x, train=True, rngs=nnx.Rngs(dropout=key))
        return logits, logits

    return _replicated(network_step(graph, state, optax.adam(rate), batch.label, outputs_of))


@partial(jax.jit, static_argnums=(0, 1))
def predicted_labels(context: FitContext, graph: Any, state: FitState, batch: Batch) -> jax.Array:
    """Return the predicted class indices [B] of the samples of a batch."""
    model = nnx.merge(graph, state.params, state.rest, copy=True)
    logits = model(feature_of(describe_batch(batch, context.network, context.config), context.feature))
    return _replicated(logits.argmax(axis=-1))


@partial(jax.jit, static_argnums=(1, 2, 3))
def scale_inputs(sample: Batch, feature: Feature, network: ColorNetwork, config: DescriptorConfig) -> jax.Array:
    """Return the input scaling [F]: 1 / root mean square over a batch, one value for images, one for embeddings."""
    descriptors = describe_batch(sample, network, config)
    block = jax.tree.map(lambda a: jnp.full((1, *a.shape[1:]), jnp.sqrt((a**2).mean())), descriptors)
    size = feature_of(block, feature)[0]
    return jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)


SCALE_SAMPLES = 1024
"""Approximate number of training samples that determine the input scaling."""


def fit(
    samples: Samples,
    context: FitContext,
    options: FitOptions,
    checkpoints: Checkpoints,
    held_out: NDArray[np.bool_] | None = None,
    progress: Callable[[int, int, EpochMetrics], object] = lambda done, total, metrics: None,
    rows: NDArray[np.intp] | None = None,
) -> tuple[MLP, int]:
    """Train the MLP of one feature, or resume from the last checkpoint.

    The descriptors of the samples are computed on the devices, one batch at a time.

    Args:
        samples: training samples and held-out set, with samples of every class; the same in all processes.
        context: feature, colour network and descriptor.
        options: epochs, learning rates, seed and batch size, a multiple of the number of devices.
        checkpoints: checkpoints of this fit only, written after each epoch.
        held_out: [M], True for samples of the held-out set; by default there is none.
        progress: called with (steps done, total steps, metrics of the epoch so far), for some of the steps.
        rows: indices of the samples to use; by default all.

    Returns:
        The classifier after the best epoch, and the number of this epoch. The best epoch has the highest held-out
        accuracy or, without a held-out set, the lowest training loss.

    Raises:
        InputError: there are fewer than two training samples, a checkpoint is unreadable, or the loss is not finite.
        OSError: a checkpoint cannot be written. The last complete one is kept.
    """
    n_devices, rows = jax.device_count(), np.arange(len(samples)) if rows is None else rows
    network, config = context.network, context.config
    is_held_out = np.zeros(len(rows), bool) if held_out is None else held_out[rows]
    train_rows, held_out_rows = rows[~is_held_out], rows[is_held_out]
    least = max(2, n_devices)
    if len(train_rows) < least:
        raise InputError(f"there are {len(train_rows)} samples to train on; expected at least {least}; add views")
    batch_size = min(options.batch_size, len(train_rows) // n_devices * n_devices)
    steps = Steps(options.epochs, len(train_rows) // batch_size, batch_size)
    n_inputs = input_size(context.feature, config, network.n_regions)
    model = MLP(n_inputs, int(samples.label.max()) + 1, rngs=nnx.Rngs(options.seed))
    chosen = train_rows[:: max(1, len(train_rows) // SCALE_SAMPLES)][:SCALE_SAMPLES]
    model.input_scale[...] = scale_inputs(samples.take(chosen, network, config), context.feature, network, config)
    graph, initial = FitState.initial(model, optax.adam(0.0))

    def batches(rows: NDArray[np.intp]) -> Iterator[Batch]:
        """Yield batches on the devices; this process gathers its own chunk of each."""
        chunk = batch_size // jax.process_count()
        for first in range(jax.process_index() * chunk, len(rows), batch_size):
            yield shard_batch(samples.take(rows[first : first + chunk], network, config))

    def train_epoch(number: int, state: FitState) -> Iterator[tuple[FitState, tuple[jax.Array, jax.Array]]]:
        # The order depends only on seed and epoch, so that a resumed fit needs no generator state.
        order = np.random.default_rng((options.seed, number)).permutation(train_rows)[: steps.of_epoch * batch_size]
        seed, rate = np.uint32(options.seed), np.float32(options.learning_rates[number > (options.epochs + 1) // 2])
        for step, batch in enumerate(batches(order), (number - 1) * steps.of_epoch):
            state, computed = train_step(context, graph, state, batch, rate, seed, np.uint32(step))
            yield state, computed

    def held_out_accuracy(state: FitState) -> float | None:
        if not len(held_out_rows):
            return None
        padded = np.resize(held_out_rows, len(held_out_rows) + -len(held_out_rows) % batch_size)
        predicted = np.concatenate([predicted_labels(context, graph, state, batch) for batch in batches(padded)])
        return float(np.mean(predicted[: len(held_out_rows)] == samples.label[held_out_rows]))

    state = run_epochs(
        context.feature,
        _to_devices(checkpoints.last(initial), PartitionSpec()),
        steps,
        train_epoch,
        checkpoints,
        progress=progress,
        held_out_accuracy=held_out_accuracy,
    )
    wait_for_all(f"fitted {context.feature}")
    best = jax.tree.map(jnp.asarray, checkpoints.best(state))
    return nnx.merge(graph, best.params, best.rest), checkpoints.best_epoch


SAMPLES_PER_BATCH = 256
"""Batch size of the predictions."""


@partial(jax.jit, static_argnums=(0, 1))
def _probabilities(context: FitContext, graph: Any, state: Any, batch: Batch) -> jax.Array:
    descriptors = describe_batch(batch, context.network, context.config)
    return jax.nn.softmax(nnx.merge(graph, state)(feature_of(descriptors, context.feature)))


def sample_probabilities(
    model: MLP, samples: Samples, rows: NDArray[np.intp], context: FitContext
) -> NDArray[np.float32]:
    """Return the class probabilities [len(rows), C] of samples; `context` is the context of the fit."""
    graph, state = nnx.split(model)
    batches = samples.batches(rows, SAMPLES_PER_BATCH, context.network, context.config)
    chunks = [np.asarray(_probabilities(context, graph, state, batch)) for batch in batches]
    return np.concatenate([np.zeros((0, model.head.out_features), np.float32), *chunks])[: len(rows)]


def fit_temperature(probabilities: NDArray[np.floating[Any]], truth: NDArray[np.integer[Any]]) -> float:
    """Return the temperature between 0.01 and 100 that minimizes the negative log-likelihood of a held-out set.

    Args:
        probabilities: [N, C], N > 0, class probabilities of views on which the classifier was not trained.
        truth: [N] class indices.
    """
    logits = np.log(np.maximum(np.asarray(probabilities, np.float64), np.finfo(np.float32).tiny))

    def loss(exponent: float) -> float:
        return float(-log_softmax(logits / math.exp(exponent), axis=1)[np.arange(len(truth)), truth].mean())

    bounds = math.log(0.01), math.log(100)
    return math.exp(minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-6}).x)


KEPT = 0.95
"""Least fraction of the correct held-out answers whose confidence reaches the threshold, which is one of theirs."""


def fit_calibration(run: TrainedRun, held_out: Sequence[tuple[int, Cloud]]) -> tuple[Calibration | None, float]:
    """Calibrate the confidence of a run on a held-out set.

    The clouds are recognized in the looks of the run. Known and unknown objects have equal weights in the score,
    regardless of their numbers.

    Args:
        run: run with its embedding and its classifiers, which are fused as in recognition by default.
        held_out: label and cloud, in metres, of each view of the held-out set; labels from the number of classes on
            mean unknown objects.

    Returns:
        The calibration, and the accuracy on known objects. The calibration is None if no held-out answer is correct or
        no object is unknown.
    """
    model = Model.of_run(run)
    held_out = sorted(held_out, key=lambda view: len(view[1][0]))  # for batches with little padding
    label = np.array([label for label, _ in held_out])
    batches = padded_batches([cloud for _, cloud in held_out])
    chunks = [infer_clouds(model, clouds).probabilities for _, clouds in batches]
    probabilities = {name: np.concatenate([c[name] for c in chunks])[: len(label)] for name in chunks[0]}
    fused = model.fused(probabilities)  # not calibrated yet
    correct, known = fused.argmax(axis=1) == label, label < len(run.classes)
    accuracy = float(correct.sum() / max(known.sum(), 1))  # only answers for known objects can be correct
    if known.all() or not correct.any():
        return None, accuracy
    odds = answer_features(fused, probabilities[EMBEDDING])[:, 1]
    calibration = Calibration(MAX_ODDS, 0.0, *_logistic(odds, known, "balanced"), unknown_below=0.0)
    if not correct[known].all():
        score = logit(calibration.score(fused, probabilities[EMBEDDING]))
        bias, factor = _logistic(score[known], correct[known])
        if factor > 0:  # otherwise the confidence would not increase with the score
            calibration = dataclasses.replace(calibration, score_bias=bias, score_factor=factor)
    confidence = calibration.confidence(fused, probabilities[EMBEDDING])
    threshold = np.quantile(confidence[correct], 1 - KEPT, method="lower")
    return dataclasses.replace(calibration, unknown_below=float(threshold)), accuracy


def _logistic(feature: NDArray[Any], target: NDArray[np.bool_], class_weight: str | None = None) -> tuple[float, float]:
    """Return bias and factor of a logistic regression on one feature [N]; "balanced" weights both targets equally."""
    fit = LogisticRegression(class_weight=class_weight).fit(feature[:, None], target)
    return float(fit.intercept_[0]), float(fit.coef_[0, 0])
