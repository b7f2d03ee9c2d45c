"""The demonstration: built-in objects, synthetic views, training, cluttered scenes, recognition, a one-page report.

figures = run_demo("demo-report", seed=0)
figures.accuracy["all"]            # CE, TOPS, TOPS2, THOR2 in the order of figures.names
"""

import dataclasses
import json
import resource
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thor2_jax.files import check_output_directory, write_text
from thor2_jax.recognition.overlay import draw_overlay
from thor2_jax.recognition.recognizer import Recognizer
from thor2_jax.recognition.run_directory import TrainedRun, load_run
from training.evaluate import Instance, evaluate, summarize
from training.fitting.job import VIEWS, is_finished, train_run
from training.fitting.options import Progress
from training.fitting.protocol import DEFAULT
from training.objects.builtin_objects import builtin_objects
from training.objects.mesh import TexturedMesh
from training.readers.labelled import LabelledFrame
from training.rendering.scenes import Scene, compose_scene
from training.rendering.view_sphere import camera_pose
from training.reports.html import Picture, write_page
from training.reports.plots import draw_accuracy, draw_confusion, draw_curves, draw_descriptor, draw_objects
from training.storage.jobs import check_same_job
from training.views.mesh_views import view_cloud
from training.views.render_job import render_dataset

__all__ = ["DemoFigures", "run_demo"]

PROTOCOL = dataclasses.replace(DEFAULT, fit=dataclasses.replace(DEFAULT.fit, epochs=6))
"""The default with a quarter of its epochs: as many as a demonstration's minutes allow."""

N_SCENES = 40
LIGHT = 0.4
"""Scenes are up to this share brighter or darker than the training views: colour alone is then no sure guide."""

N_SHOWN = 6
NAMES = ("CE", "TOPS", "TOPS2", "THOR2")
FEATURES = ("ce", "tops", "tops2")


@dataclasses.dataclass(frozen=True)
class DemoFigures:
    """What the demonstration measured.

    Attributes:
        names: the recognizers compared.
        accuracy: part of the instances ("all", "occlusion none", ...) -> one value a recognizer, in order of `names`.
        instances: part of the instances -> how many.
        seconds: wall time of the whole.
        peak_gib: largest resident memory of this process, GiB.
    """

    names: tuple[str, ...]
    accuracy: Mapping[str, Sequence[float]]
    instances: Mapping[str, int]
    seconds: float
    peak_gib: float


def _scenes(objects: Mapping[str, TexturedMesh], seed: int, progress: Progress) -> list[Scene]:
    # A stream of its own for each scene: one more object or draw in a scene does not change the ones after it.
    seeds = np.random.SeedSequence(seed).spawn(N_SCENES)
    scenes = []
    for number, scene_seed in enumerate(seeds, 1):
        scenes.append(compose_scene(objects, np.random.default_rng(scene_seed), light=LIGHT))
        progress("compose scenes", number, N_SCENES, "")
    return scenes


def _labelled(scenes: Sequence[Scene]) -> Iterator[LabelledFrame]:
    for number, scene in enumerate(scenes):
        yield LabelledFrame(f"scene {number}", scene.frame, scene.truth, {})


def _with_occlusion(instances: Sequence[Instance], scenes: Sequence[Scene]) -> list[Instance]:
    frames = {f"scene {number}": scene for number, scene in enumerate(scenes)}
    return [dataclasses.replace(i, attributes={"occlusion": frames[i.frame].occlusion(i.label)}) for i in instances]


def _parts(summary: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    yield "all", summary["accuracy"]["all"]["all"]
    for degree in ("none", "low", "high"):
        if degree in summary["accuracy"].get("occlusion", {}):
            yield f"occlusion {degree}", summary["accuracy"]["occlusion"][degree]


def _trained(objects: Mapping[str, TexturedMesh], out: Path, seed: int, progress: Progress) -> TrainedRun:
    if is_finished(out):
        run = load_run(out)
        check_same_job(out, {"seed": run.record["seed"]}, {"seed": seed})
    else:
        dataset = render_dataset(
            objects,
            out / VIEWS,
            PROTOCOL.azimuth_step,
            PROTOCOL.polar_step,
            progress=lambda done, total: progress("render views", done, total, ""),
            augmentations=PROTOCOL.augmentations,
            seed=seed,
        )
        options = dataclasses.replace(PROTOCOL.fit, seed=seed)
        (run,) = train_run(dataset, out, FEATURES, options, progress, mirrors=PROTOCOL.mirrors)
    shutil.rmtree(out / VIEWS, ignore_errors=True)
    return run


def run_demo(out: str | Path, seed: int = 0, progress: Progress = lambda stage, done, total, note: None) -> DemoFigures:
    """Train on the built-in objects, recognize scenes of them, write a report; or go on where that was stopped.

    Writes `run/` (the trained run), `pictures/`, `demo.json` and, last, `report.html` in `out`.

    Args:
        out: folder: new, or one that a demonstration has begun.
        seed: of the scenes and of the training.
        progress: told of each step.

    Raises:
        InputError: `out` holds something else, a finished demonstration, or one of another seed.
        OSError: `out` cannot be written.
    """
    start = time.perf_counter()
    out = Path(out)
    check_output_directory(out, resumable=("run", "pictures", "demo.json"))
    pictures = out / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    objects = builtin_objects()
    run = _trained(objects, out / "run", seed, progress)
    scenes = _scenes(objects, seed, progress)
    recognizer = Recognizer.load(out / "run")
    done = 0

    def recognized(_: str) -> None:
        nonlocal done
        done += 1
        progress("recognize scenes", done, N_SCENES, "")

    instances = _with_occlusion(evaluate(recognizer, _labelled(scenes), recognized), scenes)
    parts = dict(_parts(summarize(instances, NAMES)))
    accuracy = {part: [float(row[name]) for name in NAMES] for part, row in parts.items()}
    counts = {part: int(row["instances"]) for part, row in parts.items()}

    draw_objects(objects, pictures / "objects.png")
    draw_accuracy(NAMES, accuracy, counts, pictures / "accuracy.png")
    draw_confusion(instances, run.classes, "THOR2", pictures / "confusion.png")
    draw_curves(run.record["curves"], pictures / "training.png")
    mug = objects["mug_blue"]
    xyz, rgb = view_cloud(mug, camera_pose(0.8, 1.2, mug.centre))
    draw_descriptor(xyz, rgb, run.network, run.config, "mug_blue", pictures / "descriptor.png")
    for number, scene in enumerate(scenes[:N_SHOWN]):
        draw_overlay(scene.frame.color, scene.frame.labels, recognizer.recognize(scene.frame), _scene(pictures, number))

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    figures = DemoFigures(NAMES, accuracy, counts, time.perf_counter() - start, peak)
    write_text(
        out / "demo.json",
        json.dumps(
            {"figures": dataclasses.asdict(figures), "instances": [dataclasses.asdict(i) for i in instances]}, indent=1
        )
        + "\n",
    )
    _write_report(out, figures, len(objects), run.record["dataset"]["views"])
    return figures


def _scene(pictures: Path, number: int) -> Path:
    return pictures / f"scene-{number}.png"


def _write_report(out: Path, figures: DemoFigures, n_objects: int, n_views: int) -> None:
    header = ["instances", "count", *figures.names]
    rows = [
        [part, str(figures.instances[part]), *(f"{value:.3f}" for value in values)]
        for part, values in figures.accuracy.items()
    ]
    shown = [
        Picture(
            f"pictures/scene-{number}.png", "Outline, name, confidence and the classifier that is surer.", half=True
        )
        for number in range(N_SHOWN)
    ]
    write_page(
        out / "report.html",
        title="THOR2 on built-in objects",
        lead=(
            f"{n_objects} objects, {n_views:,} synthetic views, {N_SCENES} cluttered scenes that training never saw, "
            f"in light up to {LIGHT:.0%} brighter or darker. "
            f"{figures.seconds:.0f} s, {figures.peak_gib:.1f} GiB."
        ),
        sections=[
            (
                "Accuracy",
                "Share of instances named rightly. CE reads colour alone, TOPS shape alone, TOPS2 both; THOR2 joins "
                "TOPS and TOPS2. Low occlusion hides 5 to 30 % of an object, high more.",
                (header, rows),
                [Picture("pictures/accuracy.png", "Accuracy by occlusion.")],
            ),
            ("Scenes", "The first scenes, as recognized.", None, shown),
            (
                "Objects",
                "Pairs of one shape differ in colour only, others of one colour differ in shape only.",
                None,
                [Picture("pictures/objects.png", "The objects, as rendered for training.")],
            ),
            (
                "From a view to its descriptor",
                "The cloud cut into slices; the slices' persistence images (shape); the slices' colour strips.",
                None,
                [Picture("pictures/descriptor.png", "One view of the blue mug.")],
            ),
            (
                "Confusions and training",
                "",
                None,
                [
                    Picture("pictures/confusion.png", "THOR2's answers in the scenes.", half=True),
                    Picture("pictures/training.png", "Loss and accuracy on the training views.", half=True),
                ],
            ),
        ],
    )
