"""Training protocols, from camera steps to learning rates: the paper's, a more accurate default and a quick one."""

import dataclasses
import enum
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import colornet
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.networks.networks import EMBEDDING, FEATURES, Feature, check_features
from training.augmentation.augmentations import Augmentations
from training.embedding.distractors import AUGMENTATIONS, Distractors
from training.fitting.loop import FitOptions
from training.fitting.samples import MIRRORS
from training.objects.mesh import TexturedMesh
from training.views.mesh_views import RenderJob

__all__ = ["DEFAULT", "PAPER", "QUICK", "Protocol", "Stage"]


class Stage(enum.StrEnum):
    """The stages of a training, in their order; the classifiers are fitted after the first one."""

    DESCRIBE = "describe"
    RENDER_DISTRACTORS = "render distractors"
    DESCRIBE_EMBEDDED = "describe for the embedding"
    FIT_NETWORKS = "fit networks"
    CALIBRATE = "fit the confidence"


DESCRIBE_SHARE = 0.3
"""Time to describe the views, divided by the time to render them; used to estimate the remaining time."""

CALIBRATE_SHARE = 0.1
"""Time to fit the confidence, divided by the time to render the views."""

EPOCH_SHARES = {"ce": 0.05, "tops": 0.08, "tops2": 0.15, EMBEDDING: 0.044}
"""Time of an epoch of a classifier, or of one network of the embedding, divided by the time to render the views."""


@dataclasses.dataclass(frozen=True)
class Protocol:
    """A training protocol: everything that determines a trained run, except the objects.

    Attributes:
        classifiers: descriptors that the classifiers read, any of "ce", "tops", "tops2"; may be empty if there are
            distractors.
        fit: fit options of every classifier; the seed is also used for the embedding.
        config: settings of the descriptor and number of looks in recognition; by default the paper's, in closed form.
        folds: number of folds; if more than one, one model is trained per fold, with the fold as its held-out set.
        mirrors: mirrors in which the classifiers use each view.
        orientation_copies: additional samples of each view in random orientations, for the classifiers.
        distractors: objects on which an embedding is fitted together with the views, before the confidence is
            calibrated; without folds, some views are held out for the calibration. None fits no embedding.
        azimuth_step: degrees between cameras around the object.
        polar_step: degrees between cameras from pole to pole.
        augmentations: augmented copies of each view; None adds none.

    Raises:
        InputError: a classifier is unknown.
    """

    classifiers: Sequence[Feature]
    fit: FitOptions
    config: DescriptorConfig = DescriptorConfig(homology="closed_form")
    folds: int = 1
    mirrors: Sequence[str] = MIRRORS
    orientation_copies: int = 0
    distractors: Distractors | None = None
    azimuth_step: float = 5.0
    polar_step: float = 5.0
    augmentations: Augmentations | None = None

    def __post_init__(self) -> None:
        if self.classifiers or self.distractors is None:
            object.__setattr__(self, "classifiers", check_features(self.classifiers))

    @property
    def network(self) -> colornet.ColorNetwork:
        """The packaged colour network."""
        return colornet.load_default()

    def render_job(self, meshes: Mapping[str, Path | TexturedMesh]) -> RenderJob:
        """Return the job that renders the views of meshes for this protocol, with the seed of the fit."""
        return RenderJob(meshes, self.azimuth_step, self.polar_step, self.augmentations, self.fit.seed)

    @property
    def stages(self) -> dict[str, float]:
        """The stages of the training in order, and the time of each, divided by the time to render the views."""
        of_fold: dict[str, float] = {f"fit {name}": EPOCH_SHARES[name] * self.fit.epochs for name in self.classifiers}
        if self.distractors is not None:
            fit_share = EPOCH_SHARES[EMBEDDING] * self.distractors.networks * self.distractors.epochs
            # Rendering distractors takes no time if they are in the cache.
            of_fold |= {Stage.RENDER_DISTRACTORS: 0.0, Stage.DESCRIBE_EMBEDDED: DESCRIBE_SHARE}
            of_fold |= {Stage.FIT_NETWORKS: fit_share, Stage.CALIBRATE: CALIBRATE_SHARE}
        described = {Stage.DESCRIBE: DESCRIBE_SHARE} if self.classifiers else {}
        prefixes = [""] if self.folds == 1 else [f"fold {fold}: " for fold in range(self.folds)]
        return described | {prefix + stage: share for prefix in prefixes for stage, share in of_fold.items()}

    def record(self, digest: str) -> dict[str, Any]:
        """Return everything that determines the run, in the form in which JSON stores it.

        `digest` is the digest of the labelled views.
        """
        added = {} if self.distractors is None else {"distractors": self.distractors.record}
        return added | {
            "descriptor_version": DESCRIPTOR_VERSION,
            "descriptor_config": dataclasses.asdict(self.config),
            "color_network": self.network.fingerprint,
            "dataset": digest,
            "classifiers": list(self.classifiers),
            "folds": self.folds,
            "mirrors": list(self.mirrors),
            "orientation_copies": self.orientation_copies,
            **dataclasses.asdict(self.fit),
            "learning_rates": list(self.fit.learning_rates),
        }

    def with_distractors(self, procedural: int | None, meshes: Mapping[str, Path | TexturedMesh], workers: int) -> Self:
        """Return the protocol with an embedding fitted on these distractors; if there are none, with classifiers only.

        Args:
            procedural: number of procedural objects; None keeps the protocol's number (0 if it has no embedding).
            meshes: name -> other object.
            workers: rendering processes.

        Raises:
            InputError: as `Distractors`.
        """
        own = self.distractors or Distractors()
        if procedural is None:
            procedural = 0 if self.distractors is None else own.procedural
        if not procedural and not meshes:
            return dataclasses.replace(self, classifiers=self.classifiers or FEATURES, distractors=None)
        others = dataclasses.replace(own, procedural=procedural, meshes=meshes, workers=workers)
        return dataclasses.replace(self, distractors=others)

    def replace(self, **values: Any) -> "Protocol":
        """Return the protocol with new values of its own fields or the fields of `fit`; None keeps a value.

        `epochs` also sets the epochs of the embedding. With `orientation_copies=0`, each view is also used mirrored.

        Raises:
            InputError: a value of the fit is invalid.
        """
        given = {name: value for name, value in values.items() if value is not None}
        if given.get("orientation_copies") == 0 and self.orientation_copies:
            given["mirrors"] = MIRRORS
        distractors = given.get("distractors", self.distractors)
        if distractors is not None and "epochs" in given:
            given["distractors"] = dataclasses.replace(distractors, epochs=given["epochs"])
        of_fit = {field.name for field in dataclasses.fields(FitOptions)} & given.keys()
        fit = dataclasses.replace(self.fit, **{name: given.pop(name) for name in of_fit})
        return dataclasses.replace(self, fit=fit, **given)


DEFAULT = Protocol(
    classifiers=(),
    fit=FitOptions(epochs=16, batch_size=256),
    config=DescriptorConfig(homology="closed_form", looks=4),
    mirrors=("",),
    orientation_copies=1,
    distractors=Distractors(),
    azimuth_step=20.0,
    polar_step=15.0,
    augmentations=AUGMENTATIONS,
)
"""The default: fewer views than the paper, each with five augmented copies, and an embedding instead of classifiers."""

QUICK = dataclasses.replace(DEFAULT, distractors=Distractors(procedural=600, networks=2))
"""The default with fewer distractors and networks, in three quarters of the time."""

PAPER = Protocol(classifiers=FEATURES, fit=FitOptions(epochs=100, batch_size=128), mirrors=("", "x", "y", "xy"))
"""The paper's protocol (section "Training"): 72 x 37 views per object, four mirrors, 100 epochs."""
