"""Results computed from synthetic answers, against scikit-learn, NumPy and hand calculation."""

import numpy as np
import pytest
from sklearn.metrics import confusion_matrix
from toy_recognizers import ToyRun, UntaughtRecognizer, toy_answer

from thor2_jax.networks.networks import EMBEDDING, FEATURES
from training.evaluation.answers import FrameAnswers, InstancePrediction, Predictions, fusions, main_fusion
from training.evaluation.page import _accuracy_text, answer_texts
from training.evaluation.results import compute_results, named_answers
from training.evaluation.scores import attribute_tables, group_by_attributes

CLASSES = ("bowl", "can", "mug")


RUNS = [ToyRun("a", ("tops", "tops2")), ToyRun("b", ("ce", "tops", "tops2"))]


def synthetic_frames() -> list[FrameAnswers]:
    """Return 60 frames with two instances; every 7th instance is not described, every 11th is an unknown object."""
    rng = np.random.default_rng(0)
    frames = []
    for k in range(60):
        instances = []
        for label in (1, 2):
            number = 2 * k + label
            truth = "dragon" if number % 11 == 0 else CLASSES[rng.integers(3)]
            table = rng.dirichlet(np.ones(3), 5).astype(np.float32)
            described = (None, table) if number % 7 else ("too few points", None)
            instances.append(InstancePrediction(label, truth, False, *described))
        attributes = {"environment": "lounge" if k % 2 else "warehouse", "occlusion": ("none", "low", "high")[k % 3]}
        frames.append(FrameAnswers(f"{k}/0", attributes, 0.5, instances))
    return frames


def test_fusions_have_the_titles_of_the_paper() -> None:
    assert fusions(name for name in ("tops2", "ce", "tops")) == {
        "CE": ("ce",), "TOPS": ("tops",), "TOPS2": ("tops2",), "CE+TOPS": ("ce", "tops"), "CE+TOPS2": ("ce", "tops2"),
        "THOR2": ("tops", "tops2"), "CE+TOPS+TOPS2": ("ce", "tops", "tops2"),
    }  # fmt: skip
    assert fusions([]) == {}
    titles = ["forest", "PointNet", "THOR", "TOPS", "TOPS2", "THOR2", "gallery", "both"]
    assert list(fusions(["thor", "tops", "pointnet", "tops2", "forest", "gallery", "both"])) == titles


def test_main_fusion_is_that_of_what_answers() -> None:
    for predictors, answer_by, expected in (
        (["thor", "ce"], "classifiers", "CE"),
        (["ce", "tops", "tops2", "gallery", "both"], "classifiers", "THOR2"),
        (["ce", "tops", "tops2", "gallery", "both"], "gallery", "gallery"),
        (["forest", "embedding"], "classifiers", "embedding"),
        (["tops", "tops2", "embedding", "classifiers"], "classifiers", "classifiers"),
    ):
        assert main_fusion(fusions(predictors), answer_by) == expected
    for features in (("ce",), ("tops",), ("ce", "tops"), ("tops2",), ("ce", "tops2"), ("tops", "tops2"), FEATURES):
        chosen = UntaughtRecognizer(features=features).model.chosen_classifiers()
        assert fusions(features)[main_fusion(fusions(features))] == chosen


@pytest.mark.parametrize(
    ("columns", "shown"),
    [
        ((EMBEDDING,), "entry embedding shows the answers"),
        (("tops", EMBEDDING, "classifiers"), "entry classifiers shows the names from TOPS with"),
        (("ce", EMBEDDING, "classifiers"), "entry classifiers shows these names with"),
    ],
)
def test_the_page_says_which_fusion_gives_the_names(columns: tuple[str, ...], shown: str) -> None:
    text = _accuracy_text({"fusions": list(fusions(columns)), "rule": "log-mean", "scratch": [], "runs": ["run"]})
    assert shown in text and "THOR2" not in text


def test_calibrated_and_unfused_columns_match_hand_calculation() -> None:
    """Scores of the gallery are not normalized. A temperature of 4 turns 0.9 into 0.634, which is less than 0.8."""
    index, confidence = Predictions.fused("log-mean", {"gallery": np.array([[0.2, 0.1], [0.0, 0.7]])}, {})
    assert list(index) == [0, 1] and list(confidence) == [0.2, 0.7]
    both = {"tops": np.array([[0.9, 0.1]]), "tops2": np.array([[0.2, 0.8]])}
    for rule, expected in (("max", (0, 0.9)), ("calibrated", (1, 0.8))):
        index, confidence = Predictions.fused(rule, both, {"tops": 4.0, "tops2": 1.0})
        assert (index[0], confidence[0]) == pytest.approx(expected)


def test_temperatures_reduce_the_calibration_error() -> None:
    """3 of 4 answers with confidence 0.99 are correct; a temperature turns 0.99 into 0.75 and the error into zero."""
    rows = [np.array([[0.99, 0.01]] * 2, np.float32)] * 40
    instances = [InstancePrediction(k, "can" if k % 4 == 0 else "bowl", probabilities=p) for k, p in enumerate(rows)]
    unknown = [InstancePrediction(99, "dragon", probabilities=np.array([[0.6, 0.4]] * 2, np.float32))]
    frame = FrameAnswers("f", {}, 1.0, instances + unknown)
    temperature = np.log(99) / np.log(3)
    run = ToyRun("a", ("tops",), ("bowl", "can"))
    report = compute_results("frames", [run._replace(temperatures={"tops": temperature}), run], [frame])
    before, after = report["confidence"]["TOPS"], report["calibrated_confidence"]["TOPS"]
    assert before["expected_calibration_error"]["mean"] == pytest.approx(0.24, abs=1e-6)
    assert before["expected_calibration_error"]["runs"] == 2
    assert after["expected_calibration_error"]["mean"] == pytest.approx(0, abs=1e-6)
    assert after["expected_calibration_error"]["runs"] == 1  # the other run was not calibrated
    assert before["auroc_known"]["mean"] == after["auroc_known"]["mean"] == 1
    assert before["unknown_refused"]["mean"] == 1 and before["accuracy_at_coverage"]["mean"] == 0.75
    assert report["temperatures"]["tops"] == {"mean": pytest.approx(temperature), "std": None, "runs": 1}
    assert report["accuracy"]["calibrated"][0]["cells"][0]["accuracy"]["TOPS"]["mean"] == 0.75


def test_results_match_numpy_and_sklearn() -> None:
    frames = synthetic_frames()
    report = compute_results("uwis", RUNS, frames)
    everything = [(i, f) for f in frames for i in f.instances]
    scored = [(i, f) for i, f in everything if i.truth != "dragon"]
    assert report["instances"]["labelled"] == 120 and report["instances"]["scored"] == len(scored)
    assert report["instances"]["no_class"] == {"dragon": 120 - len(scored)}
    is_lost = np.array([i.probabilities is None for i, _ in scored])
    assert report["instances"]["not_described"] == {"too few points": is_lost.sum()}
    values = np.array([np.zeros((5, 3)) if i.probabilities is None else i.probabilities for i, _ in scored])
    truth = np.array([CLASSES.index(i.truth) for i, _ in scored])
    for name, per_run in {
        "CE": [[2]],  # only the second run has it
        "TOPS": [[0], [3]],
        "THOR2": [[0, 1], [3, 4]],
        "CE+TOPS+TOPS2": [[2, 3, 4]],
    }.items():
        answers = [values[:, rows].reshape(len(values), -1).argmax(axis=1) % 3 for rows in per_run]
        correct = np.array([(each == truth) & ~is_lost for each in answers])
        for cell in (cell for table in report["accuracy"]["max"] for cell in table["cells"]):
            here = [cell["where"].items() <= f.attributes.items() for _, f in scored]
            accuracies = correct[:, here].mean(axis=1)
            assert cell["instances"] == sum(here)
            assert cell["accuracy"][name]["mean"] == pytest.approx(accuracies.mean())
            std = pytest.approx(accuracies.std(ddof=1)) if len(accuracies) > 1 else None
            assert (cell["accuracy"][name]["std"], cell["accuracy"][name]["runs"]) == (std, len(accuracies))
    tables = report["accuracy"]["mean"]
    assert [table["by"] for table in tables] == [[], ["environment"], ["environment", "occlusion"]]
    assert [cell["where"]["occlusion"] for cell in tables[2]["cells"]] == ["none", "low", "high"] * 2

    table, known = values[~is_lost], truth[~is_lost]
    answers = [table[:, pair].prod(axis=1).argmax(axis=1) for pair in ([0, 1], [3, 4])]
    expected = confusion_matrix(np.tile(known, 2), np.concatenate(answers))
    np.testing.assert_array_equal(np.array(report["confusion"])[:, :-1], expected)
    assert np.sum(report["confusion"]) == 2 * len(scored)
    assert sum(report["reliability"]["answers"]) == 2 * len(known)
    assert 0 < report["confidence"]["THOR2"]["auroc_known"]["mean"] < 1
    assert report["speed"]["frames_per_second"] == pytest.approx(2)
    assert report["rejection"]["threshold"]["runs"] == 0 and report["rejection"]["accuracy"]["runs"] == 2
    # These runs have no temperatures.
    assert report["accuracy"]["calibrated"][0]["cells"][0]["accuracy"] == {}
    assert report["calibrated_confidence"] == {} and report["temperatures"]["ce"]["runs"] == 0


def test_named_answers_are_those_of_the_main_fusion_and_the_threshold() -> None:
    sure = np.array([[0, 0, 1], [0, 0, 1], [1, 0, 0], [1, 0, 0], [0.9, 0.1, 0]], np.float32)
    instances = [InstancePrediction(1, "mug", probabilities=sure), InstancePrediction(2, "dragon")]
    runs = [RUNS[0]._replace(thresholds=np.full(3, 1.1)), RUNS[1]]
    named = [(run, instance.label, *answer) for run, instance, *answer in named_answers(instances, runs)]
    assert named == [(0, 1, None, 1.0), (1, 1, "bowl", 1.0)]


def test_rejection_and_placements_match_hand_calculation() -> None:
    """A mug in four frames, correct in two; a can in one; three dragons. The thresholds reject the less sure."""
    answers = [("mug", 0.9), ("mug", 0.7), ("can", 0.8), ("bowl", 0.6)]
    dragons: list[tuple[str, float]] = [("mug", 0.8), ("can", 0.75), ("can", 0.5)]
    given = [("f", "mug", *answer) for answer in answers] + [("g", "can", "can", 0.95)]
    given += [("h", "dragon", *answer) for answer in dragons]
    frames = [FrameAnswers(frame, {}, 1.0, [toy_answer(*answer, n_predictors=2)]) for frame, *answer in given]
    frames.append(FrameAnswers("i", {}, 1.0, [toy_answer("can", None)]))
    report = compute_results("frames", [RUNS[0]._replace(thresholds=np.array([0.61, 0.75, 0.75]))], frames)
    placements = report["placements"]
    assert placements["count"] == 3
    assert placements["accuracy"]["THOR2"]["mean"] == pytest.approx((2 / 4 + 1 + 0) / 3)
    assert placements["steadiness"]["THOR2"]["mean"] == pytest.approx(2 / 4)
    assert {name: value["mean"] for name, value in report["rejection"].items()} == {
        "threshold": 0.75,
        "accuracy": pytest.approx(3 / 6),
        "incorrect": pytest.approx(2 / 6),
        "accuracy_at_threshold": pytest.approx(2 / 6),
        "incorrect_at_threshold": pytest.approx(1 / 6),
        "unknown_named_at_threshold": pytest.approx(2 / 3),
    }
    assert report["answers"] == {"known": 6, "unknown": 3, "correct": 2, "wrong": 1, "unknown_named": 2}
    assert report["worst"] == [
        {"truth": "dragon", "answer": name, "count": 1, "share": pytest.approx(1 / 3), "known": False}
        for name in ("mug", "can")
    ] + [
        {"truth": "mug", "answer": "can", "count": 1, "share": pytest.approx(1 / 4), "known": True},
    ]
    parts = "0.333", "1 get a wrong name and 3 get no name", "2 of 3", "dragon (unknown) as mug (1)"
    assert all(part in " ".join(answer_texts(report)) for part in parts)
    curve = report["known_unknown"]
    points = dict(zip(curve["kept"], curve["named"], strict=True))
    assert [points[0.0], points[0.33], points[0.5], points[0.95], points[1.0]] == pytest.approx([0, 0, 0, 2 / 3, 2 / 3])
    assert report["confidence"]["THOR2"]["unknown_named"]["mean"] == pytest.approx(2 / 3)


def test_tables_of_datasets_and_entries_without_an_attribute() -> None:
    attributes = [{"a": "x", "b": "high"}, {"a": "x", "b": "none"}, {"a": "y"}, {"a": "x", "b": "high"}]
    groups = group_by_attributes(attributes, ("a", "b"))
    assert [(k, v.tolist()) for k, v in groups.items()] == [(("x", "none"), [1]), (("x", "high"), [0, 3])]
    assert attribute_tables("bop", attributes) == [(), ("a",), ("b",)]
    assert attribute_tables("uwis", [{"environment": "lounge"}]) == [(), ("environment",)]
