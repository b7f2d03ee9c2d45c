"""Figures of answers made up: against scikit-learn, numpy and counting by hand."""

from typing import Any

import numpy as np
import pytest
from sklearn.metrics import confusion_matrix

from training.evaluation.accuracy import over_runs, parts, tables_of
from training.evaluation.answers import FrameAnswers, InstanceAnswer
from training.evaluation.fusion import join_by, joinings, main_joining
from training.evaluation.published import published, published_seconds
from training.evaluation.results import results, wrong_answers

CLASSES = ("bowl", "can", "mug")
COLUMNS: tuple[tuple[int, Any], ...] = ((0, "tops"), (0, "tops2"), (1, "ce"), (1, "tops"), (1, "tops2"))
NONE: list[dict[str, float]] = [{}, {}]


def made_up(n: int = 60) -> list[FrameAnswers]:
    """Frames of two instances; every seventh instance is not described, every eleventh is of no class."""
    rng = np.random.default_rng(0)
    frames = []
    for k in range(n):
        instances = []
        for label in (1, 2):
            number = 2 * k + label
            truth = "dragon" if number % 11 == 0 else CLASSES[rng.integers(3)]
            table = rng.dirichlet(np.ones(3), len(COLUMNS)).astype(np.float32)
            gone = number % 7 == 0
            instances.append(
                InstanceAnswer(label, truth, False, "too few points" if gone else None, None if gone else table)
            )
        attributes = {"environment": "lounge" if k % 2 else "warehouse", "occlusion": ("none", "low", "high")[k % 3]}
        frames.append(FrameAnswers(f"{k}/0", attributes, 0.5, instances))
    return frames


def test_joinings_carry_the_papers_names() -> None:
    assert joinings(name for name in ("tops2", "ce", "tops")) == {
        "CE": ("ce",),
        "TOPS": ("tops",),
        "TOPS2": ("tops2",),
        "CE+TOPS": ("ce", "tops"),
        "CE+TOPS2": ("ce", "tops2"),
        "THOR2": ("tops", "tops2"),
        "CE+TOPS+TOPS2": ("ce", "tops", "tops2"),
    }
    assert joinings(["tops"]) == {"TOPS": ("tops",)}
    assert list(joinings(["thor", "tops", "pointnet", "tops2", "forest"])) == [
        "forest", "PointNet", "THOR", "TOPS", "TOPS2", "THOR2",
    ]  # fmt: skip
    assert joinings(["thor", "ce"])["THOR"] == ("thor",)
    assert main_joining(joinings(["thor", "ce"])) == "CE"
    assert joinings([]) == {}
    assert main_joining(joinings(["ce", "tops", "tops2"])) == "THOR2"
    assert main_joining(joinings(["ce", "tops"])) == "CE+TOPS"


def test_rules_of_joining_by_hand() -> None:
    """The larger top-1 is 0.7; the means are 0.31, 0.34, 0.35; only the second class is above 0 in both."""
    both = {"tops": np.array([[0.0, 0.3, 0.7]]), "tops2": np.array([[0.62, 0.38, 0.0]])}
    index, confidence = join_by("max", both)
    assert (index[0], confidence[0]) == (2, 0.7)
    index, confidence = join_by("mean", both)
    assert (index[0], confidence[0]) == (2, pytest.approx(0.35))
    index, confidence = join_by("log-mean", both)
    assert index[0] == 1 and confidence[0] == pytest.approx(1.0)
    equal = {"tops": np.array([[0.2, 0.8]]), "tops2": np.array([[0.6, 0.4]])}
    roots = np.sqrt([0.2 * 0.6, 0.8 * 0.4])
    assert join_by("log-mean", equal)[1] == pytest.approx(roots[1] / roots.sum())


def test_temperatures_decide_whom_to_believe() -> None:
    """At a temperature of 4, 0.9 against 0.1 becomes 9 ** 0.25 to 1, or 0.634: less than 0.8."""
    both = {"tops": np.array([[0.9, 0.1]]), "tops2": np.array([[0.2, 0.8]])}
    assert join_by("max", both)[0][0] == 0
    index, confidence = join_by("calibrated", both, {"tops": 4.0, "tops2": 1.0})
    assert (index[0], confidence[0]) == (1, pytest.approx(0.8))
    index, confidence = join_by("calibrated", {"tops": both["tops"]}, {"tops": 4.0})
    assert confidence[0] == pytest.approx(9**0.25 / (9**0.25 + 1))


def test_calibration_error_before_and_after() -> None:
    """Answers with 0.99 that are right in 3 of 4 cases; a temperature makes 0.75 of 0.99, and the error zero."""
    rows = [np.array([[0.99, 0.01]] * 2, np.float32)] * 40
    instances = [InstanceAnswer(k, "can" if k % 4 == 0 else "bowl", probabilities=p) for k, p in enumerate(rows)]
    unknown = [InstanceAnswer(99, "dragon", probabilities=np.array([[0.6, 0.4]] * 2, np.float32))]
    frame = FrameAnswers("f", {}, 1.0, instances + unknown)
    right = np.log(99) / np.log(3)
    columns = ((0, "tops"), (1, "tops"))
    found = results("frames", [frame], columns, ["a", "b"], ("bowl", "can"), [{"tops": right}, {}])
    before, after = found["confidence"]["TOPS"], found["calibrated_confidence"]["TOPS"]
    assert before["expected_calibration_error"]["mean"] == pytest.approx(0.24, abs=1e-6)
    assert before["expected_calibration_error"]["runs"] == 2
    assert after["expected_calibration_error"]["mean"] == pytest.approx(0, abs=1e-6)
    assert after["expected_calibration_error"]["runs"] == 1  # the other run was not calibrated
    assert before["auroc_known"]["mean"] == after["auroc_known"]["mean"] == 1
    assert before["unknown_refused"]["mean"] == 1 and before["accuracy_at_coverage"]["mean"] == 0.75
    assert found["temperatures"]["tops"] == {"mean": pytest.approx(right), "std": None, "runs": 1}
    assert found["accuracy"]["calibrated"][0]["cells"][0]["accuracy"]["TOPS"]["mean"] == 0.75


def test_runs_without_temperatures_have_no_calibrated_figures() -> None:
    found = results("uwis", made_up(), COLUMNS, ["a", "b"], CLASSES, NONE)
    assert found["accuracy"]["calibrated"][0]["cells"][0]["accuracy"] == {}
    assert found["calibrated_confidence"] == {} and found["temperatures"]["ce"]["runs"] == 0


def test_figures_against_numpy_and_sklearn() -> None:
    frames = made_up()
    found = results("uwis", frames, COLUMNS, ["a", "b"], CLASSES, NONE)
    everything = [(i, f) for f in frames for i in f.instances]
    scored = [(i, f) for i, f in everything if i.truth != "dragon"]
    assert found["instances"]["labelled"] == 120 and found["instances"]["scored"] == len(scored)
    assert found["instances"]["no_class"] == {"dragon": 120 - len(scored)}
    lost = sum(i.probabilities is None for i, _ in scored)
    assert found["instances"]["not_described"] == {"too few points": lost}

    def right(i: InstanceAnswer, rows: list[int]) -> bool:
        if i.probabilities is None:
            return False
        row = max(rows, key=lambda k: i.probabilities[k].max())  # type: ignore[index]
        return CLASSES[i.probabilities[row].argmax()] == i.truth

    for name, per_run in {
        "CE": [[2]],  # only the second run has it
        "TOPS": [[0], [3]],
        "THOR2": [[0, 1], [3, 4]],
        "CE+TOPS+TOPS2": [[2, 3, 4]],
    }.items():
        for table in found["accuracy"]["max"]:
            for cell in table["cells"]:
                here = [i for i, f in scored if cell["where"].items() <= f.attributes.items()]
                accuracies = [np.mean([right(i, rows) for i in here]) for rows in per_run]
                assert cell["instances"] == len(here)
                assert cell["accuracy"][name]["mean"] == pytest.approx(np.mean(accuracies))
                std = pytest.approx(np.std(accuracies, ddof=1)) if len(accuracies) > 1 else None
                assert cell["accuracy"][name]["std"] == std
                assert cell["accuracy"][name]["runs"] == len(accuracies)
    assert [table["by"] for table in found["accuracy"]["max"]] == [
        [], ["environment"], ["environment", "occlusion"],
    ]  # fmt: skip
    assert [cell["where"]["occlusion"] for cell in found["accuracy"]["mean"][2]["cells"]] == ["none", "low", "high"] * 2

    described = [i for i, _ in scored if i.probabilities is not None]
    truth = [i.truth for i in described]
    pairs = [(0, 1), (3, 4)]
    answers = [
        CLASSES[np.prod(i.probabilities[list(pair)], axis=0, dtype=np.float64).argmax()]  # type: ignore[index]
        for pair in pairs
        for i in described
    ]
    np.testing.assert_array_equal(
        np.array(found["confusion"])[:, :-1], confusion_matrix(truth * 2, answers, labels=CLASSES)
    )
    assert np.sum(found["confusion"]) == 2 * len(scored)
    assert sum(found["reliability"]["answers"]) == 2 * len(described)
    assert 0 < found["confidence"]["THOR2"]["auroc_known"]["mean"] < 1
    assert found["speed"]["frames_per_second"] == pytest.approx(2)


def test_wrong_answers_are_those_of_the_main_joining_of_every_run() -> None:
    sure = np.array([[0, 0, 1], [0, 0, 1], [1, 0, 0], [1, 0, 0], [0.9, 0.1, 0]], np.float32)
    instances = [InstanceAnswer(1, "mug", probabilities=sure), InstanceAnswer(2, "dragon", probabilities=sure)]
    found = list(wrong_answers(FrameAnswers("f", {}, 0.1, instances), COLUMNS, CLASSES))
    assert [(i.label, answer, confidence) for i, answer, confidence in found] == [(1, "bowl", 1.0)]


@pytest.mark.parametrize("kept", [0, 1])
def test_nothing_or_one_instance(kept: int) -> None:
    frame = FrameAnswers("f", {}, 0.0, [InstanceAnswer(1, "mug", probabilities=np.eye(3, dtype=np.float32)[:2])][:kept])
    found = results("frames", [frame], COLUMNS[:2], ["a"], CLASSES, NONE)
    assert found["instances"]["scored"] == kept and found["speed"]["frames_per_second"] is None
    assert found["joinings"] == (["TOPS", "TOPS2", "THOR2"] if kept else [])
    if kept:
        assert found["accuracy"]["max"][0]["cells"][0]["accuracy"]["THOR2"]["mean"] == 0.0
        assert found["confidence"]["THOR2"]["auroc_right"] == {"mean": None, "std": None, "runs": 0}


def test_what_cannot_be_described_is_wrong() -> None:
    frame = FrameAnswers("f", {}, 1.0, [InstanceAnswer(1, "mug", reason="too few points")])
    found = results("frames", [frame], COLUMNS, ["a", "b"], CLASSES, NONE)
    accuracy = found["accuracy"]["log-mean"][0]["cells"][0]["accuracy"]
    assert accuracy["THOR2"] == {"mean": 0.0, "std": 0.0, "runs": 2}
    assert found["confusion"] == [[0] * 4, [0] * 4, [0, 0, 0, 2]]
    assert found["confidence"]["THOR2"]["expected_calibration_error"]["mean"] is None


def test_parts_and_tables() -> None:
    attributes = [{"a": "x", "b": "high"}, {"a": "x", "b": "none"}, {"a": "y"}, {"a": "x", "b": "high"}]
    found = parts(attributes, ("a", "b"))
    assert {k: v.tolist() for k, v in found.items()} == {("x", "none"): [1], ("x", "high"): [0, 3]}
    assert list(found) == [("x", "none"), ("x", "high")]
    assert parts(attributes, ())[()].tolist() == [0, 1, 2, 3]
    assert tables_of("bop", attributes) == [(), ("a",), ("b",)]
    assert tables_of("uwis", [{"environment": "lounge"}]) == [(), ("environment",)]
    assert over_runs([0.5, float("nan"), 0.7]).runs == 2


def test_sequences_of_ocid() -> None:
    answer = InstanceAnswer(1, "mug", probabilities=np.eye(3, dtype=np.float32)[:2])
    names = ["table/bottom/mixed/seq1", "table/bottom/mixed/seq2"]
    frames = [FrameAnswers(f"{name}/{k}", {"camera": "lower"}, 1.0, [answer]) for name in names for k in range(2)]
    tables = results("ocid", frames, COLUMNS[:2], ["a"], CLASSES, NONE)["accuracy"]["max"]
    assert tables[-1]["by"] == ["sequence"]
    assert [cell["where"]["sequence"] for cell in tables[-1]["cells"]] == names
    assert tables[1]["cells"][0]["published"]["SimpleView"] == pytest.approx(0.6254)


def test_published_figures_are_shares_and_say_their_source() -> None:
    for kind in ("uwis", "ocid"):
        found = published(kind)
        assert found is not None and "2305.03815" in found.source and found.missing
        assert found.of({"environment": "moon"}) == {}
    uwis = published("uwis")
    assert uwis is not None and uwis.of({})["THOR (MLP)"] == pytest.approx(0.5222)
    assert uwis.of({"environment": "lounge", "occlusion": "high"}) == {"THOR (MLP)": pytest.approx(0.5188)}
    assert published("frames") is None
    assert all(seconds > 0 for seconds in published_seconds().values())
