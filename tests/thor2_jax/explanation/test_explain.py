"""Explanations, against independent computations and against toys whose answer is known."""

import dataclasses
import io
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from refusals import assert_refused
from scipy.special import logit
from slow_tier import slow
from small_clouds import NETWORK
from small_runs import SMALL_CONFIG, class_probabilities, untrained_embedding_run, untrained_run

import thor2_jax as thor2
from thor2_jax.descriptor.looks import LookDescriptors, describe_looks, side_lengths
from thor2_jax.descriptor.slicing import region_sets, relaxed_strips
from thor2_jax.explanation import attributions, pictures
from thor2_jax.explanation.changes import CHANGES, Change, changed_instance, smallest_change
from thor2_jax.explanation.class_scores import ClassScores, classifier_scores, gallery_scores, packed
from thor2_jax.explanation.explain import Explanation, explain, pixel_attributions, surface_fits
from thor2_jax.figures import png_bytes
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances, prepare_instance
from thor2_jax.model.fusion import Calibration
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.surfaces.evidence import sample_points, search_poses
from training.objects.builtin_objects import builtin_objects
from training.objects.surfaces import surfaces_of
from training.rendering.camera import camera_pose
from training.views.mesh_views import view_cloud

pytestmark = pytest.mark.usefixtures("small_buckets")

CLASSES = ("a", "b", "c")
FOUR = dataclasses.replace(SMALL_CONFIG, looks=4)

LABELS = np.zeros((120, 160), np.uint8)
LABELS[10:60, 10:45], LABELS[10:40, 75:125], LABELS[100:103, 5:8] = 3, 7, 5
DEPTH = np.broadcast_to(600 + np.arange(160) // 2, LABELS.shape).astype(np.uint16)
COLOR = np.zeros((*LABELS.shape, 3), np.uint8)
COLOR[:35], COLOR[35:] = (200, 30, 30), (30, 30, 200)
FRAME = thor2.RGBDFrame(COLOR, DEPTH, LABELS, thor2.Intrinsics(300.0, 300.0, 79.5, 59.5))
"""Two usable instances of a tilted plane, half red and half blue, and one that is too small."""

INSTANCE = prepare_instance(FRAME, 3, FOUR.sigma_s)


@pytest.fixture(scope="module")
def recognizer() -> thor2.Recognizer:
    return thor2.Recognizer(untrained_run(CLASSES, config=FOUR))


@pytest.fixture(scope="module")
def explanation(recognizer: thor2.Recognizer) -> Explanation:
    return explain(recognizer, FRAME, 3)


def toy(score: Callable[[LookDescriptors], Any]) -> ClassScores:
    """Return scores of two names: 0, and a function of the descriptors."""

    def scores(oriented: LookDescriptors) -> jax.Array:
        value = score(oriented)
        return jnp.stack([jnp.zeros_like(value), value], axis=1)

    of_descriptors, names = jax.tree_util.Partial(scores), ("plain", "special")
    return ClassScores("log-odds", SMALL_CONFIG, NETWORK, SMALL_CONFIG.looks, of_descriptors, names)


@pytest.mark.parametrize("rule", ["log-mean", *slow("max", "mean")])
@pytest.mark.parametrize("make_run", [untrained_run, *slow(untrained_embedding_run)])
def test_margin_is_the_log_odds_of_the_answer(rule: str, make_run: Callable[..., TrainedRun]) -> None:
    recognizer = thor2.Recognizer(make_run(CLASSES, config=FOUR), rule=rule)
    (answer,) = [one for one in recognizer.recognize(FRAME) if one.label == 3]
    scores = classifier_scores(recognizer.model)
    values = scores.of_instances([INSTANCE])
    of_masks = scores.of_masks(scores.orient(INSTANCE), np.ones((9, len(INSTANCE.points)), bool))
    np.testing.assert_allclose(of_masks, values.repeat(9, axis=0), atol=1e-4)  # in more than one batch
    index = CLASSES.index(str(answer.name))
    assert values[0].argmax() == index
    assert float(scores.margin(jnp.asarray(values), index)[0]) == pytest.approx(logit(answer.confidence), abs=1e-3)


@pytest.mark.slow
def test_the_margin_of_a_calibrated_answer_is_that_among_the_classes() -> None:
    record = {"calibration": dataclasses.asdict(Calibration(0.0, 1.0, 1.0, 0.5, 0.0))}
    recognizer = thor2.Recognizer(untrained_embedding_run(CLASSES, config=FOUR, record=record))
    explanation = explain(recognizer, FRAME, 3)
    (answer,) = [one for one in recognizer.recognize(FRAME) if one.label == 3]
    assert explanation.name == answer.name and set(explanation.recognition.top) == {"embedding"}
    assert explanation.recognition.confidence == pytest.approx(answer.confidence, abs=1e-5)
    described = describe_looks(pack_instances([INSTANCE], 1), NETWORK, FOUR)
    probabilities = class_probabilities(recognizer, described)["embedding"][0]
    share = float(probabilities.max() / probabilities.sum())
    assert explanation.attributions.margin == pytest.approx(logit(share), abs=1e-3)


@pytest.mark.parametrize("looks", [*slow(1, 2), 4])
def test_a_gallery_is_explained_by_the_looks_of_recognition(looks: int) -> None:
    run = untrained_embedding_run(CLASSES, config=dataclasses.replace(SMALL_CONFIG, looks=looks))
    recognizer = thor2.Recognizer(run)
    recognizer.enroll("mixed", [(FRAME, 3)])
    instances, inference = recognizer.infer(recognizer.prepare(FRAME))
    usable = [one for one in instances if one.reason is None]
    embeddings = np.asarray(inference.embeddings)[: len(usable)]
    assert embeddings.shape[1] == 2
    cosines = embeddings @ recognizer.gallery.objects["mixed"].embeddings.astype(np.float32).T
    expected = cosines.max(axis=-1).mean(axis=1)
    np.testing.assert_allclose(gallery_scores(recognizer.model).of_instances(usable)[:, 0], expected, atol=1e-5)


def test_forgotten_classes_have_no_score() -> None:
    recognizer = thor2.Recognizer(untrained_run(CLASSES, config=FOUR))
    whole = classifier_scores(recognizer.model).of_instances([INSTANCE])
    recognizer.forget("b")
    scores = classifier_scores(recognizer.model)
    assert scores.names == ("a", "c")
    np.testing.assert_allclose(scores.of_instances([INSTANCE]), whole[:, [0, 2]], rtol=1e-5)


def test_selected_points_keep_their_flags() -> None:
    kept = np.arange(len(INSTANCE.points)) % 3 > 0
    packed = pack_instances([attributions.select_points(INSTANCE, kept)], 1)
    assert INSTANCE.rim is not None and packed.rim is not None
    np.testing.assert_array_equal(packed.rim[0, : kept.sum()], INSTANCE.rim[kept])
    assert attributions.select_points(dataclasses.replace(INSTANCE, rim=None), kept).rim is None


RED = np.asarray(NETWORK.membership(np.array([200, 30, 30], np.uint8))) > 0


def redness(oriented: LookDescriptors) -> jax.Array:
    """Return the number of red points; E = (C Delta)^T, so that the inverse of Delta gives back the colour vectors."""
    counts = jnp.einsum("bksrj,rq->bq", oriented.each.embeddings, np.linalg.inv(NETWORK.similarity))
    return counts[:, RED].sum(axis=1) / 100


REDNESS = toy(redness)


def test_a_left_out_slice_is_an_empty_slice() -> None:
    left = attributions.leave_out(REDNESS, REDNESS.orient(INSTANCE), 1, np.zeros(len(INSTANCE.points), np.float32))
    looks = describe_looks(pack_instances([INSTANCE], 1), NETWORK, SMALL_CONFIG)
    margin = jax.jit(lambda o: REDNESS.margin(REDNESS.of_descriptors(o), 1)[0])
    for number in range(2):
        kept = (np.arange(2) != number).reshape(2, 1, 1)
        each = dataclasses.replace(looks.each, images=looks.each.images * kept, embeddings=looks.each.embeddings * kept)
        expected = float(margin(looks) - margin(dataclasses.replace(looks, each=each)))
        assert left.slices[number] == pytest.approx(expected, abs=1e-3)
    assert left.agreement is None  # all attributions are equal


@pytest.mark.slow
def test_attributions_are_complete(recognizer: thor2.Recognizer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean gradient on the path, summed over the points, is the slope of the margin from half to whole weights."""
    monkeypatch.setattr(attributions, "STEPS", 32)
    scores = classifier_scores(recognizer.model)
    gradients = attributions.path_gradients(scores, scores.orient(INSTANCE), 1)
    assert gradients.shape[0] == 32 and not gradients[:, len(INSTANCE.points) :].any()
    config, aligned = dataclasses.replace(scores.config, relaxation=attributions.RELAXATION), scores.orient(INSTANCE)
    sets, ends = region_sets(NETWORK), []
    for weight in (0.5, 1.0):
        weights = jnp.full(aligned.mask.shape[1], weight, jnp.float32)
        cut = jax.vmap(lambda *cloud, w=weights: relaxed_strips(cloud[0].T, *cloud[1:], sets, config, w))
        oriented = scores.describe(aligned, cut(aligned.points, aligned.colors, aligned.mask), config)
        ends.append(float(scores.margin(scores.of_descriptors(oriented), 1)[0]))
    assert gradients.mean(axis=0).sum() == pytest.approx((ends[1] - ends[0]) / 0.5, rel=0.1, abs=0.02)


def test_weightless_points_are_left_out() -> None:
    config = dataclasses.replace(SMALL_CONFIG, relaxation=attributions.RELAXATION)
    aligned = thor2.align(pack_instances([INSTANCE], 1), config)
    cloud = jax.tree.map(lambda a: a[0], aligned)
    some = jnp.arange(len(cloud.mask)) % 3 > 0
    sets = region_sets(NETWORK)

    @jax.jit
    def both(some: jax.Array) -> tuple[thor2.Strips, thor2.Strips]:
        arguments = cloud.points.T, cloud.colors
        weighted = relaxed_strips(*arguments, cloud.mask, sets, config, some.astype(jnp.float32))
        return weighted, relaxed_strips(*arguments, cloud.mask & some, sets, config)

    weighted, masked = both(some)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), weighted, masked)


def test_points_of_the_decisive_color_are_found() -> None:
    cloud = REDNESS.orient(INSTANCE)
    attributed = attributions.attribute_points(REDNESS, cloud, INSTANCE, 1)
    is_red = INSTANCE.colors[:, 0] > INSTANCE.colors[:, 2]
    aligned = np.asarray(cloud.points[0])[: len(INSTANCE.points)]
    inside = (aligned[:, 0] < 0.125) & (aligned[:, 2] < 0.2)  # within 5 strips and 2 slices
    assert attributed.values[is_red & inside].min() > 5 * np.abs(attributed.values[~is_red]).max()
    assert attributed.holds and attributed.most_attributed > 0


def test_smoothing_averages_over_neighbours() -> None:
    rng = np.random.default_rng(0)
    points, values = (rng.random(shape).astype(np.float32) for shape in ((200, 3), (2, 200)))
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    weights = np.exp(-((distances / 0.1) ** 2) / 2) * (distances <= 0.2)
    expected = values @ weights / weights.sum(axis=0)
    np.testing.assert_allclose(attributions.smooth(points, values, 0.1), expected, rtol=1e-5)


@pytest.mark.slow
def test_smallest_change_is_smallest_and_confirmed() -> None:
    def width(oriented: LookDescriptors) -> jax.Array:
        return -oriented.each.images.sum(axis=(1, 2, 3, 4))

    threshold = -0.75 * float(toy(width).of_instances([INSTANCE])[0, 1])
    scores = toy(lambda oriented: width(oriented) + threshold)
    assert scores.of_instances([INSTANCE])[0].argmax() == 0

    def best(instances: Sequence[PreparedInstance]) -> list[str]:
        return [scores.names[k] for k in scores.of_instances(instances).argmax(axis=1)]

    looks = scores.orient(INSTANCE)
    change = smallest_change(scores, best, INSTANCE, looks, 0, "extent")
    assert change is not None and change.answer == "special"
    less = dataclasses.replace(INSTANCE, points=0.1 * INSTANCE.points + 0.9 * change.instance.points)
    assert best([change.instance, less]) == ["special", "plain"]
    sides = [side_lengths(each, SMALL_CONFIG.alpha)[0] for each in (looks, scores.orient(change.instance))]
    np.testing.assert_allclose(sides[1] / sides[0], change.values, rtol=0.01)
    alone = dataclasses.replace(scores, names=("plain",))  # as the only enrolled object beside trained classes
    assert getattr(smallest_change(alone, best, INSTANCE, looks, 0, "extent"), "values", None) == change.values
    for kind in CHANGES:  # recognition gives no other name, whatever the scores are
        assert smallest_change(scores, lambda rows: ["plain"] * len(rows), INSTANCE, looks, 0, kind) is None


def test_changed_extents_keep_the_other_sides() -> None:
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    changed = changed_instance(INSTANCE, "extent", np.log([1.5, 1.0, 0.5]), axes)
    before, after = (np.ptp(one.points @ axes.T, axis=0) for one in (INSTANCE, changed))
    np.testing.assert_allclose(after / before, [1.5, 1.0, 0.5], rtol=1e-3)
    shifted = changed_instance(INSTANCE, "color", np.array([0.1, 0, -1]), axes)
    np.testing.assert_allclose(shifted.colors[:, 0], np.minimum(INSTANCE.colors[:, 0] + 25.5, 255), atol=0.51)
    assert not shifted.colors[:, 2].any()
    assert " -0 " not in pictures.change_text(Change("extent", (0.9, 0.999, 1.25), 0.25, "bowl", INSTANCE))


@pytest.mark.slow
def test_an_explanation_has_its_parts(explanation: Explanation, recognizer: thor2.Recognizer) -> None:
    """Its check removes the most attributed tenth; pixels have the value of their point."""
    (answer,) = [one for one in recognizer.recognize(FRAME) if one.label == 3]
    assert explanation.name == answer.name and explanation.runner_up in set(CLASSES) - {answer.name}
    assert explanation.recognition.confidence == pytest.approx(answer.confidence, abs=1e-5)
    instance, check, scores = explanation.instance, explanation.attributions, explanation.scores
    n = len(instance.points)
    assert check.values.shape == (n,) and np.isfinite(check.values).all()
    described = thor2.describe(pack_instances([instance], 1), NETWORK, SMALL_CONFIG)
    np.testing.assert_allclose(explanation.described.images, described.images[0], atol=1e-5)
    record = explanation.as_json()
    assert len(record["points"]) == len(record["attributions"]) == n
    assert record["margin"] == pytest.approx(logit(answer.confidence), abs=1e-3)
    assert record["nearest"] == [] and {strip["slice"] for strip in record["strips"]} <= {0, 1}

    kept = np.sort(np.argsort(-check.values, kind="stable")[attributions.tenth_of(n) :])
    rest = scores.of_instances([attributions.select_points(instance, kept)])
    margin = float(scores.margin(jnp.asarray(rest), scores.names.index(explanation.name))[0])
    assert check.margin - margin == pytest.approx(check.most_attributed, abs=1e-3)

    painted = pixel_attributions(explanation, FRAME)
    known = np.isfinite(painted)
    assert known.sum() > 0.8 * (FRAME.labels == 3).sum() and not known[FRAME.labels != 3].any()
    row, column = np.argwhere(known)[100]
    depth = FRAME.depth[row, column] / 1000
    point = np.array([(column - 79.5) / 300 * depth, (row - 59.5) / 300 * depth, depth])
    assert painted[row, column] == check.values[np.linalg.norm(instance.points - point, axis=1).argmin()]


@pytest.mark.slow
def test_gallery_answers_are_explained() -> None:
    recognizer = thor2.Recognizer(untrained_run((), features=()))
    recognizer.enroll("red", [(FRAME, 7)])
    recognizer.enroll("mixed", [(FRAME, 3)])
    explanation = explain(recognizer, FRAME, 3)
    assert explanation.name == "mixed" and explanation.scores.unit == "similarity"
    assert [one.name for one in explanation.nearest] == ["mixed", "red"]
    nearest = explanation.nearest[0]
    assert nearest.similarity == pytest.approx(1, abs=0.01) and nearest.number == 0
    np.testing.assert_allclose(nearest.view.points, explanation.instance.points, atol=1e-4)
    assert explanation.attributions.margin > 0


def test_an_instance_is_compared_with_the_surfaces_of_objects(explanation: Explanation) -> None:
    meshes = [builtin_objects()[name] for name in ("soup_can_red", "yellow_box", "banana")]
    surfaces = surfaces_of(meshes)
    recognizer = thor2.Recognizer(dataclasses.replace(untrained_embedding_run(CLASSES), surfaces=surfaces))
    recognizer.enroll("without a surface", [(FRAME, 7)])
    for own, mesh in zip(CLASSES, meshes, strict=True):
        points, colors = view_cloud(mesh, camera_pose(0.4, 1.1, mesh.centre))
        instance = PreparedInstance(1, points, np.rint(255 * colors).astype(np.uint8), np.zeros(len(points), bool))
        names = ["without a surface", own, *sorted({*CLASSES} - {own})]
        first, *others = fits = list(surface_fits(recognizer.model, instance, names))
        assert [fit.name for fit in fits] == names[1:]
        assert np.quantile(first.of_points, 0.95) < 0.004 and first.distance < min(fit.distance for fit in others)
        samples = sample_points(next(packed([instance])))
        of_own = search_poses(surfaces, samples, np.full(len(samples.points), CLASSES.index(own)))[0][0]
        values = np.log(first.distance), first.chroma, first.lightness, first.free_space
        np.testing.assert_allclose(values, of_own, atol=1e-5)
    recognizer.enroll(own, [(FRAME, 3)], extend=True)  # only its views answer
    by_gallery = dataclasses.replace(recognizer.model, answer_by="gallery")
    assert not list(surface_fits(by_gallery, instance, names))
    left = dataclasses.replace(explanation.left_out, slices=np.array([np.nan, 0.5]))
    compared = dataclasses.replace(explanation, instance=instance, surfaces=tuple(fits), left_out=left)
    assert compared.as_json()["slices"] == [{"slice": 1, "loss": 0.5}]  # JSON has no NaN
    assert compared.as_json()["surfaces"][0] == {
        "name": own, "distance": first.distance, "chroma": first.chroma, "lightness": first.lightness, "free_space": 0.0
    }  # fmt: skip
    figure = pictures._surfaces(compared).figure
    shown = [axes.collections[0].get_facecolor()[:, :3] for axes in figure.axes[:3]]
    yellow = [(colors[:, 0] > 0.7).mean() for colors in shown]
    assert yellow[0] > 0.9 > max(yellow[1:])


def test_errors_name_the_argument(recognizer: thor2.Recognizer) -> None:
    for label, match in ((4, "^instance is 4; expected one of 3, 5, 7"), (5, "^instance 5 cannot be used: ")):
        assert_refused(match, explain, recognizer, FRAME, label)
    assert_refused("no object", explain, thor2.Recognizer(untrained_run((), features=())), FRAME, 3)
    released = thor2.DescriptorConfig.released(n_slices=2, n_strips=5, image_size=8)
    assert_refused("convention", explain, thor2.Recognizer(untrained_run(CLASSES, config=released)), FRAME, 3)


def test_texts_of_pictures_are_inside(explanation: Explanation) -> None:
    """Titles touched each other or the border of a tall photo; labels of a flat cloud and of slices were cut off."""
    points = explanation.instance.points
    flat = (points - points.min(axis=0)) / np.ptp(points, axis=0) * [0.144, 0.03744, 0.03] - [0.5, 0.055, -1]
    instance = dataclasses.replace(explanation.instance, points=flat.astype(np.float32))
    tall = dataclasses.replace(FRAME, labels=np.where(np.arange(len(LABELS))[:, None] < 58, LABELS, 0))
    aligned = np.linspace([0, 0, 0], [0.27, 0.1, 0.28], len(points), dtype=np.float32)
    described = dataclasses.replace(explanation.described, points=aligned)
    changed = dataclasses.replace(explanation, instance=instance, described=described)
    for picture in pictures.pictures(changed, tall):
        pixels = np.asarray(Image.open(io.BytesIO(png_bytes(picture.figure))))
        assert all((border == 255).all() for border in (pixels[:2], pixels[:, :2])), picture.title
    narrow = dataclasses.replace(instance, points=instance.points[:, [1, 0, 2]])
    thin = dataclasses.replace(narrow, points=narrow.points * [0.4, 1, 1])
    figure = pictures._decided_cloud(dataclasses.replace(explanation, instance=thin)).figure
    figure.draw_without_rendering()
    numbers = [label.get_window_extent() for label in figure.axes[0].get_xticklabels()]
    assert all(one.x1 < other.x0 for one, other in itertools.pairwise(numbers))
    figure = pictures._clouds([("052_extra_large_clamp" * 2, narrow)] * 3)
    figure.draw_without_rendering()
    first, second, third = (axes.title.get_window_extent() for axes in figure.axes[:3])
    assert first.x1 < second.x0 and second.x1 < third.x0
