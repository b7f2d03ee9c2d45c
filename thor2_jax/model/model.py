"""The model: everything that determines the answer for an instance, as one immutable value.

>>> model = Model.of_run(load_run("run"), unknown_below=0.5)                        # doctest: +SKIP
>>> dataclasses.replace(model, color_transform=transform)                           # doctest: +SKIP

`thor2_jax.model.inference` evaluates it.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.frames.color_transform import ColorTransform
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery.embedding import Embedding, load_default
from thor2_jax.gallery.gallery import Gallery
from thor2_jax.gallery.union import ClassUnion
from thor2_jax.model.classifier import EMBEDDING, RunClassifiers
from thor2_jax.model.fusion import DEFAULT_RULE, FUSION_RULES, Calibration, FusionRule, fused_probabilities
from thor2_jax.model.recognition import AnswerBy, check_answer_by
from thor2_jax.model.run_directory import TrainedRun

__all__ = ["Model"]

T = TypeVar("T")


def _stored_value(kind: type[T], name: str, record: Mapping[str, Any], remedy: str) -> T | None:
    """Return a dataclass instance from the record of a run; None if the record does not have it.

    Args:
        kind: the dataclass; its own checks apply.
        name: name of the value in the record.
        record: the record, as JSON holds it; the value is a mapping of field names to values.
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


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """A trained run and enrolled objects; an immutable value.

    Attributes:
        run: the trained run.
        classifiers: its compiled classifiers.
        gallery: the enrolled objects.
        unknown_below: least confidence, from 0 to 1, of an answer with any name; None for those of `thresholds`.
        rule: fusion rule of the classifiers, see `fusion`; the paper's is "max".
        answer_by: source of the answers, see `answers_by`; None for that of the run's record.
        color_transform: corrects the colours of every instance; None changes nothing.
    """

    run: TrainedRun
    classifiers: RunClassifiers
    gallery: Gallery
    unknown_below: float | None = None
    rule: FusionRule = DEFAULT_RULE
    answer_by: AnswerBy | None = None
    color_transform: ColorTransform | None = None

    def __post_init__(self) -> None:
        if self.rule not in FUSION_RULES:
            raise InputError(f"rule is {self.rule!r}; expected one of {', '.join(FUSION_RULES)}")
        if self.unknown_below is not None and not 0 <= self.unknown_below <= 1:
            raise InputError(f"unknown_below is {self.unknown_below}; expected a confidence from 0 to 1")

    @classmethod
    def of_run(
        cls,
        run: TrainedRun,
        unknown_below: float | None = None,
        rule: FusionRule = DEFAULT_RULE,
        answer_by: str | None = None,
    ) -> "Model":
        """Return the model of a run, with the colour transform of its record, and without enrolled objects.

        Raises:
            InputError: `unknown_below` is not between 0 and 1, or `rule` or `answer_by` is unknown.
        """
        wanted = check_answer_by(answer_by) or check_answer_by(run.record.get("answer_by"))
        classifiers = RunClassifiers.compiled(run.classifiers, run.embedding_classifier)
        transform = _stored_value(ColorTransform, "color_transform", run.record, "adapt the run again")
        return cls(run, classifiers, Gallery("", trained=run.classes), unknown_below, rule, wanted, transform)

    @functools.cached_property
    def calibration(self) -> Calibration | None:
        """Turns fused probabilities into confidences; None in runs without one."""
        return _stored_value(Calibration, "calibration", self.run.record, "train the run again")

    @property
    def union(self) -> ClassUnion:
        """The trained classes and the enrolled objects."""
        return self.gallery.union

    @property
    def names(self) -> tuple[str, ...]:
        """All names that may be answered: trained classes, without forgotten ones, and enrolled objects."""
        return self.union.names

    @property
    def embedding(self) -> Embedding:
        """The embedding of the enrolled objects: that of the run, or the packaged one."""
        return self.run.embedding or load_default()

    def answers_by(self, answer_by: str | None = None) -> AnswerBy:
        """Return the source of the answers: "classifiers", "gallery" or "both".

        Args:
            answer_by: the wanted source; by default that of the model. Without classifiers it is always the gallery,
                with an empty gallery always the classifiers, and otherwise both by default.
        """
        wanted = check_answer_by(answer_by) or self.answer_by
        if not self.classifiers:
            return "gallery"
        if not self.gallery.objects:
            return "classifiers"
        return wanted or "both"

    def thresholds(self, answer_by: str | None = None) -> NDArray[np.float64]:
        """Return the least confidence [n] of an answer with each of the `names`; with `unknown_below`, it is that.

        By default it is the confidence that 95 % of the correct answers on held-out views or frames reach (97 % in runs
        of earlier versions). That of a class with an output of the classifiers is the run's own, measured on held-out
        views, or 0 in runs without one. That of other objects, and of all where the gallery alone answers, depends on
        the number of their views, see `Gallery.unknown_below`.

        Args:
            answer_by: source of the answers, see `answers_by`.
        """
        if self.unknown_below is not None:
            return np.full(len(self.names), self.unknown_below)
        thresholds = self.union.of_gallery(self.gallery.unknown_below[None])[0]
        if self.answers_by(answer_by) == "gallery":
            return thresholds
        return np.where(self.union.has_output, self.calibration.unknown_below if self.calibration else 0.0, thresholds)

    def corrected(self, instance: PreparedInstance) -> PreparedInstance:
        """Return an instance with the colours that `color_transform` makes of those of the camera."""
        if self.color_transform is None:
            return instance
        return dataclasses.replace(instance, colors=self.color_transform(instance.colors))

    def fused(self, probabilities: Mapping[str, NDArray[np.float32]]) -> NDArray[np.floating[Any]]:
        """Return the fused class probabilities [B, C] of the classifiers.

        The embedding is not fused with others. Where the run is calibrated, it scales their fused probabilities, so
        that the largest one is the confidence.
        """
        others = {name: values for name, values in probabilities.items() if name != EMBEDDING}
        # The default rule normalizes the probabilities of the embedding, which lack that of being none of the classes.
        fused = fused_probabilities(others or probabilities, self.rule if others else DEFAULT_RULE)
        if self.calibration is None or EMBEDDING not in probabilities:
            return fused
        return self.calibration.calibrated(fused, probabilities[EMBEDDING])

    def combined(
        self, probabilities: Mapping[str, NDArray[np.float32]], scores: NDArray[np.float32] | None
    ) -> NDArray[np.floating[Any]]:
        """Return the values [B, n] of all `names`, whose largest one is the answer and its confidence.

        Args:
            probabilities: classifier -> class probabilities [B, C]; empty if the gallery alone answers.
            scores: [B, n_objects] of the gallery; None if the classifiers alone answer.
        """
        if scores is None:
            return self.union.of_classifiers(self.fused(probabilities))
        return self.union.combine(self.fused(probabilities) if probabilities else None, scores)
