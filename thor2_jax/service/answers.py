"""Conversion of recognition results into the JSON records of the API."""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.adaptation.estimate import Adaptation
from thor2_jax.config import DescriptorConfig
from thor2_jax.explanation.explain import Explanation
from thor2_jax.explanation.pictures import change_text, main_pictures
from thor2_jax.figures import png_bytes
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery.enrollment import ObjectGallery
from thor2_jax.model.fusion import with_temperature
from thor2_jax.model.inference import Inference
from thor2_jax.model.model import Model
from thor2_jax.model.recognition import Recognition
from thor2_jax.networks.networks import THOR2
from thor2_jax.service import schemas
from thor2_jax.service.engine import CloudResult
from thor2_jax.service.preparation import PreparedRequest

__all__ = ["adaptation_answer", "explained_frame", "instance_answer", "object_answers", "why_answer"]

MAX_SHOWN_POINTS = 1000
"""Number of points of a cloud in an explanation."""


def instance_answer(recognition: Recognition) -> schemas.InstanceAnswer:
    """Return the JSON record of one recognized instance."""
    top = {
        classifier: [schemas.Candidate(name=name, probability=p) for name, p in candidates]
        for classifier, candidates in recognition.top.items()
    }
    return schemas.InstanceAnswer(**{**vars(recognition), "top": top, "unrecognized": recognition.reason})


def why_answer(explanation: Explanation, frame: RGBDFrame) -> schemas.WhyAnswer:
    """Return the JSON record of an explanation, with its main pictures and without timings."""
    record = explanation.as_json()
    changes = [f"{change_text(change)}: {change.answer}" for change in explanation.changes]
    pictures = [
        schemas.WhyPicture(title=p.title, caption=p.caption, png=base64.b64encode(png_bytes(p.figure)).decode())
        for p in main_pictures(explanation, frame)
    ]
    shown = {"changes": changes, "pictures": pictures, "timings": {}}
    return schemas.WhyAnswer(**{**record, **record["faithfulness"], **shown})


def adaptation_answer(adaptation: Adaptation | None) -> schemas.AdaptationAnswer | None:
    """Return the JSON record of an estimate of the camera's colour transform; None without an estimate."""
    if adaptation is None:
        return None
    return schemas.AdaptationAnswer(instances=adaptation.instances, **vars(adaptation.transform))


def object_answers(objects: ObjectGallery) -> list[schemas.ObjectAnswer]:
    """Return the JSON records of all objects that the model can recognize."""
    gallery = objects.gallery
    answers = []
    for name, is_trained in zip(gallery.answered_names, gallery.has_output, strict=True):
        about: dict[str, Any] = {"views": 0, "source": None, "date": None}
        if (views := gallery.objects.get(name)) is not None:
            about = {"views": len(views.clouds), "source": views.source, "date": views.date}
        answers.append(schemas.ObjectAnswer(name=name, trained=bool(is_trained), **about))
    return answers


def explained_frame(
    model: Model,
    prepared: PreparedRequest,
    results: Sequence[CloudResult],
    recognitions: Sequence[Recognition],
    timings: dict[str, float],
) -> schemas.ExplainedFrame:
    """Return the instances of a frame together with the clouds and descriptors behind their names.

    Args:
        model: the model of the results.
        prepared: the decoded frame, with its label map.
        results: one result per usable instance, in the order of the instances.
        recognitions: one recognition per instance.
        timings: stage -> milliseconds.
    """
    assert prepared.label_map is not None
    shown = iter(results[: schemas.MAX_EXPLAINED])
    instances: list[schemas.ExplainedInstance] = []
    for instance, recognition in zip(prepared.instances, recognitions, strict=True):
        result = next(shown, None) if instance.reason is None else None
        details = None if result is None else _details(model, instance, result, recognition)
        instances.append(schemas.ExplainedInstance(**dict(instance_answer(recognition)), details=details))
    known: dict[str, Any] = {"knows": model.gallery.summary, "classes": list(model.names)}
    return schemas.ExplainedFrame(instances=instances, label_map=prepared.label_map, timings=timings, **known)


def calibrated_confidence(model: Model, recognition: Recognition, inference: Inference) -> float | None:
    """Return the calibrated confidence of the most probable class of a cloud.

    If the run has a calibration, the result is the confidence of the answer, otherwise the confidence after temperature
    scaling of both classifiers. It is None with a gallery, with forgotten classes, or without temperatures, which
    training fits on a held-out set (`thor2 train --folds`).

    Args:
        model: the model.
        recognition: the answer for the cloud.
        inference: the outputs of the model for the cloud, without the batch axis.
    """
    if model.answers_by() != "classifiers" or model.gallery.hidden:
        return None
    if model.calibration is not None:
        return recognition.confidence
    temperatures = model.run.record.get("temperatures", {})
    if not set(THOR2) <= set(temperatures):
        return None
    probabilities: dict[str, NDArray[np.float32]] = {name: inference.probabilities[name][None] for name in THOR2}
    scaled = {name: with_temperature(values, temperatures[name]) for name, values in probabilities.items()}
    return float(model.fused(scaled)[0, model.fused(probabilities)[0].argmax()])


def _details(
    model: Model, instance: PreparedInstance, result: CloudResult, recognition: Recognition
) -> schemas.Details:
    aligned = result.aligned[: len(instance.points)]
    shown = np.random.default_rng(0).permutation(len(aligned))[:MAX_SHOWN_POINTS]
    peak = float(result.images.max())
    images = np.rint(result.images * (255 / peak if peak > 0 else 0)).astype(int)
    return schemas.Details(
        points=aligned[shown].astype(float).round(4).tolist(),
        colors=instance.colors[shown].tolist(),
        slice_borders=_slice_borders(aligned[:, 2], model.run.config),
        calibrated_confidence=calibrated_confidence(model, recognition, result.inference),
        image_peak=peak,
        slices=[
            schemas.SliceDetails(image=image.tolist(), strips=_strip_colors(colors))
            for image, colors in zip(images, result.strip_colors, strict=True)
        ],
    )


def _slice_borders(z: NDArray[np.float32], config: DescriptorConfig) -> list[tuple[float, float]]:
    if config.convention == "paper":
        low = np.arange(config.n_slices) * config.sigma_1
    else:  # The released code rounds z and numbers only the levels that occur.
        low = (np.unique(np.rint(z / config.sigma_1))[: config.n_slices] - 0.5) * config.sigma_1
    return [(round(float(border), 4), round(float(border + config.sigma_1), 4)) for border in low]


def _strip_colors(colors: NDArray[np.float32]) -> list[schemas.StripColors]:
    strips = []
    for strip in np.flatnonzero(colors.any(axis=1)):
        regions = np.flatnonzero(colors[strip])
        weights = colors[strip, regions].astype(float).round(3).tolist()
        strips.append(schemas.StripColors(strip=int(strip), regions=regions.tolist(), weights=weights))
    return strips
