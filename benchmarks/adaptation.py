"""Gain of the adaptation to a camera: `python -m benchmarks.adaptation --model RUN --frames DIR... --out FILE.json`.

The recognizer is adapted to a simulated camera on one half of the frames (every second frame), without labels, and
tested on the other half; then the halves are exchanged. The file has results for the original frames and for each
camera of `training.augmentation.simulated_cameras`: the accuracy over placements before and after the adaptation (mean
over both halves), the estimated colour transform, the number of instances used for it, and the time in seconds. With
--unknown, the adaptation also gets frames of unknown objects, seen by the same camera.

An interrupted command resumes: cameras that are already in the file are kept.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cameras import CAMERAS, ORIGINAL, add_camera_options, labelled_frames, measure, seen_by
from thor2_jax.adaptation.estimate import adaptation_criterion, estimate_transform
from thor2_jax.errors import InputError
from thor2_jax.files import write_text
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.prepared_instance import prepare_instance
from training.augmentation.simulated_cameras import SimulatedCamera
from training.evaluation.answers import FrameAnswers
from training.evaluation.job import answer_frames
from training.evaluation.runs import Run, load_runs
from training.readers.labelled import LabelledFrame
from training.storage.jobs import check_same_job

LOST = 0.05
"""Smallest loss of accuracy at which a camera counts as affected."""


def only_labelled(item: LabelledFrame) -> RGBDFrame:
    """Return the frame with labels of scored instances only."""
    labels = np.where(np.isin(item.frame.label_image, list(item.truth)), item.frame.label_image, 0)
    return dataclasses.replace(item.frame, labels=labels)


def answers_with(run: Run, frames: Sequence[LabelledFrame], transform: Any) -> list[FrameAnswers]:
    """Return the answers of a run for frames with colours corrected by a transform, or not corrected if it is None."""
    run.recognizer.model = dataclasses.replace(run.model, color_transform=transform)
    return [*answer_frames([run], frames)]


def measure_camera(
    run: Run,
    frames: Sequence[LabelledFrame],
    unknown: Sequence[LabelledFrame],
    camera: SimulatedCamera | None,
    count: int,
) -> dict[str, Any]:
    """Return the results of one camera, as in the module's docstring."""
    recognizer, halves = run.recognizer, []
    for half in range(2):
        training = [*frames[half::2], *unknown[half::2]]
        instances = []
        for item in training:
            frame = only_labelled(seen_by(camera, item))
            instances += [prepare_instance(frame, label, recognizer.run.config.sigma_s) for label in frame.instances]
        usable = [each for each in instances if each.reason is None]
        chosen = [usable[k] for k in np.random.default_rng(half).permutation(len(usable))[:count]]
        start = time.perf_counter()
        adaptation = estimate_transform(chosen, adaptation_criterion(recognizer.model))
        seconds = time.perf_counter() - start
        test = frames[1 - half :: 2]
        seen = [seen_by(camera, item) for item in test]
        answers = {ORIGINAL: answers_with(run, test, None)}
        answers["before"] = answers[ORIGINAL] if camera is None else answers_with(run, seen, None)
        answers["after"] = answers_with(run, seen, adaptation.transform)
        (results,) = measure([run], answers)
        halves.append(
            {
                "before": results["before"]["accuracy"],
                "after": results["after"]["accuracy"],
                "placements": results["before"]["placements"],
                "instances": adaptation.instances,
                "transform": dataclasses.asdict(adaptation.transform),
                "seconds": round(seconds, 2),
            }
        )
    before, after = (float(np.mean([half[name] for half in halves])) for name in ("before", "after"))
    return {"before": before, "after": after, "halves": halves}


def summary(cameras: dict[str, Any]) -> dict[str, float]:
    """Return the mean gain over all cameras, over cameras that lost at least `LOST`, and on the original frames."""
    changes = {name: row["after"] - row["before"] for name, row in cameras.items()}
    lost = [name for name, row in cameras.items() if cameras[ORIGINAL]["before"] - row["before"] >= LOST]
    others = [change for name, change in changes.items() if name != ORIGINAL]
    return {
        "original": changes[ORIGINAL],
        "all cameras": float(np.mean(others)) if others else float("nan"),
        "affected cameras": float(np.mean([changes[name] for name in lost])) if lost else float("nan"),
        "number of affected cameras": len(lost),
        "worst": min(changes.values()),
    }


def main() -> None:
    """Measure the cameras that are missing in the file, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, required=True, metavar="RUN")
    parser.add_argument("--frames", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--unknown", type=Path, nargs="*", default=[], metavar="DIR")
    add_camera_options(parser)
    parser.add_argument("--instances", type=int, default=40, help="largest number of instances (%(default)s)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.json")
    options = parser.parse_args()
    job = {name: str(value) for name, value in vars(options).items() if name != "out"}
    try:
        stored = json.loads(options.out.read_bytes()) if options.out.is_file() else {"job": job, "results": {}}
        check_same_job(options.out, stored["job"], job)
        (run,) = load_runs([options.model])
        frames = labelled_frames(options.frames)
        unknown = labelled_frames(options.unknown, options.ignore) if options.unknown else []
        for camera in (None, *CAMERAS[options.cameras]):
            name = ORIGINAL if camera is None else camera.name
            if name not in stored["results"]:
                row = measure_camera(run, frames, unknown, camera, options.instances)
                stored["results"][name] = row
                write_text(options.out, json.dumps(stored, indent=1) + "\n")
            row = stored["results"][name]
            print(f"{name:20s} {row['before']:.3f} {row['after']:.3f} {row['after'] - row['before']:+.3f}", flush=True)
        stored["summary"] = summary(stored["results"])
        write_text(options.out, json.dumps(stored, indent=1) + "\n")
        print(json.dumps(stored["summary"], indent=1))
    except (InputError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
