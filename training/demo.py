"""The demo: built-in objects, synthetic views, the paper's classifiers, cluttered scenes and a one-page report.

summary = run_demo("demo-report", seed=0)
summary.accuracy["all"]            # accuracy of CE, TOPS, TOPS2 and THOR2, in the order of summary.names
"""

import dataclasses
import itertools
import json
import resource
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from thor2_jax.files import check_output_directory, write_text
from thor2_jax.frames.overlay import draw_overlay
from thor2_jax.networks.networks import FEATURES
from training.augmentation.simulated_cameras import CHOOSE, through_camera
from training.embedding.distractors import AUGMENTATIONS
from training.evaluation.answers import FrameAnswers
from training.evaluation.job import answer_frames
from training.evaluation.results import compute_results, fuse_answers
from training.evaluation.runs import Run, load_runs
from training.objects.builtin_objects import builtin_objects
from training.objects.mesh import TexturedMesh
from training.protocol import DEFAULT
from training.readers.labelled import LabelledFrame
from training.rendering.camera import camera_pose
from training.rendering.scenes import compose_scene
from training.reports.html import Picture, Section, write_page
from training.reports.plots import draw_accuracy, draw_confusion, draw_curves, draw_descriptor, draw_objects
from training.storage.jobs import Progress
from training.train_job import TrainJob, run_train_job
from training.train_run import is_finished
from training.views.mesh_views import view_cloud

__all__ = ["DemoSummary", "run_demo"]

PROTOCOL = dataclasses.replace(
    DEFAULT,
    classifiers=FEATURES,
    distractors=None,
    azimuth_step=30.0,
    polar_step=20.0,
    augmentations=dataclasses.replace(AUGMENTATIONS, copies=2),
    fit=dataclasses.replace(DEFAULT.fit, epochs=6),
)
"""The default protocol with fewer views, copies and epochs: the demo fits the paper's classifiers in minutes."""

N_SCENES = 40
"""Number of scenes. The ten cameras of `CHOOSE` take turns, one camera per scene."""

N_SHOWN = 6
NAMES = ("CE", "TOPS", "TOPS2", "THOR2")


@dataclasses.dataclass(frozen=True)
class DemoSummary:
    """Measurements of the demo.

    Attributes:
        names: names of the compared recognizers.
        accuracy: subset of the instances ("all", "occlusion none", ...) -> one accuracy for each of `names`.
        instances: subset of the instances -> number of instances.
        seconds: wall time of this call; an interrupted demo took longer.
        peak_gib: peak resident memory of this process, GiB.
    """

    names: tuple[str, ...]
    accuracy: Mapping[str, Sequence[float]]
    instances: Mapping[str, int]
    seconds: float
    peak_gib: float


def run_demo(
    out: str | Path, seed: int = 0, progress: Progress = lambda stage, done, total, note: None, workers: int = 1
) -> DemoSummary:
    """Train on the built-in objects, recognize scenes of them and write a report. An interrupted demo resumes.

    Writes `run/` (the run directory), `pictures/`, `demo.json` and, last, `report.html` to `out`.

    Args:
        out: output directory: new, or from an interrupted demo.
        seed: seed for the scenes and the training.
        progress: called with (stage, done, total, note).
        workers: rendering processes; they do not affect the result.

    Raises:
        InputError: `out` holds something else, a finished demo, or a demo with another seed.
        OSError: a file cannot be written.
    """
    start = time.perf_counter()
    out = Path(out)
    pictures = out / "pictures"
    # Pictures without a run were not written by a demo.
    check_output_directory(out, resumable=("run", "pictures", "demo.json") if is_finished(out / "run") else ("run",))
    objects = builtin_objects()
    run_train_job(TrainJob(out / "run", PROTOCOL.replace(seed=seed), objects, workers=workers), progress)
    pictures.mkdir(exist_ok=True)
    (run,) = load_runs([out / "run"])
    trained = run.model.run
    answers = _answer_scenes(run, objects, seed, progress, pictures)
    report = compute_results("demo", [run], answers)
    cells = [cell for table in report["accuracy"][report["rule"]] for cell in table["cells"]]
    subsets = {" ".join(f"{name} {value}" for name, value in cell["where"].items()) or "all": cell for cell in cells}
    accuracy = {subset: [cell["accuracy"][name]["mean"] for name in NAMES] for subset, cell in subsets.items()}
    counts = {subset: cell["instances"] for subset, cell in subsets.items()}

    draw_objects(objects, pictures / "objects.png")
    draw_accuracy(NAMES, accuracy, counts, pictures / "accuracy.png")
    draw_confusion(np.array(report["confusion"]), run.classes, report["main"], pictures / "confusion.png")
    draw_curves(trained.record["curves"], pictures / "training.png")
    mug = objects["mug_blue"]
    xyz, rgb = view_cloud(mug, camera_pose(0.8, 1.2, mug.centre))
    draw_descriptor(xyz, rgb, trained.network, trained.config, "mug_blue", pictures / "descriptor.png")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    summary = DemoSummary(NAMES, accuracy, counts, time.perf_counter() - start, peak)
    content = {"figures": dataclasses.asdict(summary), "instances": list(_instances(run, answers))}
    write_text(out / "demo.json", json.dumps(content, indent=1) + "\n")
    _write_report(out, summary, len(objects), trained.record["dataset"]["views"])
    return summary


def _answer_scenes(
    run: Run, objects: Mapping[str, TexturedMesh], seed: int, progress: Progress, pictures: Path
) -> list[FrameAnswers]:
    """Compose scenes, draw the first ones with their answers, and return the answers by the degree of occlusion."""
    grouped = []
    # Each scene has its own random stream, so that a change to one scene does not affect the later ones.
    seeds = zip(np.random.SeedSequence(seed).spawn(N_SCENES), itertools.cycle(CHOOSE), strict=False)
    for number, (scene_seed, camera) in enumerate(seeds):
        scene = compose_scene(objects, np.random.default_rng(scene_seed))
        frame = through_camera(scene.frame, camera)
        (answers,) = answer_frames([run], [LabelledFrame(f"scene {number}", frame, scene.truth, {})])
        for degree in ("none", "low", "high"):
            instances = [i for i in answers.instances if scene.occlusion(i.label) == degree]
            grouped.append(dataclasses.replace(answers, attributes={"occlusion": degree}, instances=instances))
        if number < N_SHOWN:
            draw_overlay(frame, run.recognizer.recognize(frame), pictures / f"scene-{number}.png")
        progress("recognize scenes", number + 1, N_SCENES, "")
    return grouped


def _instances(run: Run, answers: Sequence[FrameAnswers]) -> Iterator[dict[str, Any]]:
    """Yield the answers of every fusion for each instance."""
    for frame in answers:
        fused = {name: by_run[0] for name, by_run in fuse_answers(frame.instances, [run]).items()}
        for row, instance in enumerate(frame.instances):
            yield {
                "frame": frame.frame,
                "label": instance.label,
                "truth": instance.truth,
                "attributes": frame.attributes,
                "answers": {
                    name: (run.classes[p.class_index[row]], float(p.confidence[row]))
                    for name, p in fused.items()
                    if p.described[row]
                },
                "occluded": instance.occluded,
                "reason": instance.reason,
            }


def _write_report(out: Path, summary: DemoSummary, n_objects: int, n_views: int) -> None:
    header = ["instances", "count", *summary.names]
    rows = [
        [subset, str(summary.instances[subset]), *(f"{value:.3f}" for value in values)]
        for subset, values in summary.accuracy.items()
    ]

    def picture(name: str, caption: str, width: Literal["full", "half"] = "full") -> Picture:
        return Picture(f"pictures/{name}.png", caption, width)

    lead = (
        f"Trained on {n_views:,} synthetic views of {n_objects} objects, evaluated on {N_SCENES} cluttered scenes "
        "as ten simulated cameras see them: with other light and colours, colour shifted against depth, noise and "
        "holes in depth, and masks that are too small or too large. "
        f"This call of the command took {summary.seconds:.0f} s and {summary.peak_gib:.1f} GiB of memory."
    )
    accuracy = (
        "Fraction of the instances that are recognized correctly. CE uses colour only, TOPS shape only, TOPS2 "
        "both; THOR2 is the fusion of TOPS and TOPS2. Occlusion is low if 5 to 30 % of an object are occluded, "
        "and high if more are."
    )
    descriptor = (
        "Left: the point cloud and its slices. Top: the persistence image of each slice (shape). Bottom: the "
        "colour vectors of the strips of each slice."
    )
    differences = "Some objects differ from another one in colour only, some in shape only."
    caption = "Outline, recognized object, confidence and the more confident classifier."
    view = picture("descriptor", "One view of the blue mug.")
    scenes = [picture(f"scene-{number}", caption, "half") for number in range(N_SHOWN)]
    fit = [
        picture("confusion", "Confusion matrix of THOR2 in the scenes.", "half"),
        picture("training", "Loss and accuracy on the training views.", "half"),
    ]
    sections = [
        Section("Accuracy", accuracy, (header, rows), [picture("accuracy", "Accuracy by occlusion.")]),
        Section("Scenes", "Recognition results in the first scenes.", pictures=scenes),
        Section("Objects", differences, pictures=[picture("objects", "The objects, as rendered for training.")]),
        Section("From a view to its descriptor", descriptor, pictures=[view]),
        Section("Confusions and training", pictures=fit),
    ]
    write_page(out / "report.html", title="THOR2 on built-in objects", lead=lead, sections=sections)
