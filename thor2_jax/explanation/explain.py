"""The explanation of the answer for one instance of a frame.

>>> explanation = explain(recognizer, frame, 3)                                     # doctest: +SKIP
>>> explanation.name, explanation.attributions.values.argmax()                      # doctest: +SKIP
('mug', 1204)

The explained answer is the one of recognition, which fuses all looks. Slices, strips, diagrams and colour matrices are
those of the first look, which is the paper's.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import describe_strips, diagrams, strips
from thor2_jax.errors import InputError
from thor2_jax.explanation.attributions import Attributions, LeftOut, attribute_points, leave_out
from thor2_jax.explanation.changes import CHANGES, Change, smallest_change
from thor2_jax.explanation.class_scores import ClassScores, classifier_scores, gallery_scores, packed
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.prepared_instance import DESCRIPTOR_VOXEL, PreparedInstance, instance_view
from thor2_jax.gallery.enrollment import embed_looks
from thor2_jax.model.inference import answers, infer_clouds, object_scores
from thor2_jax.model.model import Model
from thor2_jax.model.recognition import Recognition
from thor2_jax.recognizer import Recognizer
from thor2_jax.surfaces.evidence import sample_points, search_poses
from thor2_jax.types import Diagrams, PointClouds

__all__ = [
    "Explanation",
    "SurfaceFit",
    "compile_explanations",
    "explain",
    "explain_instance",
    "explained_by_classifiers",
    "pixel_attributions",
    "surface_fits",
]

OBJECTS = 3
"""Number of objects that are shown with their nearest view, and of those shown with their surface."""


@dataclasses.dataclass(frozen=True, eq=False)
class DescribedSlices:
    """The descriptor of the first look at an instance.

    Attributes:
        points: [n, 3] float32, aligned points in scaled units.
        diagrams: persistence diagrams, fields [S, J].
        images: [S, P, P] float32, persistence images.
        colors: [S, J, R] float32, colour matrices.
    """

    points: NDArray[np.float32]
    diagrams: Diagrams
    images: NDArray[np.float32]
    colors: NDArray[np.float32]


@dataclasses.dataclass(frozen=True, eq=False)
class NearestView:
    """An enrolled view.

    Attributes:
        name: name of the object.
        number: number of the view of the object, in the order of enrollment.
        similarity: largest cosine between embeddings of the looks at the instance and at the view, at most 1.
        view: cloud of the view.
    """

    name: str
    number: int
    similarity: float
    view: PreparedInstance


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceFit:
    """How well an instance of n points fits the surface of an object, see `surfaces.evidence`.

    Attributes:
        name: name of the object.
        distance: mean point-to-plane distance, divided by the roughness of the instance (both plus 8 % of its size).
        chroma: correlation of chroma, from -1 to 1.
        lightness: correlation of lightness, from -1 to 1.
        free_space: fraction of the surface in free space.
        of_points: [n] distances of the points from the surface, metres; inf far from it.
    """

    name: str
    distance: float
    chroma: float
    lightness: float
    free_space: float
    of_points: NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Explanation:
    """Explanation of the answer for an instance.

    Attributes:
        recognition: the answer.
        name: the explained name, which is the most probable one, also for an unknown object.
        runner_up: the other name with the best score; None if there is no other name.
        scores: the explained quantity.
        instance: the cloud, n points.
        described: descriptor of the cloud.
        attributions: contributions of the points to the answer.
        left_out: contributions of slices and strips, as the exact check of the attributions.
        changes: the smallest changes that lead to another answer, one for each kind with a result.
        surfaces: comparison with the surfaces of the most probable objects, of those that have one.
        nearest: nearest enrolled views; empty without a gallery.
    """

    recognition: Recognition
    name: str
    runner_up: str | None
    scores: ClassScores
    instance: PreparedInstance
    described: DescribedSlices
    attributions: Attributions
    left_out: LeftOut
    changes: tuple[Change, ...]
    surfaces: tuple[SurfaceFit, ...]
    nearest: tuple[NearestView, ...]

    @property
    def title(self) -> str:
        """The answer as a phrase."""
        return self.name if self.recognition.name is not None else f"unknown, most like {self.name}"

    @property
    def config(self) -> DescriptorConfig:
        """Configuration of the descriptor."""
        return self.scores.config

    def as_json(self) -> dict[str, Any]:
        """Return the explanation as JSON values, with lengths in metres and colours in 0..255."""
        answer, check, left = self.recognition, self.attributions, self.left_out
        cells = np.argwhere(np.isfinite(left.strips))
        return {
            "label": answer.label,
            "name": answer.name,
            "explained_name": self.name,
            "runner_up": self.runner_up,
            "confidence": answer.confidence,
            "reason": answer.reason,
            "unit": self.scores.unit,
            "margin": check.margin,
            "top": {source: [{"name": n, "probability": p} for n, p in best] for source, best in answer.top.items()},
            "faithfulness": {
                "loss_without_most_attributed_tenth": check.most_attributed,
                "mean_loss_without_random_tenth": check.random,
                "holds": check.holds,
            },
            "slices": [{"slice": i, "loss": float(loss)} for i, loss in enumerate(left.slices) if np.isfinite(loss)],
            "strips": [{"slice": int(i), "strip": int(j), "loss": float(left.strips[i, j])} for i, j in cells],
            "agreement": left.agreement,
            "changes": [{k: v for k, v in vars(change).items() if k != "instance"} for change in self.changes],
            "surfaces": [{k: v for k, v in vars(fit).items() if k != "of_points"} for fit in self.surfaces],
            "nearest": [{"name": v.name, "view": v.number, "similarity": v.similarity} for v in self.nearest],
            "points": self.instance.points.astype(float).round(5).tolist(),
            "colors": self.instance.colors.tolist(),
            "attributions": self.attributions.values.astype(float).round(7).tolist(),
        }


def explain(recognizer: Recognizer, frame: RGBDFrame, label: int) -> Explanation:
    """Explain the answer for one instance of a frame.

    The first call with a new padded size of clouds compiles for a minute; later calls take a few seconds.

    Args:
        recognizer: the recognizer.
        frame: the frame.
        label: number of the instance, one of `frame.instances`.

    Raises:
        InputError: there is no such instance, it cannot be described, the model has no object, or the run's descriptor
            has the convention of the released code.
    """
    model = recognizer.model
    return explain_instance(model, model.corrected(instance_view(frame, label, model.run.config.sigma_s)))


def explain_instance(model: Model, instance: PreparedInstance) -> Explanation:
    """Explain the answer for a usable instance; see `explain`."""
    (recognition,), (ranked,) = _recognized(model, [instance])
    scores, names = _scores(model, explained_by_classifiers(model)[ranked[0]]), [model.names[k] for k in ranked]
    parts = dict(_parts(model, scores, instance, names))
    return Explanation(recognition=recognition, name=names[0], scores=scores, instance=instance, **parts)


def _parts(
    model: Model, scores: ClassScores, instance: PreparedInstance, names: Sequence[str]
) -> Iterator[tuple[str, Any]]:
    """Yield the further fields of an explanation with their values; most of them compile for seconds.

    Args:
        model: the model.
        scores: class scores.
        instance: the instance.
        names: names in the order of their probability; the first one is explained.
    """
    scored, index = scores.of_instances([instance])[0], scores.names.index(names[0])
    others = [k for k in np.argsort(-scored, kind="stable") if k != index]
    yield "runner_up", scores.names[others[0]] if others else None
    looks = scores.orient(instance)
    attributions = attribute_points(scores, looks, instance, index)
    yield "attributions", attributions
    yield "left_out", leave_out(scores, looks, index, attributions.values)

    def recognize(instances: Sequence[PreparedInstance]) -> list[str]:
        return [model.names[best] for best in _recognized(model, instances)[1][:, 0]]

    kinds = CHANGES if len(model.names) > 1 else ()
    changes = [smallest_change(scores, recognize, instance, looks, index, kind) for kind in kinds]
    yield "changes", tuple(change for change in changes if change is not None)
    yield "described", _described(scores, looks, len(instance.points))
    yield "surfaces", tuple(surface_fits(model, instance, names))
    yield "nearest", tuple(_nearest_views(model, instance))


def compile_explanations(model: Model, n_points: int, by_classifiers: bool, is_stopped: Callable[[], bool]) -> None:
    """Compile the functions for explanations of clouds of a padded size.

    Args:
        model: the model.
        n_points: padded size.
        by_classifiers: whether the classifiers are explained, otherwise the gallery; see `explained_by_classifiers`.
        is_stopped: function that returns whether to end early; called between steps, which take seconds.
    """
    if by_classifiers not in explained_by_classifiers(model):  # The last object of this kind has been forgotten.
        return
    rng = np.random.default_rng(0)
    points = rng.uniform(0, (0.12, 0.08, 0.05), (n_points, 3)).astype(np.float32)
    instance = PreparedInstance(1, points, rng.integers(0, 256, (n_points, 3), np.uint8), np.zeros(n_points, bool))
    _recognized(model, [instance])
    scores = _scores(model, by_classifiers)
    parts = _parts(model, scores, instance, scores.names)
    while not is_stopped() and next(parts, None) is not None:
        pass


def explained_by_classifiers(model: Model) -> list[bool]:
    """Return for each of the model's names whether the classifiers explain it, otherwise the gallery."""
    return (model.gallery.has_output & (model.answers_by() != "gallery")).tolist()


def _scores(model: Model, by_classifiers: bool) -> ClassScores:
    return classifier_scores(model) if by_classifiers else gallery_scores(model)


def _recognized(model: Model, instances: Sequence[PreparedInstance]) -> tuple[list[Recognition], NDArray[np.intp]]:
    """Return the answers for instances, and their ranked names [B, n], the best first."""
    if not model.names:
        raise InputError("no object is known; train a run or enroll an object")
    rows = [infer_clouds(model, clouds) for clouds in packed(instances)]
    inference = jax.tree.map(lambda *arrays: np.concatenate(arrays)[: len(instances)], *rows)
    probabilities = model.combined(inference.probabilities, object_scores(model, inference))
    return answers(model, instances, inference), np.argsort(-probabilities, kind="stable")


def _described(scores: ClassScores, looks: PointClouds, n: int) -> DescribedSlices:
    repeated = scores.repeat(looks)  # recognition has compiled programs for this number
    cut = strips(repeated, scores.network, scores.config)
    images = describe_strips(cut, scores.network, scores.config).images
    every = diagrams(repeated, scores.config), images, cut.color
    return DescribedSlices(np.asarray(looks.points)[0, :n], *jax.tree.map(lambda a: np.asarray(a)[0], every))


def surface_fits(model: Model, instance: PreparedInstance, names: Sequence[str]) -> Iterator[SurfaceFit]:
    """Yield the comparison with the surfaces of the first `OBJECTS` of the named objects that have one."""
    samples = sample_points(next(packed([instance])))  # The further rows are empty, and take no time.
    unused = model.run.surfaces if model.answers_by() == "gallery" else None
    known = ((name, found) for name in names if (found := model.surface_of(name)) and found[0] is not unused)
    for name, (surfaces, index) in itertools.islice(known, OBJECTS):
        values, poses = map(np.asarray, search_poses(surfaces, samples, np.full(len(samples.is_skipped), index)))
        fit, chroma, lightness, free = values[0].tolist()
        of_points = surfaces.distances(index, poses[0], instance.points)
        yield SurfaceFit(name, math.exp(fit), chroma, lightness, free, of_points)


def _nearest_views(model: Model, instance: PreparedInstance) -> list[NearestView]:
    """Return the nearest view of each of the most similar enrolled objects, the most similar object first.

    Args:
        model: the model; if its gallery is empty, so is the result.
        instance: the instance.
    """
    objects = model.gallery.objects
    if not objects:
        return []
    scores = gallery_scores(model).of_instances([instance])[0]
    query = embed_looks(model.embedding, [instance])[0]
    nearest = []
    for index in np.argsort(-scores, kind="stable")[:OBJECTS]:
        name = model.gallery.names[index]
        views = list(objects[name].clouds.views())
        cosines = (embed_looks(model.embedding, views) @ query.T).max(axis=(1, 2))
        number = int(cosines.argmax())
        nearest.append(NearestView(name, number, float(cosines[number]), views[number]))
    return sorted(nearest, key=lambda one: -one.similarity)


def pixel_attributions(explanation: Explanation, frame: RGBDFrame) -> NDArray[np.float32]:
    """Return the attribution of the nearest point of the cloud for each pixel of the instance, [H, W].

    Pixels of the background and pixels whose depth is not in the cloud, such as outliers, are NaN.
    """
    pixels = frame.instance_pixels[explanation.instance.label]
    points = frame.points(pixels)
    reach = 2 * DESCRIPTOR_VOXEL / explanation.config.sigma_s
    distance, nearest = KDTree(explanation.instance.points).query(points, distance_upper_bound=reach)
    near = np.isfinite(distance) & (points[:, 2] > 0)
    painted = np.full(frame.depth.size, np.nan, np.float32)
    painted[pixels[near]] = explanation.attributions.values[nearest[near]]
    return painted.reshape(frame.depth.shape)
