"""Training protocols, from camera steps to learning rates: the paper's, the more accurate default, and a quick one."""

import dataclasses
from typing import Any

from thor2_jax.config import DescriptorConfig
from thor2_jax.model.classifier import FEATURES, Feature
from training.augmentation.augmentations import Augmentations
from training.embedding.run_embedding import Distractors
from training.embedding.sampling import AUGMENTATIONS
from training.fitting.options import FitOptions
from training.fitting.samples import MIRRORS, PAPER_MIRRORS

__all__ = ["DEFAULT", "PAPER", "QUICK", "Protocol"]


@dataclasses.dataclass(frozen=True)
class Protocol:
    """A training protocol.

    Attributes:
        azimuth_step: degrees between cameras around the object.
        polar_step: degrees between cameras from pole to pole.
        augmentations: augmented copies of each view; None adds none.
        mirrors: mirrors in which the classifiers use each view.
        orientation_copies: further samples of each view for the classifiers, in random orientations.
        config: descriptor, with the number of looks in recognition.
        fit: fit options of every classifier.
        classifiers: the paper's classifiers to fit beside the embedding.
        distractors: distractors and options of the embedding; None fits no embedding.
    """

    azimuth_step: float
    polar_step: float
    augmentations: Augmentations | None
    mirrors: tuple[str, ...]
    orientation_copies: int
    config: DescriptorConfig
    fit: FitOptions
    classifiers: tuple[Feature, ...] = ()
    distractors: Distractors | None = None

    def replace(self, **values: Any) -> "Protocol":
        """Return the protocol with the given values of its own fields or of `fit`; None keeps the protocol's own.

        Without copies in other orientations, views are also used in a mirror.

        Raises:
            InputError: A value of the fit is invalid.
        """
        given = {name: value for name, value in values.items() if value is not None}
        if given.get("orientation_copies") == 0 and self.orientation_copies:
            given["mirrors"] = MIRRORS
        of_fit = {field.name for field in dataclasses.fields(FitOptions)} & given.keys()
        fit = dataclasses.replace(self.fit, **{name: given.pop(name) for name in of_fit})
        return dataclasses.replace(self, fit=fit, **given)


DEFAULT = Protocol(
    azimuth_step=20.0,
    polar_step=15.0,
    augmentations=AUGMENTATIONS,
    mirrors=("",),
    orientation_copies=1,
    config=DescriptorConfig(homology="closed_form", looks=4),
    fit=FitOptions(epochs=16, batch_size=256),
    distractors=Distractors(),
)
"""Fewer views than the paper's, each with five augmented copies; an embedding, and none of the paper's classifiers."""

QUICK = dataclasses.replace(DEFAULT, distractors=Distractors(procedural=600, networks=2))
"""The default with fewer distractors and networks: half of its time."""

PAPER = Protocol(
    azimuth_step=5.0,
    polar_step=5.0,
    augmentations=None,
    mirrors=PAPER_MIRRORS,
    orientation_copies=0,
    config=DescriptorConfig(homology="closed_form"),
    fit=FitOptions(epochs=100, batch_size=128),
    classifiers=FEATURES,
)
"""The paper's protocol (section "Training"): 72 x 37 views per object, four mirrors, 100 epochs."""
