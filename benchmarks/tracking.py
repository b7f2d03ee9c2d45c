"""Gain from several frames: `python -m benchmarks.tracking --model RUN... --frames DIR... --out FILE.json`.

For each run, every frame of a video from the fifth on is recognized alone, and by a tracker over this frame and the
four frames before it. The file has the steadiness and the accuracy over placements of both, and the placements with a
lower accuracy in tracks. Answers are the most probable names, even below the threshold for unknown objects.

With --meshes DIR, scenes of these objects are also rendered from six cameras all around the table or, with --step, at
this angle from each other, as a robot may reach them. For the objects in the first view, and separately for objects
that are highly occluded there, the file has the accuracy by the number of views for these methods:

fused      the answers for the views are fused (`thor2_jax.tracking.tracker`), in the order around the table
merged     fused; in addition, each view is described as one cloud with the views before it (`merge_views`)
random     fused, with the other views in random order
next_view  fused, with each following view chosen by `thor2_jax.tracking.viewpoints.next_view`

It also has the number of views that each method needs for an accuracy of 0.95. Objects are identified by their labels.

An interrupted command resumes: finished runs and scenes are kept in the file.
"""

import argparse
import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.cameras import labelled_frames
from thor2_jax.capacity import BATCH_BUCKETS
from thor2_jax.errors import InputError
from thor2_jax.files import write_text
from thor2_jax.frames.frames import Intrinsics
from thor2_jax.frames.prepared_instance import PreparedInstance, prepare_instance
from thor2_jax.model.inference import answers
from thor2_jax.recognizer import Recognizer
from thor2_jax.tracking.tracker import FusedEvidence, Tracker, view_weight
from thor2_jax.tracking.viewpoints import ViewTable, merge_views, next_view, transform
from training.evaluation.scores import placement_accuracy, steadiness
from training.objects.meshes import find_meshes, load_mesh
from training.readers.labelled import LabelledFrame, sequence_of
from training.rendering.camera import Camera
from training.rendering.scenes import Scene, compose_views
from training.storage.jobs import check_same_job
from training.view_table import view_table

WINDOW = 5
"""Number of frames of a track."""

VIEWS = 6
"""Number of cameras around a scene."""

OBJECTS = 6
"""Number of objects in a scene."""

CAMERA = Camera(320, 240, Intrinsics(307.5, 307.5, 159.5, 119.5))

TARGET = 0.95

METHODS = ("fused", "merged", "random", "next_view")

Probabilities = Mapping[str, NDArray[np.floating]]


def measure_tracks(recognizer: Recognizer, frames: Sequence[LabelledFrame]) -> dict[str, Any]:
    """Return the results of one run on videos, as in the module's docstring; a placement is an object of a video.

    Args:
        recognizer: a recognizer with `unknown_below` 0, so that every answer has a name.
        frames: frames of one or more videos, in order.
    """
    # The model is evaluated once for each frame and once for each merged cloud.
    prepare, infer = functools.cache(lambda frame: tuple(recognizer.prepare(frame))), functools.cache(recognizer.infer)
    cached: Any = SimpleNamespace(model=recognizer.model, prepare=prepare, infer=infer)
    rows: list[tuple[str, str, str, str]] = []  # placement, truth, alone, tracked
    for number, item in enumerate(frames):
        video = [each for each in frames[: number + 1] if sequence_of(each.identifier) == sequence_of(item.identifier)]
        if len(video) < WINDOW:
            continue
        tracker = Tracker(cached)
        for each in video[-WINDOW:]:
            tracked = tracker.update(each.frame)
        alone = {answer.label: answer for answer in answers(recognizer.model, *infer(prepare(item.frame)))}
        for answer in tracked:
            truth = item.truth.get(answer.label)
            if truth in recognizer.classes:
                placement = f"{sequence_of(item.identifier)}/{truth}"
                rows.append((placement, truth, alone[answer.label].name or "", answer.name or ""))
    placed, truths, *given = map(np.array, zip(*rows, strict=True))
    placements, placement = np.unique(placed, return_inverse=True)
    results: dict[str, Any] = {"instances": len(rows), "placements": len(placements)}
    correct = {}
    for name, answered in zip(("alone", "tracked"), given, strict=True):
        correct[name] = answered == truths
        results[name] = {
            "accuracy": placement_accuracy(placement, correct[name]),
            "steadiness": steadiness(placement, np.unique(answered, return_inverse=True)[1]),
        }
    gain = correct["tracked"].astype(int) - correct["alone"]
    results["placements with lower accuracy"] = placements[np.bincount(placement, gain) < 0].tolist()
    return results


def probabilities_of(recognizer: Recognizer, instances: Sequence[PreparedInstance]) -> list[dict[str, Any]]:
    """Return classifier -> class probabilities [C] for each usable instance."""
    probabilities = recognizer.infer(instances, answer_by="classifiers")[1].probabilities
    return [{name: values[row] for name, values in probabilities.items()} for row in range(len(instances))]


def _fuse(recognizer: Recognizer, views: Sequence[tuple[PreparedInstance, Probabilities]]) -> NDArray[np.floating]:
    """Fuse the class probabilities of several views of one object; return [C]."""
    evidence = FusedEvidence()
    for instance, probabilities in views:
        evidence.add(view_weight(instance), probabilities, None)
    return recognizer.model.fused({name: p[None] for name, p in evidence.fused()[0].items()})[0]


def measure_scene(
    recognizer: Recognizer, views: Sequence[tuple[Scene, NDArray[np.float64]]], table: ViewTable, seed: int
) -> list[dict[str, Any]]:
    """Return the occlusion of each object in the first view, and method -> correctness by number of views."""
    classes, sigma_s = recognizer.run.classes, recognizer.run.config.sigma_s
    seen: dict[tuple[int, int], PreparedInstance] = {}
    for number, (scene, _) in enumerate(views):
        for label in scene.truth:
            instance = prepare_instance(scene.frame, label, sigma_s)
            if instance.reason is None:
                seen[label, number] = instance
    probabilities = dict(zip(seen, probabilities_of(recognizer, list(seen.values())), strict=True))
    rows, rng = [], np.random.default_rng(seed)
    for label, name in views[0][0].truth.items():
        others = [number for number in range(1, len(views)) if (label, number) in seen]
        if (label, 0) not in seen or name not in classes:
            continue

        def answer(order: Sequence[int], label: int = label) -> NDArray[np.floating]:
            return _fuse(recognizer, [(seen[label, number], probabilities[label, number]) for number in order])

        def chosen(others: Sequence[int] = others, label: int = label) -> list[int]:
            order, left = [0], list(others)
            first = seen[label, 0].points
            centre = transform(views[0][1], (first.min(axis=0) + first.max(axis=0))[None] / 2)[0]
            while left:
                poses = [views[number][1] for number in left]
                best = next_view(answer(order), centre, views[order[-1]][1], poses, table)
                order.append(left.pop(best.index))
            return order

        orders = {
            "fused": [0, *others],
            "random": [0, *rng.permutation(others).tolist()],
            "next_view": chosen(),
        }
        correct = {
            method: [classes[int(answer(order[:k]).argmax())] == name for k in range(1, len(order) + 1)]
            for method, order in orders.items()
        }
        posed = [(seen[label, number], views[number][1]) for number in orders["fused"]]
        clouds = [merge_views(posed[:k], sigma_s) for k in range(2, len(posed) + 1)]
        of_views = [(seen[label, number], probabilities[label, number]) for number in orders["fused"]]
        of_clouds = list(zip(clouds, probabilities_of(recognizer, clouds), strict=True))
        # The order is as in a tracker: a view alone, then the cloud merged from it and the views before it.
        both = [of_views[0], *(each for pair in zip(of_views[1:], of_clouds, strict=True) for each in pair)]
        correct["merged"] = [
            classes[int(_fuse(recognizer, both[: 2 * k - 1]).argmax())] == name for k in range(1, len(posed) + 1)
        ]
        rows.append({"name": name, "occlusion": views[0][0].occlusion(label), "correct": correct})
    return rows


def summarize_scenes(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return method -> accuracy by number of views, and views needed; objects keep the answer of their last view."""
    summary: dict[str, Any] = {}
    for part, chosen in (("all", rows), ("high", [row for row in rows if row["occlusion"] == "high"])):
        table: dict[str, Any] = {"objects": len(chosen)}
        for method in METHODS:
            by_count = [
                float(np.mean([row["correct"][method][min(k, len(row["correct"][method]) - 1)] for row in chosen]))
                for k in range(VIEWS)
                if chosen
            ]
            enough = [k + 1 for k, value in enumerate(by_count) if value >= TARGET]
            table[method] = {"accuracy": np.round(by_count, 3).tolist(), "views needed": enough[0] if enough else None}
        summary[part] = table
    return summary


def main() -> None:
    """Measure the runs and scenes that are missing in the file, and print the summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, nargs="+", required=True, metavar="RUN")
    parser.add_argument("--frames", type=Path, nargs="*", default=[], metavar="DIR", help="folders of one video each")
    parser.add_argument("--meshes", type=Path, metavar="DIR", help="meshes of the classes, for rendered scenes")
    parser.add_argument("--names", type=Path, metavar="FILE", help="as for thor2 render")
    parser.add_argument("--scenes", type=int, default=40, help="number of scenes, recognized by the first run")
    parser.add_argument("--step", type=float, default=360 / VIEWS, metavar="DEGREES", help="angle between two cameras")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.json")
    options = parser.parse_args()
    job = {"model": list(map(str, options.model)), "frames": list(map(str, options.frames)), "step": options.step}
    try:
        stored: dict[str, Any] = {"job": job, "tracks": {}, "scenes": {}}
        if options.out.is_file():
            stored = json.loads(options.out.read_bytes())
            check_same_job(options.out, stored["job"], job)

        def write() -> None:
            write_text(options.out, json.dumps(stored, indent=1) + "\n")

        frames = labelled_frames(options.frames)
        for path in options.model if frames else []:
            if str(path) not in stored["tracks"]:
                stored["tracks"][str(path)] = measure_tracks(Recognizer.load(path, unknown_below=0.0), frames)
                write()
            print(path, json.dumps(stored["tracks"][str(path)]), flush=True)
        seeds = range(options.scenes) if options.meshes else ()
        missing = [seed for seed in seeds if str(seed) not in stored["scenes"]]
        if missing:
            recognizer = Recognizer.load(options.model[0], chunk=BATCH_BUCKETS[-1])
            paths, classes = find_meshes(options.meshes, options.names), recognizer.run.classes
            meshes = {name: load_mesh(path) for name, path in paths.items() if name in classes}
            table = view_table(recognizer, meshes)
            for seed in missing:
                arc = np.radians(VIEWS * options.step)
                views = compose_views(meshes, np.random.default_rng(seed), OBJECTS, VIEWS, CAMERA, arc)
                stored["scenes"][str(seed)] = measure_scene(recognizer, views, table, seed)
                stored["summary"] = summarize_scenes([row for rows in stored["scenes"].values() for row in rows])
                write()
                print(f"scene {seed} of {options.scenes}", flush=True)
        print(json.dumps(stored.get("summary", {}), indent=1))
    except (InputError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
