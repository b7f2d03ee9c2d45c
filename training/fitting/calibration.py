"""Calibration on held-out sets: temperatures of classifiers (Guo et al., ICML 2017) and the confidence of a run."""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from flax import nnx
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax, logit
from sklearn.linear_model import LogisticRegression

from thor2_jax.model.fusion import MAX_ODDS, Calibration, answer_features
from thor2_jax.model.inference import infer_clouds
from thor2_jax.model.model import Model
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.networks import EMBEDDING, MLP, feature_of
from thor2_jax.types import Cloud
from training.fitting.fit import FitContext
from training.fitting.samples import Batch, Samples, describe_batch
from training.views.normalized_views import padded_batches

__all__ = ["fit_calibration", "fit_temperature", "sample_probabilities"]

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
