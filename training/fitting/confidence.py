"""Fit the confidence of a run on views and distractors that none of its networks were fitted on."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.special import logit
from sklearn.linear_model import LogisticRegression

from thor2_jax.descriptor.orientations import OrientedDescriptors
from thor2_jax.gallery.embedding import Embedding
from thor2_jax.recognition.classifier import EMBEDDING
from thor2_jax.recognition.confidence import Calibration, answer_features
from thor2_jax.recognition.run_directory import TrainedRun
from thor2_jax.recognizer import Recognizer
from training.embedding.fit import batch_descriptors
from training.embedding.samples import Samples

__all__ = ["KEPT", "fit_calibration"]

KEPT = 0.95
"""Share of the correct held-out answers whose confidence reaches the threshold of a run."""

BATCH = 128


def fit_calibration(run: TrainedRun, embedding: Embedding, held_out: Samples) -> Calibration | None:
    """Fit the confidence of a run; None if all held-out answers to known objects are correct, or none.

    Known and unknown objects have equal weights in the score, whatever their numbers.

    Args:
        run: run with its classifiers, which are fused as recognition does by default.
        embedding: embedding of the run.
        held_out: samples of the held-out set; labels from the number of classes on are of unknown objects.
    """
    recognizer = Recognizer(run, embedding=embedding)
    rows = np.arange(len(held_out))
    chunks = []
    for chunk in np.resize(rows, -(-len(rows) // BATCH) * BATCH).reshape(-1, BATCH):
        batch = held_out.take(chunk)
        descriptors = batch_descriptors(batch.length, batch.color, run.network, embedding.config)
        each, statistics = jax.tree.map(lambda a: a[:, None], (descriptors, jnp.asarray(batch.statistics)))
        oriented = OrientedDescriptors(each, statistics, jnp.ones((BATCH, 1)))
        chunks.append(recognizer.probabilities(oriented, recognizer.default_classifiers))
    probabilities = {name: np.concatenate([c[name] for c in chunks])[: len(rows)] for name in chunks[0]}
    fused = recognizer.fused(probabilities)  # not calibrated yet
    features = answer_features(fused, probabilities[EMBEDDING])
    correct, known = fused.argmax(axis=1) == held_out.label, held_out.label < len(run.classes)
    if known.all() or correct[known].all() or not correct.any():
        return None
    of_correct, of_known = _logistic(features[known, 0], correct[known]), _logistic(features[:, 1], known, "balanced")
    calibration = Calibration(*of_correct, *of_known, unknown_below=0.0)
    score = logit(calibration.score(fused, probabilities[EMBEDDING]))
    bias, factor = _logistic(score[known], correct[known])
    if factor > 0:  # otherwise the confidence would not grow with the score
        calibration = dataclasses.replace(calibration, score_bias=bias, score_factor=factor)
    confidence = calibration.confidence(fused, probabilities[EMBEDDING])[correct]
    return dataclasses.replace(calibration, unknown_below=float(np.quantile(confidence, 1 - KEPT)))


def _logistic(feature: NDArray[Any], target: NDArray[np.bool_], class_weight: str | None = None) -> tuple[float, float]:
    """Return bias and factor of a logistic regression on one feature [N]; "balanced" weights both targets equally."""
    fit = LogisticRegression(class_weight=class_weight).fit(feature[:, None], target)
    return float(fit.intercept_[0]), float(fit.coef_[0, 0])
