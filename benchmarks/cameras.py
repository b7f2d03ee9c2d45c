"""Accuracy under simulated cameras: `python -m benchmarks.cameras --model RUN... --frames DIR... --out FILE.json`.

Every frame is recognized as it is and as seen by ten simulated cameras (`training.augmentation.simulated_cameras`):
either those for choosing settings, or those for the final report. For one or several runs on the same classes, the
file has the mean and the standard deviation over the runs of

accuracy              mean over placements, for all frames and by group (folder) of frames
accuracy_of_instances
steadiness            fraction of instances with the most frequent answer of their placement
calibration_error     expected calibration error on known objects
auroc                 known against unknown objects, by the confidence
unknown_named         fraction of unknown objects that are named at a threshold that keeps 95 % of the correct answers
kept_at_threshold, unknown_named_at_threshold    the two fractions at the threshold stored in the run

on the original frames, for each camera, and for all cameras together. Labelled objects that are not classes of the runs
are unknown objects; names that match --ignore are left out. Placements are found in the original frames and counted
separately for each camera. --picture draws the first frame, or without --frames a scene of built-in objects, as seen by
all twenty cameras.
"""

import argparse
import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import atomic_write, write_text
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.overlay import COLORS, Annotation, draw_instances
from thor2_jax.model.fusion import DEFAULT_RULE
from training.augmentation.simulated_cameras import CHOOSE, REPORT, SimulatedCamera, through_camera
from training.evaluation.answers import FrameAnswers, Rule, main_fusion
from training.evaluation.job import answer_frames
from training.evaluation.results import confidence_metrics, fuse_answers, judged_confidences, split_known
from training.evaluation.runs import Run, load_runs
from training.evaluation.scores import Floats, find_placements, placement_accuracy, steadiness, summarize_rows
from training.objects.builtin_objects import builtin_objects
from training.readers.frames import FrameFolder
from training.readers.labelled import LabelledFrame, sequence_of
from training.rendering.scenes import compose_scene

CAMERAS: dict[str, tuple[SimulatedCamera, ...]] = {"choose": CHOOSE, "report": REPORT, "none": ()}

ORIGINAL, ALL = "original", "all cameras"
"""Names for the original frames, and for all cameras together."""

METRICS = "accuracy", "accuracy_of_instances", "steadiness", "calibration_error", "auroc", "unknown_named"
"""Metrics of the table."""

LOOK_ALIKES = (
    *("banana", "bowl", "apple", "lemon", "orange", "peach", "pear"),
    *("scissors_*", "marker_*", "pen_*", "spoon_*", "fork_*", "knife*", "plate_*", "cup_*"),
)
"""Objects of HOTS that look like a class of YCB."""

SCENE = 5
"""Seed of the scene of built-in objects."""

RunResults = dict[str, dict[str, float]]
"""Results of a run: frames or camera -> metric -> value; NaN if there is no value."""


def labelled_frames(directories: Sequence[Path], ignore: Sequence[str] = ()) -> list[LabelledFrame]:
    """Read frames; the frames in one folder are a group and a video.

    Args:
        directories: folders of frames, or folders of single frames, whose group is their parent folder.
        ignore: patterns of object names to leave out.

    Returns:
        Frames with identifiers GROUP/FRAME.

    Raises:
        InputError: a frame cannot be read, or two folders have the same name.
    """
    frames: dict[str, LabelledFrame] = {}
    for directory in directories:
        folder = Path(directory).resolve()
        group = folder.parent if (folder / "labels.json").is_file() else folder
        for item in FrameFolder(folder):
            identifier = f"{group.name}/{item.identifier}"
            if identifier in frames:
                raise InputError(f"frames: {identifier} is given twice; give every frame once")
            truth = {k: name for k, name in item.truth.items() if not any(fnmatch(name, each) for each in ignore)}
            frames[identifier] = dataclasses.replace(item, identifier=identifier, truth=truth)
    return list(frames.values())


def seen_by(camera: SimulatedCamera | None, item: LabelledFrame) -> LabelledFrame:
    """Return a frame as a camera sees it; None returns the frame unchanged."""
    return item if camera is None else dataclasses.replace(item, frame=through_camera(item.frame, camera))


def answers_by_camera(
    runs: Sequence[Run],
    frames: Sequence[LabelledFrame],
    cameras: Sequence[SimulatedCamera],
    report: Callable[[str], object],
) -> dict[str, list[FrameAnswers]]:
    """Return `ORIGINAL` or a camera's name -> its answers; every frame is described once for all runs.

    `report` is called with each name when the answers are complete.
    """
    answers: dict[str, list[FrameAnswers]] = {}
    for camera in (None, *cameras):
        name = ORIGINAL if camera is None else camera.name
        answers[name] = [*answer_frames(runs, (seen_by(camera, item) for item in frames))]
        report(name)
    return answers


def measure(
    runs: Sequence[Run],
    answers: Mapping[str, Sequence[FrameAnswers]],
    title: str | None = None,
    rule: Rule = DEFAULT_RULE,
) -> list[RunResults]:
    """Return the results of every run: `ORIGINAL`, a camera's name or `ALL` -> metric -> value.

    The module's docstring explains the metrics; "accuracy in GROUP" is the accuracy in a group of frames.
    "instances", "placements" and "unknown_instances" are counts.

    Args:
        runs: the runs that gave the answers.
        answers: from `answers_by_camera`.
        title: fusion of the classifiers, see `fusions`; by default the fusion that the first run uses for its answers.
        rule: fusion rule.

    Raises:
        InputError: no instance is of a class of the runs, or the runs do not have this fusion.
    """
    placements = np.concatenate(find_placements(answers[ORIGINAL]))
    parts = {name: [frames] for name, frames in answers.items()}
    cameras = [frames for name, frames in answers.items() if name != ORIGINAL]
    if cameras:
        parts[ALL] = cameras
    by_part = {name: _measure(runs, part, placements, title, rule) for name, part in parts.items()}
    return [{name: results[index] for name, results in by_part.items()} for index in range(len(runs))]


def _measure(
    runs: Sequence[Run],
    cameras: Sequence[Sequence[FrameAnswers]],
    placements: NDArray[np.intp],
    title: str | None,
    rule: Rule,
) -> list[dict[str, float]]:
    """Return the metrics of each run on the answers of some cameras together."""
    classes = runs[0].classes
    # Placements are found in the original frames, and counted separately for each camera.
    by_camera = np.arange(len(cameras))[:, None] * len(placements) + placements
    scored = split_known([frame for frames in cameras for frame in frames], classes, by_camera.ravel())
    if not scored.known:
        raise InputError(f"frames: no instance is of a class of the runs, which have {', '.join(classes[:5])}, ...")
    fused, others = fuse_answers(scored.known, runs, rule), scored.fuse_unknown(runs, rule)
    chosen = title or main_fusion(fused, runs[0].answer_by)
    if len(fused.get(chosen, ())) < len(runs):
        raise InputError(f"fusion is {chosen}; expected one that all runs have, of {', '.join(fused)}")
    group, placement = np.array([sequence_of(frame.frame) for frame in scored.frames]), scored.placement
    results = []
    for run, predictions in fused[chosen].items():
        correct, unknown = predictions.class_index == scored.truth, others[chosen][run]
        confidence, is_right = judged_confidences(predictions, scored.truth)
        metrics = confidence_metrics(predictions, scored.truth, unknown)
        results.append(
            {
                "accuracy": placement_accuracy(placement, correct),
                "accuracy_of_instances": float(correct.mean()),
                "steadiness": steadiness(placement, predictions.class_index),
                "calibration_error": metrics["expected_calibration_error"],
                "auroc": metrics["auroc_known"],
                "unknown_named": metrics["unknown_named"],
                **at_threshold(float(np.median(runs[run].thresholds)), confidence[is_right], unknown.confidence),
                **{
                    f"accuracy in {name}": placement_accuracy(placement[group == name], correct[group == name])
                    for name in np.unique(group).tolist()
                },
                "instances": len(scored.known),
                "placements": len(np.unique(placement)),
                "unknown_instances": len(scored.unknown),
            }
        )
    return results


def at_threshold(threshold: float, of_correct: Floats, of_unknown: Floats) -> dict[str, float]:
    """Return the fractions of correct answers and of unknown objects above a threshold; NaN without a threshold.

    Args:
        threshold: the threshold; 0 for none.
        of_correct: [N], confidences of the correct answers, at most 1.
        of_unknown: [M], confidences of the answers to unknown objects.
    """
    kept, named = (
        float((values >= threshold).mean()) if threshold and len(values) else np.nan
        for values in (of_correct, np.minimum(of_unknown, 1))
    )
    return {"threshold": threshold or np.nan, "kept_at_threshold": kept, "unknown_named_at_threshold": named}


def summarize(results: Sequence[RunResults]) -> dict[str, dict[str, Any]]:
    """Return the results of `measure` with the values replaced by `summarize_runs` over the runs (JSON tables)."""
    return {name: summarize_rows([of_run[name] for of_run in results]) for name in results[0]}


def draw_cameras(frame: RGBDFrame, path: Path) -> None:
    """Draw a labelled frame as seen by all cameras (JPEG); missing depth in masks is black, other pixels are dimmed."""
    figure = Figure(figsize=(15, 9.6), layout="constrained")
    for axes, camera in zip(figure.subplots(4, 5).flat, (*CHOOSE, *REPORT), strict=True):
        seen = through_camera(frame, camera)
        color = np.where(seen.labels[..., None] > 0, seen.color, seen.color // 2)
        color[(seen.labels > 0) & (seen.depth == 0)] = 0
        outlines = [Annotation(label, COLORS[k % len(COLORS)], "") for k, label in enumerate(seen.instances)]
        axes.imshow(np.asarray(draw_instances(color, seen.labels, outlines)))
        rows, columns = np.nonzero(frame.labels)
        axes.set(xlim=(columns.min() - 30, columns.max() + 30), ylim=(rows.max() + 30, rows.min() - 30))
        axes.set_title(f"{camera.name} ({'choose' if camera in CHOOSE else 'report'})", fontsize=11)
        axes.set_axis_off()
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100, format="jpeg", pil_kwargs={"quality": 80})


def show(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the metrics as a table of text."""
    lines = [" " * 20 + "".join(f"{name:>23s}" for name in METRICS)]
    for name, values in results.items():
        cells = [values[metric] for metric in METRICS]
        lines.append(f"{name:20s}" + "".join(f"{mean_and_deviation(cell):>23s}" for cell in cells))
    return "\n".join(lines)


def mean_and_deviation(statistics: Mapping[str, Any]) -> str:
    """Return a mean as text, with the standard deviation if there are several runs."""
    if statistics["mean"] is None:
        return "-"
    return f"{statistics['mean']:.3f}" + ("" if statistics["std"] is None else f" +- {statistics['std']:.3f}")


def add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of all benchmarks with simulated cameras."""
    parser.add_argument("--cameras", choices=list(CAMERAS), default="choose")
    parser.add_argument("--ignore", nargs="*", default=LOOK_ALIKES, metavar="PATTERN", help="names to leave out")


def main() -> None:
    """Measure the runs, print the table and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, nargs="+", default=[], metavar="RUN")
    parser.add_argument("--frames", type=Path, nargs="+", default=[], metavar="DIR")
    add_camera_options(parser)
    parser.add_argument("--fusion", metavar="TITLE", help="such as CE+TOPS+TOPS2; default: as in recognition")
    parser.add_argument("--out", type=Path, metavar="FILE.json")
    parser.add_argument("--picture", type=Path, metavar="FILE.jpg")
    options = parser.parse_args()
    measured = options.model, options.frames, options.out
    if not all(measured) and (options.model or options.out or not options.picture):
        parser.error("give --model, --frames and --out, or --picture")
    try:
        frames = labelled_frames(options.frames, options.ignore)
        if options.picture:
            scene = frames[0] if frames else compose_scene(builtin_objects(), np.random.default_rng(SCENE), 6)
            draw_cameras(scene.frame, options.picture)
        if options.model:
            runs = load_runs(options.model)

            def report(camera: str) -> None:
                print(f"{camera}: {len(frames)} frames", flush=True)

            answers = answers_by_camera(runs, frames, CAMERAS[options.cameras], report)
            results = summarize(measure(runs, answers, options.fusion))
            print(show(results))
            content = {
                "runs": [run.name for run in runs],
                "frames": [str(path) for path in options.frames],
                "ignored": list(options.ignore),
                "cameras": options.cameras,
                "results": results,
            }
            write_text(options.out, json.dumps(content, indent=1) + "\n")
    except (InputError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
