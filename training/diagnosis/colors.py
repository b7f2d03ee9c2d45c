"""Checks of colour: light and colour cast from the image alone, and the channel order with a trained recognizer.

A frame alone does not show whether red and blue are exchanged, since the colours of its objects are unknown. A trained
recognizer is more confident of its objects if the channels are in the right order.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import logit

from thor2_jax import Recognizer, RGBDFrame
from training.diagnosis.checks import Diagnosis

__all__ = ["check_channel_order", "check_light"]

MIN_BRIGHTNESS = 22.0
"""Smallest plausible mean value of the pixels of the instances, from 0 to 255."""

MAX_SATURATED = 0.65
"""Largest plausible fraction of pixels of the instances with a channel at its maximum."""

MAX_CAST = 2.2
"""Largest plausible ratio of two channels' contrasts (generalized means of order 4), which are equal in white light."""

MIN_LOGIT_GAIN = 0.2
"""Smallest gain of a recognizer's mean log-odds with exchanged channels, for a finding."""

MIN_CONFIDENCE_GAIN = 0.2
"""Smallest gain of a recognizer's mean confidence with other light, for a finding."""

MAX_LOGIT = 7.0

MIN_OBJECTS = 2
"""Smallest number of objects for a finding on the channel order."""

FAR = "The colours differ strongly from the training views"

LIGHTS = {
    "half as bright": (0.5, 0.5, 0.5),
    "twice as bright": (2.0, 2.0, 2.0),
    "warmer": (1.5, 1.0, 0.6),
    "cooler": (0.6, 1.0, 1.5),
    "greener": (0.7, 1.3, 0.7),
    "less green": (1.4, 0.7, 1.4),
}
"""Tested changes of light -> factors of red, green and blue."""


def check_light(diagnosis: Diagnosis, color: NDArray[np.uint8], labels: NDArray[Any] | None) -> None:
    """Check the light in a colour image [H, W, 3]."""
    pixels = color[labels != 0] if labels is not None and (labels != 0).any() else color.reshape(-1, 3)
    brightness, saturated = float(pixels.mean()), float((pixels.max(axis=1) == 255).mean())
    contrasts = [_contrast(color[..., channel]) for channel in range(3)]
    if (pixels.max(axis=1) == pixels.min(axis=1)).mean() > 0.98:
        diagnosis.add(
            "color-gray",
            "The colour image is grey, with red, green and blue equal: perhaps it is the infrared image.",
            "Record the colour stream; without colours, only the shape is recognized.",
        )
    elif brightness < MIN_BRIGHTNESS:
        message = f"{FAR}: the mean value of the pixels is {brightness:.0f} of 255."
        advice = "Raise the exposure or the light. Images of more than 8 bits must be scaled to 0 to 255."
        diagnosis.add("color-dark", message, advice)
    elif saturated > MAX_SATURATED:
        message = f"{FAR}: {saturated:.0%} of the pixels are overexposed."
        diagnosis.add("color-bright", message, "Lower the exposure or the gain of the camera.")
    elif max(contrasts) > MAX_CAST * min(contrasts):
        strongest, weakest = (("red", "green", "blue")[each(contrasts)] for each in (np.argmax, np.argmin))
        ratio = max(contrasts) / max(min(contrasts), 1e-9)
        message = f"{FAR}: {strongest} has {ratio:.1f} times the contrast of {weakest}, a strong colour cast."
        diagnosis.add("color-cast", message, "Set the white balance of the camera.")


def _contrast(channel: NDArray[np.uint8]) -> float:
    gradient = ndimage.gaussian_gradient_magnitude(channel.astype(np.float64), 1)
    return float(np.mean(gradient**4) ** 0.25)


def check_channel_order(diagnosis: Diagnosis, frame: RGBDFrame, recognizer: Recognizer) -> None:
    """Check the channel order and the light of a frame by the confidence of a recognizer."""

    def confidences(color: NDArray[np.uint8]) -> NDArray[np.float64]:
        answers = recognizer.recognize(dataclasses.replace(frame, color=color))
        return np.array([answer.confidence for answer in answers if answer.confidence is not None])

    given, exchanged = confidences(frame.color), confidences(np.ascontiguousarray(frame.color[..., ::-1]))
    if len(given) < MIN_OBJECTS or not recognizer.classes:
        diagnosis.notes.append(
            f"order of the colour channels: not checked, since {len(given)} objects could be described; expected at "
            f"least {MIN_OBJECTS} objects of the model"
        )
        return
    lit = {name: np.rint(frame.color * np.array(factors)).clip(0, 255) for name, factors in LIGHTS.items()}
    lights = {name: confidences(color.astype(np.uint8)) for name, color in lit.items()}
    best = max(lights, key=lambda name: float(lights[name].mean()))
    if _logit(exchanged) - _logit(given) > MIN_LOGIT_GAIN and exchanged.mean() > lights[best].mean():
        diagnosis.add(
            "bgr",
            f"With red and blue exchanged, the model is more confident of the {len(given)} objects (mean confidence "
            f"{exchanged.mean():.2f} instead of {given.mean():.2f}): the colour image is BGR, not RGB.",
            "Store images as RGB; note that OpenCV's imread returns BGR and imwrite expects BGR.",
        )
    elif lights[best].mean() - given.mean() > MIN_CONFIDENCE_GAIN:
        diagnosis.add(
            "color-light",
            f"{FAR}: if they were {best}, the model would be more confident of the objects (mean confidence "
            f"{lights[best].mean():.2f} instead of {given.mean():.2f}).",
            "Set the exposure and the white balance of the camera.",
        )


def _logit(confidence: NDArray[np.float64]) -> float:
    return float(np.clip(logit(confidence), -MAX_LOGIT, MAX_LOGIT).mean())
