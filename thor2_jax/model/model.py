"""The model: everything that determines the answer for an instance, as one immutable value.

>>> model = Model.of_run(load_run("run"), unknown_below=0.5)                        # doctest: +SKIP
>>> dataclasses.replace(model, color_transform=transform)                           # doctest: +SKIP

`thor2_jax.model.inference` evaluates it. Its classifiers are compiled functions by name: the MLPs of the run, and the
embedding if it was fitted on the classes. A colour transform corrects the colours of a camera before recognition.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, cast, get_args

import jax
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from colornet.colors import LUMA
from thor2_jax.descriptor.looks import LookDescriptors
from thor2_jax.errors import InputError
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery.gallery import Gallery, known_probability
from thor2_jax.model.fusion import DEFAULT_RULE, FUSION_RULES, Calibration, FusionRule, fused_probabilities
from thor2_jax.model.recognition import AnswerBy
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.embedding import Embedding, load_default
from thor2_jax.networks.networks import EMBEDDING, MLP, THOR2, Classifier, Compiled, Feature, feature_of
from thor2_jax.surfaces.surfaces import Surfaces

__all__ = ["ColorTransform", "Model"]

T = TypeVar("T")

MAX_PARAMETER = 1.5
"""Largest absolute value of a parameter: a factor of 4.5 of gamma, gain or saturation."""


@dataclasses.dataclass(frozen=True)
class ColorTransform:
    """Correction of colours c in [0, 1]: exp(gain) exp(warmth [1, 0, -1]) c^exp(gamma), then scaled saturation.

    With all parameters 0, colours do not change.

    Attributes:
        gamma: logarithm of the exponent.
        gain: logarithm of the factor of all channels.
        saturation: logarithm of the factor of a colour's distance from grey.
        warmth: logarithm of the factor of red and of the inverse factor of blue.

    Raises:
        InputError: a parameter is not a finite number, or its absolute value is above `MAX_PARAMETER`.
    """

    gamma: float = 0.0
    gain: float = 0.0
    saturation: float = 0.0
    warmth: float = 0.0

    def __post_init__(self) -> None:
        values = dataclasses.astuple(self)
        if not all(isinstance(value, (int, float)) and abs(value) <= MAX_PARAMETER for value in values):
            raise InputError(
                f"color_transform is {values}; expected gamma, gain, saturation and warmth from {-MAX_PARAMETER} to "
                f"{MAX_PARAMETER}: adapt the run again"
            )

    def __call__(self, colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the corrected values of colours [..., 3] uint8 sRGB."""
        gamma, gain, saturation, warmth = dataclasses.astuple(self)
        # A channel has only 256 values, so a table holds their powers.
        powers = (np.arange(256) / 255) ** np.exp(gamma)
        values = powers[colors] * np.exp(gain + warmth * np.array([1, 0, -1]))
        grey = (values @ LUMA)[..., None]
        return np.rint(255 * (grey + np.exp(saturation) * (values - grey))).clip(0, 255).astype(np.uint8)


def _stored_value(kind: type[T], name: str, record: Mapping[str, Any], remedy: str) -> T | None:
    """Return a dataclass instance from the record of a run; None if the record lacks the value.

    Args:
        kind: the dataclass; its own checks apply.
        name: name of the value in the record.
        record: the record as JSON values; the stored value is a mapping of field names to values.
        remedy: advice of the error message.

    Raises:
        InputError: the value is damaged.
    """
    stored = record.get(name)
    if stored is None:
        return None
    try:
        return kind(**stored)
    except TypeError:
        fields = ", ".join(field.name for field in dataclasses.fields(kind))  # type: ignore[arg-type]
        raise InputError(f"{name} is {stored!r}; expected {fields}; {remedy}") from None


def _fused_probabilities(models: Sequence[MLP], oriented: LookDescriptors, name: Feature) -> jax.Array:
    (model,) = models
    return oriented.fuse(model(feature_of(oriented.flat[0], name)))


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """A trained run and enrolled objects; an immutable value.

    Attributes:
        run: the trained run.
        classifiers: its compiled classifiers by name.
        gallery: the enrolled objects.
        unknown_below: lowest confidence, from 0 to 1, of an answer with a name; None for the defaults in `thresholds`.
        rule: fusion rule of the classifiers, see `fusion`; the paper's is "max".
        answer_by: source of the answers, see `answers_by`; None for the source in the run's record.
        color_transform: correction of the colours of every instance; None for no correction.
        calibration: calibration, which turns fused probabilities into confidences; None in runs without one.
    """

    run: TrainedRun
    classifiers: Mapping[str, Classifier]
    gallery: Gallery
    unknown_below: float | None = None
    rule: FusionRule = DEFAULT_RULE
    answer_by: AnswerBy | None = None
    color_transform: ColorTransform | None = None
    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        if self.rule not in FUSION_RULES:
            raise InputError(f"rule is {self.rule!r}; expected one of {', '.join(FUSION_RULES)}")
        below = self.unknown_below
        if below is not None and (isinstance(below, str) or np.ndim(below) > 0 or not 0 <= below <= 1):
            raise InputError(f"unknown_below is {below!r}; expected a confidence from 0 to 1")
        self.answers_by()  # raises for an unknown source

    @classmethod
    def of_run(
        cls,
        run: TrainedRun,
        unknown_below: float | None = None,
        rule: FusionRule = DEFAULT_RULE,
        answer_by: str | None = None,
    ) -> "Model":
        """Return the model of a run, with the colour transform and calibration of its record, without enrolled objects.

        Raises:
            InputError: `unknown_below` is not between 0 and 1, `rule` or `answer_by` is unknown, or the colour
                transform or the calibration is damaged.
        """
        wanted: Any = run.record.get("answer_by") if answer_by is None else answer_by
        classifiers: dict[str, Classifier] = {
            name: Compiled(_fused_probabilities, [nnx.split(each)], name) for name, each in run.classifiers.items()
        }
        if run.embedding_classifier is not None:
            classifiers[EMBEDDING] = run.embedding_classifier
        transform = _stored_value(ColorTransform, "color_transform", run.record, "adapt the run again")
        calibration = _stored_value(Calibration, "calibration", run.record, "train the run again")
        gallery = Gallery("", trained=run.classes)
        return cls(run, classifiers, gallery, unknown_below, rule, wanted, transform, calibration)

    @property
    def names(self) -> tuple[str, ...]:
        """All names that an answer can have: trained classes, without forgotten ones, and enrolled objects."""
        return self.gallery.answered_names

    @property
    def embedding(self) -> Embedding:
        """The embedding of the enrolled objects: that of the run, or the packaged one."""
        return self.run.embedding or load_default()

    def chosen_classifiers(self, names: Sequence[str] | None = None) -> tuple[str, ...]:
        """Return the names of the classifiers to fuse, without repetitions.

        Args:
            names: wanted classifiers; by default the paper's two and the embedding, if the run has them, or all
                classifiers of a run without any of these.

        Raises:
            InputError: no name is given, or the run lacks a classifier.
        """
        if names is None:
            return tuple(name for name in (*THOR2, EMBEDDING) if name in self.classifiers) or tuple(self.classifiers)
        if not isinstance(names, (list, tuple)) or not names or not set(names) <= set(self.classifiers):
            raise InputError(f"classifiers is {names!r}; expected a list of some of {', '.join(self.classifiers)}")
        return tuple(dict.fromkeys(names))

    def answers_by(self, answer_by: str | None = None) -> AnswerBy:
        """Return the source of the answers: "classifiers", "gallery" or "both".

        Args:
            answer_by: the requested source; by default that of the model, and else "both". A run without classifiers
                always answers by the gallery, a run with an empty gallery always by the classifiers.

        Raises:
            InputError: the source is unknown.
        """
        wanted = self.answer_by if answer_by is None else answer_by
        if wanted not in (None, *get_args(AnswerBy)):
            raise InputError(f"answer_by is {wanted!r}; expected one of {', '.join(get_args(AnswerBy))}")
        if not self.classifiers:
            return "gallery"
        if not self.gallery.objects:
            return "classifiers"
        return cast(AnswerBy, wanted or "both")

    def surface_of(self, name: str) -> tuple[Surfaces, int] | None:
        """Return surfaces, and which of them is that of the object with this name; None if it has none."""
        gallery, trained = self.gallery, self.run.surfaces
        if name in gallery.objects and self.answers_by() != "classifiers":
            if (enrolled := gallery.surfaces.get(gallery.names.index(name))) is not None:
                return enrolled, 0
        if trained is None or name not in self.run.classes or name in gallery.hidden:
            return None
        return trained, self.run.classes.index(name)

    def thresholds(self, answer_by: str | None = None) -> NDArray[np.float64]:
        """Return the lowest confidence [n] of an answer with each of the `names`: `unknown_below`, if it is set.

        By default it is the confidence that 95 % of the correct answers on held-out views or frames reach (97 % in runs
        of earlier versions). For a class with an output of the classifiers, it is measured on held-out views and stored
        in the run, or 0 in runs without it. For other objects, and for all names if the gallery alone answers, it
        depends on the number of enrolled views or has one value for objects with a surface, see
        `Gallery.unknown_below`. For a class that has views, too, it is the value that `Gallery.combine` computes where
        both the classifiers and the gallery are at their thresholds.

        Args:
            answer_by: source of the answers, see `answers_by`.
        """
        if self.unknown_below is not None:
            return np.full(len(self.names), self.unknown_below)
        thresholds = self.gallery.of_gallery(self.gallery.unknown_below[None])[0]
        if self.answers_by(answer_by) == "gallery":
            return thresholds
        c = self.calibration.unknown_below if self.calibration else 0.0
        both = known_probability(c, (1 - c) * thresholds / (1 - thresholds))
        return np.where(self.gallery.has_output, both if c else 0.0, thresholds)

    def corrected(self, instance: PreparedInstance) -> PreparedInstance:
        """Return an instance with its colours corrected by `color_transform`."""
        if self.color_transform is None:
            return instance
        return dataclasses.replace(instance, colors=self.color_transform(instance.colors))

    def fused(self, probabilities: Mapping[str, NDArray[np.floating[Any]]]) -> NDArray[np.floating[Any]]:
        """Return the fused class probabilities [B, C] of the classifiers.

        The embedding is not fused with other classifiers. In a calibrated run, it determines the confidence, to which
        the largest fused probability is scaled.
        """
        others = {name: values for name, values in probabilities.items() if name != EMBEDDING}
        # This rule normalizes the embedding's probabilities, whose sum is below 1 because of the distractors.
        fused = fused_probabilities(others or probabilities, self.rule if others else "log-mean")
        if self.calibration is None or EMBEDDING not in probabilities:
            return fused
        return self.calibration.calibrated(fused, probabilities[EMBEDDING])

    def combined(
        self, probabilities: Mapping[str, NDArray[np.float32]], scores: NDArray[np.float32] | None
    ) -> NDArray[np.floating[Any]]:
        """Return the values [B, n] of all `names`; the name with the largest value is the answer.

        The largest value is the confidence.

        Args:
            probabilities: classifier -> class probabilities [B, C]; empty if the gallery alone answers.
            scores: [B, n_objects] scores of the gallery; None if the classifiers alone answer.
        """
        if scores is None:
            return self.gallery.of_classifiers(self.fused(probabilities))
        return self.gallery.combine(self.fused(probabilities) if probabilities else None, scores)
