"""Fit the confidence of a run on views and distractors that none of its networks were fitted on."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit
from sklearn.linear_model import LogisticRegression

from thor2_jax.gallery.embedding import Embedding
from thor2_jax.model.classifier import EMBEDDING
from thor2_jax.model.confidence import MAX_ODDS, Calibration, answer_features
from thor2_jax.model.inference import infer
from thor2_jax.model.model import Model
from thor2_jax.model.run_directory import TrainedRun
from training.embedding.fit import batch_looks
from training.embedding.samples import Samples

__all__ = ["KEPT", "fit_calibration"]

KEPT = 0.97
"""Share of the correct held-out answers whose confidence reaches the threshold of a run.

Cameras are harder than held-out renderings: under them, about .95 reach it (docs/decisions.md).
"""

BATCH = 128


def fit_calibration(run: TrainedRun, embedding: Embedding, held_out: Samples) -> tuple[Calibration | None, float]:
    """Fit the confidence of a run; None if no held-out answer is correct, or no object is unknown.

    Known and unknown objects have equal weights in the score, whatever their numbers.

    Args:
        run: run with its classifiers, which are fused as recognition does by default.
        embedding: embedding of the run.
        held_out: samples of the held-out set; labels from the number of classes on are of unknown objects.

    Returns:
        The calibration, and the accuracy on known objects.
    """
    model = Model.of_run(dataclasses.replace(run, embedding=embedding))
    batches = held_out.batches(np.arange(len(held_out)), BATCH)
    chunks = [infer(model, batch_looks(batch, run.network, embedding.config)).probabilities for batch in batches]
    probabilities = {name: np.concatenate([c[name] for c in chunks])[: len(held_out)] for name in chunks[0]}
    fused = model.fused(probabilities)  # not calibrated yet
    features = answer_features(fused, probabilities[EMBEDDING])
    correct, known = fused.argmax(axis=1) == held_out.label, held_out.label < len(run.classes)
    accuracy = float(correct.sum() / max(known.sum(), 1))  # correct answers are to known objects
    if known.all() or not correct.any():
        return None, accuracy
    of_known = _logistic(features[:, 1], known, "balanced")
    if correct[known].all():  # nothing tells when a known object is named incorrectly; unknown ones still are
        calibration = Calibration(MAX_ODDS, 0.0, *of_known, unknown_below=0.0)
    else:
        of_correct = _logistic(features[known, 0], correct[known])
        calibration = Calibration(*of_correct, *of_known, unknown_below=0.0)
        score = logit(calibration.score(fused, probabilities[EMBEDDING]))
        bias, factor = _logistic(score[known], correct[known])
        if factor > 0:  # otherwise the confidence would not grow with the score
            calibration = dataclasses.replace(calibration, score_bias=bias, score_factor=factor)
    confidence = calibration.confidence(fused, probabilities[EMBEDDING])[correct]
    return dataclasses.replace(calibration, unknown_below=float(np.quantile(confidence, 1 - KEPT))), accuracy


def _logistic(feature: NDArray[Any], target: NDArray[np.bool_], class_weight: str | None = None) -> tuple[float, float]:
    """Return bias and factor of a logistic regression on one feature [N]; "balanced" weights both targets equally."""
    fit = LogisticRegression(class_weight=class_weight).fit(feature[:, None], target)
    return float(fit.intercept_[0]), float(fit.coef_[0, 0])
