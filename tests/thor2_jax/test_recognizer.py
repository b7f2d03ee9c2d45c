"""Recognition of frames by classifiers with random weights: everything except the accuracy is checked."""

import dataclasses
import pickle
import re
from typing import Any
from unittest import mock

import jax
import numpy as np
import pytest
from image_files import frame_of_squares, patches, tilted
from refusals import assert_refused
from scipy.stats import gmean
from small_clouds import random_clouds
from small_runs import class_probabilities, small_embedding, untrained_embedding_run, untrained_run, with_surfaces

import thor2_jax as thor2
from thor2_jax.descriptor.looks import describe_looks
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.model.inference import Inference, answers, infer
from thor2_jax.model.recognition import Recognition
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.networks import feature_of
from thor2_jax.recognizer import THOR2, Recognizer
from thor2_jax.surfaces.evidence import fit_poses, sample_points, with_evidence
from training.objects.builtin_objects import builtin_objects
from training.objects.surfaces import surfaces_of

pytestmark = pytest.mark.usefixtures("small_buckets")

CLASSES = ("a", "b", "c", "d")


@pytest.fixture(scope="module")
def run() -> TrainedRun:
    return untrained_run(CLASSES)


@pytest.fixture(scope="module")
def recognizer(run: TrainedRun) -> Recognizer:
    return Recognizer(run)


def test_every_instance_is_answered_in_the_order_of_labels(recognizer: Recognizer) -> None:
    answers = recognizer.recognize(tilted(patches()))
    assert [a.label for a in answers] == [3, 5, 7, 200]
    assert answers[1].name is None and answers[1].confidence is None
    assert answers[1].reason is not None and "30" in answers[1].reason
    for answer in (answers[0], answers[2], answers[3]):
        assert answer.name in CLASSES and answer.reason is None and not answer.occluded
        assert answer.points_used > 30 and answer.overflow >= 0
    assert recognizer.recognize(tilted(np.zeros((240, 320), np.uint8))) == []


def test_a_recognizer_can_be_sent_to_another_process() -> None:
    recognizer, frame = Recognizer(untrained_embedding_run(CLASSES), 0.1, "max"), tilted(patches())
    expected = repr(recognizer.recognize(frame))
    assert repr(pickle.loads(pickle.dumps(recognizer)).recognize(frame)) == expected


@pytest.mark.parametrize("rule", [None, "max"])
def test_answers_are_those_of_the_fused_classifiers(run: TrainedRun, rule: str | None) -> None:
    """By default, the probabilities are fused by the mean of their logarithms."""
    recognizer = Recognizer(run) if rule is None else Recognizer(run, rule=rule)  # type: ignore[arg-type]
    described = recognizer.describe(tilted(patches()))
    probabilities = class_probabilities(recognizer, described.oriented)
    for name, classifier in run.classifiers.items():
        expected = jax.nn.softmax(classifier(feature_of(described.descriptors, name)))
        np.testing.assert_allclose(probabilities[name], expected, atol=1e-5)
    recognized = [answer for answer in recognizer.recognize(tilted(patches())) if answer.reason is None]
    for row, answer in enumerate(recognized):
        pair = np.array([probabilities[name][row] for name in THOR2], np.float64)
        fused = pair[pair.max(axis=1).argmax()] if rule == "max" else gmean(pair) / gmean(pair).sum()
        best = int(fused.argmax())
        assert answer.name == CLASSES[best] and answer.confidence == pytest.approx(fused[best], rel=1e-6)
        assert answer.classifier == THOR2[pair[:, best].argmax()] and tuple(answer.top) == THOR2
        for shares, top in zip(pair, answer.top.values(), strict=True):
            assert dict(top) == pytest.approx(dict(zip(CLASSES, shares, strict=True)))
            assert [share for _, share in top] == sorted(shares, reverse=True)
    assert len(recognized) == 3
    assert_refused("rule is 'least'", Recognizer, run, rule="least")


def test_answers_below_the_threshold_have_no_name(recognizer: Recognizer, run: TrainedRun) -> None:
    all_named = recognizer.recognize(tilted(patches()))
    confidences = sorted(answer.confidence for answer in all_named if answer.confidence is not None)
    assert len(set(confidences)) == 3
    for answer, named in zip(Recognizer(run, confidences[1]).recognize(tilted(patches())), all_named, strict=True):
        if named.confidence is None or named.confidence >= confidences[1]:
            assert answer == named
        else:
            assert answer.name is None and answer.reason is not None and answer.reason.startswith("unknown: ")
            assert dataclasses.replace(answer, name=named.name, reason=None) == named
    for value in (-0.1, 1.5, float("nan"), "0.5", [0.5]):
        assert_refused(re.escape(f"unknown_below is {value!r}"), Recognizer, run, value)
    assert Recognizer(run, jax.numpy.float32(0.5)).thresholds().tolist() == [0.5] * len(run.classes)
    for chunk in (0, 2.0, None):
        assert_refused(f"chunk is {chunk}", Recognizer, run, chunk=chunk)


def test_arguments_that_are_no_frames_are_named(recognizer: Recognizer) -> None:
    for function in (recognizer.recognize, recognizer.describe, recognizer.track().update):
        assert_refused("frame is of type str; expected an RGBDFrame", function, "frame.png")
    assert_refused("frame is of type NoneType", thor2.explain, recognizer, None, 1)
    frame = tilted(patches())
    assert_refused("frames is of type RGBDFrame; expected a list", recognizer.enroll, "new", frame)
    assert_refused("frames is of type RGBDFrame; expected a list", recognizer.adapt, frame)
    assert_refused(r"frames\[0\]: frame is of type int", recognizer.enroll, "new", [(2, frame)])
    assert_refused(r"frames\[0\]: frame is of type tuple", recognizer.enroll, "new", [(frame, 2, 3)])
    assert_refused(r"frames\[1\]: frame is of type str", recognizer.adapt, [frame, "frame.png"])
    assert_refused(r"^frames\[0\]: labels is None", recognizer.adapt, [dataclasses.replace(frame, labels=None)])
    assert_refused(r"frames\[0\]: instance is '2'", recognizer.enroll, "new", [(frame, "2")])
    assert_refused("run is of type str", Recognizer, "run")
    assert_refused("^model is 'a.x00b'; expected a path", Recognizer.load, "a\0b")


def test_half_of_the_points_may_overflow_with_a_name(recognizer: Recognizer) -> None:
    colors, boundary = np.zeros((100, 3), np.uint8), np.zeros(100, bool)
    instance = PreparedInstance(1, np.zeros((100, 3), np.float32), colors, boundary)
    probabilities = {name: np.full((2, 4), [0.7, 0.1, 0.1, 0.1], np.float32) for name in THOR2}
    inference = Inference(np.array([50, 51]), probabilities)
    named, refused = answers(recognizer.model, [instance, instance], inference)
    assert named.name == "a" and named.reason is None and named.overflow == 50
    assert refused.name is None and refused.overflow == 51 and refused.confidence == named.confidence
    assert refused.reason is not None and "overflow" in refused.reason


def test_no_names_with_absurd_intrinsics(recognizer: Recognizer) -> None:
    few_points = tilted(patches() * (np.arange(320) % 12 == 0))
    absurd = dataclasses.replace(few_points, intrinsics=thor2.Intrinsics(1e-9, 600.0, 159.5, 119.5))
    assert [answer.name for answer in recognizer.recognize(absurd)] == [None] * 4


def test_a_missing_classifier_is_named(run: TrainedRun) -> None:
    shape_only = Recognizer(dataclasses.replace(run, classifiers={"tops": run.classifiers["tops"]}))
    assert_refused("'tops2'.*a list of some of tops$", shape_only.recognize, tilted(patches()), classifiers=THOR2)
    answers = shape_only.recognize(tilted(patches()))
    assert {a.classifier for a in answers if a.reason is None} == {"tops"}
    assert_refused("shape", shape_only.recognize, tilted(patches()), classifiers=("shape",))


@pytest.mark.parametrize(("field", "changes"), [("config", {"sigma_1": 0.03}), ("network", {"similarity": np.eye(22)})])
def test_clouds_are_embedded_by_the_descriptor_of_the_embedding(field: str, changes: dict[str, Any]) -> None:
    """The run has another one, or another colour network."""
    run, embedding = untrained_run(CLASSES, ("tops",)), small_embedding()
    other: Any = {field: dataclasses.replace(getattr(run, field), **changes)}
    model = Recognizer(dataclasses.replace(run, embedding=embedding, **other)).model
    clouds = thor2.PointClouds.pack(random_clouds(0, [200, 300]), rim=[None, None])
    inference = infer(model, describe_looks(clouds, model.run.network, model.run.config, 2), clouds, embeds=True)
    expected = embedding.embed_oriented(describe_looks(clouds, embedding.network, embedding.config, 2), clouds)
    np.testing.assert_allclose(inference.embeddings, expected, atol=1e-5)


def test_instances_are_compared_with_surfaces() -> None:
    """Classifiers that are evaluated without the embedding are not."""
    run = untrained_embedding_run(CLASSES, ("tops",))
    recognizer, compared = Recognizer(run), Recognizer(with_surfaces(run))
    answers = [each.recognize(tilted(patches()), classifiers=("tops",)) for each in (recognizer, compared)]
    assert answers[0] == answers[1]
    instances, before = recognizer.infer(recognizer.prepare(tilted(patches())))
    _, after = compared.infer(instances)
    usable = [each for each in instances if each.reason is None]
    clouds = pack_instances(usable, len(after.overflow))
    first, second = (each.probabilities["embedding"] for each in (before, after))
    expected = with_evidence(first, compared.run.surfaces, sample_points(clouds))
    np.testing.assert_allclose(second[: len(usable)], expected[: len(usable)], rtol=1e-4)
    assert len(usable) > 1 and np.abs(first - expected)[: len(usable)].max() > 0.01


def test_nothing_compiles_after_warm_up(request: pytest.FixtureRequest) -> None:
    """JAX's monitoring reports what a recognizer compiles that no other test uses; one object has a surface."""
    fresh = Recognizer(with_surfaces(untrained_embedding_run(CLASSES, THOR2)))
    frame = frame_of_squares({1: (10, 10, (200, 30, 30))})
    fresh.enroll("toy", [frame])
    surface = surfaces_of([builtin_objects()["banana"]]).arrays
    fresh.objects.enroll("mesh", list(fresh.prepare(frame)), "mesh", surface)
    listen = mock.Mock()
    jax.monitoring.register_event_duration_secs_listener(listen)
    request.addfinalizer(lambda: jax.monitoring.unregister_event_duration_listener(listen))
    assert fresh.warm_up(max_points=500, max_instances=1) == 1
    assert listen.called
    listen.reset_mock()
    assert [answer.classifier is not None for answer in fresh.recognize(frame)] == [True]
    assert listen.mock_calls == []


@pytest.mark.parametrize(("chunk", "count"), [(2, 4), (64, 1)])
def test_every_size_is_warmed_up(run: TrainedRun, chunk: int, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[tuple[int, ...]] = []

    def record(_: object, clouds: thor2.PointClouds, **__: object) -> Inference:
        sizes.append(clouds.mask.shape)
        return Inference(np.zeros(len(clouds.mask)), {})

    monkeypatch.setattr("thor2_jax.recognizer.infer_clouds", record)
    monkeypatch.setattr("thor2_jax.capacity.MIN_BATCH_POINTS", 1024)
    recognizer = Recognizer(run, chunk=chunk)
    assert recognizer.warm_up(max_points=1000, max_instances=2) == len(sizes) == count
    for n, n_instances in ((100, 1), (100, 2), (600, 1), (600, 2)):
        points = np.zeros((n, 3), np.float32)
        instance = PreparedInstance(1, points, points.astype(np.uint8), np.zeros(n, bool))
        recognizer.infer([instance] * n_instances)
    assert {*sizes[count:]} == {*sizes[:count]}


def test_known_instances_are_located(monkeypatch: pytest.MonkeyPatch) -> None:
    recognizer = Recognizer(with_surfaces(untrained_embedding_run(CLASSES, ("tops",))))
    surfaces, names, frame = recognizer.run.surfaces, {3: "b", 200: "d"}, tilted(patches())
    monkeypatch.setattr(
        "thor2_jax.recognizer.answers",
        lambda model, instances, inference: [Recognition(each.label, names.get(each.label)) for each in instances],
    )
    distances = recognizer._locate(frame)
    assert list(distances) == [3, 200]
    for label, index in ((3, 1), (200, 3)):
        (instance,) = recognizer.prepare(frame, [label])
        pose = np.asarray(fit_poses(surfaces, pack_instances([instance], 1), [index])[0])
        expected = surfaces.distances(index, pose, instance.points)
        assert np.isfinite(expected).any()
        np.testing.assert_allclose(distances[label](instance.points), expected, atol=1e-4)
    names.clear()
    assert recognizer._locate(frame) == {}
    names[3] = "b"
    recognizer.objects.enroll("b", list(recognizer.prepare(frame, [7])), "frames", replace=True)
    assert recognizer._locate(frame) == {}  # "b" is now another object
