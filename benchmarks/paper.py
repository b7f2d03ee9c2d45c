"""The paper's whole comparison: `python -m benchmarks.paper --meshes DIR --scenes DIR --frames DIR... --out OUT`.

For each dataset, `thor2 render` renders views and crops, and `thor2 train` trains THOR2 and then each baseline on them,
in folds. All are evaluated on the same instances. --scenes is a dataset in the layout of UW-IS Occluded, and --frames
are folders of labelled frames; one of the two may be left out. The results are in

OUT/DATASET/views, run, evaluation*    views, trained models, answers and pages of each dataset
OUT/paper.json, paper.md, paper.png    tables of the paper with our values, paired comparisons, time and memory

When the command is repeated with the same options, it resumes: finished views, models, frames and measurements are
kept. Without --weights, networks are trained from scratch, and their accuracy does not represent the paper's networks.
With --real, the labelled frames of these folders are added to the views, as in the last tables of the paper. THOR is
then left out, since real frames have no camera angles.
"""

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.paper_measurement import Dataset, compare_runs, recognition_seconds
from benchmarks.timing import print_step
from thor2_jax.errors import InputError
from thor2_jax.files import atomic_write, file_digest, write_text
from thor2_jax.model.fusion import DEFAULT_RULE
from training.baselines.baseline import baseline_file
from training.baselines.job import TITLES, check_baselines, crop_size, pretrained_files
from training.evaluation.page import accuracy_table, comparison
from training.evaluation.runs import load_runs
from training.objects.meshes import find_meshes
from training.readers.frames import FrameFolder
from training.readers.labelled import LabelledFrames
from training.readers.uwis import UWISOccluded
from training.storage.jobs import begin_job
from training.train_run import find_run_directories

BASELINES = "thor,forest,pointnet,rcfusion-small,vit-cnn-small,rgbd-vit-small,templates"
RENDER = "--azimuth-step 20 --polar-step 15 --illumination --occlusion --sensor --segmentation --registration --base"
"""Views and augmentations of the default protocol."""

THOR2 = "THOR2"
"""Name under which the costs list the training of THOR2's classifiers."""


class Comparison:
    """The trainings and evaluations in an output directory.

    Attributes:
        out: the directory.
        options: command line.
        baselines: names of the baselines, in the order of training.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        """Read the datasets, and check that the directory is new or belongs to the same job.

        Raises:
            InputError: the directory belongs to another job, or a dataset, a table, meshes or weights cannot be used.
            OSError: a file cannot be read or written.
        """
        self.out: Path = options.out
        self.options = options
        names = [name.strip() for name in options.baselines.split(",") if name.strip()]
        checked = check_baselines(names, options.weights, self.out)
        self.baselines = [name for name in checked if not (options.real and name == "thor")]
        self.datasets = _datasets(options)
        tables = {"scenes": options.scene_names, "frames": options.frame_names}
        for name in self.datasets:
            find_meshes(options.meshes, tables[name])
        weights = sorted(options.weights.glob("*.safetensors")) if options.weights else []
        job = {
            "meshes": str(options.meshes.resolve()),
            "names": {name: str(path) if path else None for name, path in tables.items()},
            "datasets": {name: list(dataset.parts) for name, dataset in self.datasets.items()},
            "real": [str(path.resolve()) for path in options.real],
            "weights": {path.name: file_digest(path) for path in weights},
            "folds": options.folds,
            "render": options.render,
            "train": options.train,
        }
        begin_job(self.out, job)

    def train(self, name: str) -> None:
        """Render the views of a dataset and train all its models, unless they are finished."""
        options, directory = self.options, self.out / name
        views, table = directory / "views", getattr(options, "scene_names" if name == "scenes" else "frame_names")
        source = ["--meshes", options.meshes, *(["--names", table] if table else [])]
        size = crop_size(self.baselines, options.weights is not None)
        crops = [] if size is None else ["--crops", size]
        self._run(name, "render", "render", *source, "--out", views, *shlex.split(options.render), *crops,
                  "--workers", options.workers)  # fmt: skip
        real = ["--frames", *options.real] if options.real else []
        train = ["train", "--dataset", views, *real, "--out", directory / "run", "--folds", options.folds]
        train += ["--embedding", 0, *shlex.split(options.train)]
        self._run(name, THOR2, *train)
        for baseline in self.baselines:
            weights = ["--weights", options.weights] if options.weights and pretrained_files(baseline) else []
            self._run(name, baseline, *train, "--baselines", baseline, *weights)

    def _run(self, dataset: str, method: str, *arguments: object) -> None:
        """Run a command of `thor2` and store its time and memory, unless they are already stored."""
        file = self.out / dataset / "costs.json"
        costs = json.loads(file.read_bytes()) if file.is_file() else {}
        if method in costs:
            return
        print_step(f"{dataset}: {method}")
        command = [sys.executable, "-m", "training.cli", *map(str, arguments), "--quiet"]
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise InputError(f"the command failed: {shlex.join(command)}")
        costs[method] = {
            "seconds": round(time.perf_counter() - start, 1),
            "processor_seconds": round(usage.ru_utime + usage.ru_stime, 1),
            "peak_memory_mb": round(usage.ru_maxrss / 1024),
        }
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, json.dumps(costs, indent=1) + "\n")

    def evaluate(self, name: str) -> dict[str, Any]:
        """Evaluate the models of a dataset and return the results."""
        directory = self.out / name
        runs = load_runs([directory / "run"])
        dataset = self.datasets[name]
        print_step(f"{name}: evaluation")
        results = compare_runs(dataset, runs, directory)
        costs = json.loads((directory / "costs.json").read_bytes())
        timing = directory / "recognition.json"
        if not timing.is_file():
            write_text(timing, json.dumps(recognition_seconds(runs[0], dataset), indent=1) + "\n")
        for method, seconds in json.loads(timing.read_bytes()).items():
            costs[method]["milliseconds_per_instance"] = 1000 * seconds
        for baseline in self.baselines:
            files = [baseline_file(run, baseline) for run in find_run_directories([directory / "run"])]
            costs[baseline]["file_mb"] = round(sum(file.stat().st_size for file in files) / len(files) / 1e6, 1)
        return {**results, "costs": costs}

    def write(self, results: dict[str, Any]) -> str:
        """Write the report and return its text."""
        options = self.options
        conditions = {
            "date": time.strftime("%Y-%m-%d"),
            "processors": len(os.sched_getaffinity(0)),
            "note": options.note,
            "folds": options.folds,
            "render": options.render,
            "train": f"--embedding 0 {options.train}".strip(),
            "pretrained": options.weights is not None,
            "real": [path.name for path in options.real],
            "baselines": self.baselines,
        }
        report = {"conditions": conditions, "datasets": results}
        write_text(self.out / "paper.json", json.dumps(report, indent=1) + "\n")
        draw_claims(report, self.out / "paper.png")
        text = report_text(report)
        write_text(self.out / "paper.md", text)
        return text


NAMES = {"scenes": "Rendered scenes in the layout of UW-IS Occluded", "frames": "Real frames"}
COLORS = {"holds": "#2a7f3f", "undecided": "#777777", "does not hold": "#b03030"}


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    first, *others = (f"| {' | '.join(row)} |" for row in (header, *rows))
    return "\n".join([first, "|---" * len(header) + "|", *others]) + "\n"


def _points(value: float) -> str:
    return f"{100 * value:+.1f}"


def _claims_table(claims: Sequence[Mapping[str, Any]]) -> str:
    header = ["claim", "difference", "95 % interval", "placements better / worse", "McNemar p", "on this data"]
    rows = [
        [
            each["claim"],
            _points(each["difference"]),
            f"{_points(each['low'])} to {_points(each['high'])}",
            f"{each['better']} / {each['worse']}",
            f"{each['p_value']:.2g}",
            each["verdict"],
        ]
        for each in claims
    ]
    return markdown_table(header, rows)


def _cost_table(costs: Mapping[str, Mapping[str, Any]], folds: int) -> str:
    header = ["method", "training, s a fold", "processor, s a fold", "peak memory, MB", "model, MB", "ms an instance"]
    rows = []
    for method, cost in costs.items():
        fold = folds if method != "render" else 1
        rows.append(
            [
                "views and crops" if method == "render" else TITLES.get(method, method),
                f"{cost['seconds'] / fold:.0f}",
                f"{cost['processor_seconds'] / fold:.0f}",
                f"{cost['peak_memory_mb']:,}",
                f"{cost['file_mb']:.1f}" if "file_mb" in cost else "-",
                f"{cost['milliseconds_per_instance']:.1f}" if "milliseconds_per_instance" in cost else "-",
            ]
        )
    return markdown_table(header, rows)


def _dataset_text(name: str, results: Mapping[str, Any], folds: int) -> str:
    instances = results["instances"]
    parts = [
        f"## {NAMES[name]}\n",
        f"{results['objects']} objects, {results['frames']} frames, {instances['scored']} instances "
        f"({results['placements']['count']} placements).",
    ]
    if results["scratch"]:
        parts[-1] += (
            f" {', '.join(results['scratch'])}: trained from scratch, without pretrained weights. Their accuracy does "
            "not represent the published networks."
        )
    parts.append("\n### Claims\n")
    for rule, claims in results["claims"].items():
        note = "this project's" if rule == DEFAULT_RULE else "the paper's"
        parts.append(f"Fusion rule `{rule}` ({note}), accuracy of THOR2 minus the other's, in percentage points:\n")
        parts.append(_claims_table(claims))
    parts.append(f"### Accuracy, fusion rule `{DEFAULT_RULE}`\n")
    for table in results["accuracy"][DEFAULT_RULE]:
        parts.append(markdown_table(*accuracy_table(table, results["fusions"])))
    if results["by_part"]:
        header = ["frames", "instances", "placements", *results["fusions"]]
        rows = [
            [
                part,
                f"{v['instances']}",
                f"{v['placements']}",
                *(f"{v['accuracy'].get(t, float('nan')):.3f}" for t in results["fusions"]),
            ]
            for part, v in results["by_part"].items()
        ]
        parts.append(markdown_table(header, rows))
    if results["published_tables"]:
        parts.append("### Tables of the paper, ours beside the printed figures\n")
        for table in results["published_tables"]:
            title, text, compared = comparison(table, "THOR2")
            parts += [f"**{title}**\n", markdown_table(*compared), text + "\n"]
    parts += ["### Time and memory\n", _cost_table(results["costs"], folds)]
    return "\n".join(parts)


def report_text(report: Mapping[str, Any]) -> str:
    """Return the report as Markdown."""
    conditions = report["conditions"]
    folds = conditions["folds"]
    trained = f"{folds} folds" if folds > 1 else "one model without a held-out set"
    real = f" Labelled real frames joined the views: {', '.join(conditions['real'])}." if conditions["real"] else ""
    lead = (
        "# The paper's comparison\n\n"
        f"Measured on {conditions['date']} on {conditions['processors']} processors. {conditions['note']} "
        f"Every method was trained on the same views ({trained}) and evaluated on the same instances. "
        f"Views: `thor2 render {conditions['render']}`. Training: `thor2 train {conditions['train']}`.{real} "
        "Differences are between the accuracies over all instances. Their interval is a 95 % bootstrap interval that "
        "resamples placements (an object that does not move is one placement), and McNemar's exact test counts "
        "placements. A claim "
        "holds if the whole interval is above 0 and p is below 0.05; it does not hold if the whole interval is below 0 "
        "and p is below 0.05; otherwise it is undecided. Times include reading the views and compiling; methods on "
        "clouds also describe the frame, and networks crop it.\n\n"
    )
    return lead + "\n".join(_dataset_text(name, results, folds) for name, results in report["datasets"].items())


def draw_claims(report: Mapping[str, Any], path: Path) -> None:
    """Draw the differences of the default rule with intervals, coloured by verdict (PNG); raise OSError on failure."""
    datasets = report["datasets"]
    n_rows = max(len(results["claims"][DEFAULT_RULE]) for results in datasets.values())
    figure = Figure(figsize=(6.5 * len(datasets), 0.42 * n_rows + 1.5), layout="constrained")
    for axes, (name, results) in zip(
        figure.subplots(1, len(datasets), squeeze=False)[0], datasets.items(), strict=True
    ):
        claims = results["claims"][DEFAULT_RULE]
        for row, each in enumerate(claims):
            color = COLORS[each["verdict"]]
            axes.plot([100 * each["low"], 100 * each["high"]], [row, row], color=color, linewidth=2)
            axes.plot([100 * each["difference"]], [row], "o", color=color)
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_yticks(range(len(claims)), [each["claim"] for each in claims])
        axes.invert_yaxis()
        axes.set_xlabel("accuracy of THOR2 minus the other's,\npercentage points, with 95 % intervals")
        axes.set_title(f"{NAMES[name]}: {results['instances']['scored']} instances", fontsize=10)
    verdicts = {claim["verdict"] for each in datasets.values() for claim in each["claims"][DEFAULT_RULE]}
    handles = [
        Line2D([], [], color=color, marker="o", label=name) for name, color in COLORS.items() if name in verdicts
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9, frameon=False)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")


def _datasets(options: argparse.Namespace) -> dict[str, Dataset]:
    datasets: dict[str, Dataset] = {}
    if options.scenes:
        datasets["scenes"] = Dataset("uwis", {options.scenes.name: UWISOccluded(options.scenes)})
    if options.frames:
        folders: dict[str, LabelledFrames] = {path.resolve().name: FrameFolder(path) for path in options.frames}
        if len(folders) < len(options.frames):
            raise InputError("frames has several folders of one name; expected different names")
        datasets["frames"] = Dataset("frames", folders)
    return datasets


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse the command line and return its options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", type=Path, required=True, metavar="DIR", help="as for thor2 render")
    parser.add_argument("--scenes", type=Path, metavar="DIR", help="dataset in the layout of UW-IS Occluded")
    parser.add_argument("--scene-names", type=Path, metavar="FILE", help="objects of --scenes: table of name -> mesh")
    parser.add_argument("--frames", type=Path, nargs="+", default=[], metavar="DIR", help="folders of labelled frames")
    parser.add_argument("--frame-names", type=Path, metavar="FILE", help="objects of --frames: table of name -> mesh")
    parser.add_argument("--real", type=Path, nargs="+", default=[], metavar="DIR", help="labelled frames to train on")
    parser.add_argument("--out", type=Path, required=True, metavar="OUT")
    parser.add_argument("--baselines", default=BASELINES, help="comma-separated (%(default)s)")
    parser.add_argument("--weights", type=Path, metavar="DIR", help="pretrained weights, as for thor2 train")
    parser.add_argument("--folds", type=int, default=5, help="as for thor2 train (%(default)s)")
    parser.add_argument("--render", default=RENDER, metavar="OPTIONS", help='for all renderings ("%(default)s")')
    parser.add_argument("--train", default="", metavar="OPTIONS", help="additional options for all trainings")
    parser.add_argument("--note", default="", metavar="TEXT", help="note on the machine, for the report")
    parser.add_argument("--workers", type=int, default=2, help="rendering processes")
    options = parser.parse_args(arguments)
    if not options.scenes and not options.frames:
        parser.error("scenes and frames are missing; expected at least one of them")
    if options.folds < 1:
        parser.error(f"folds is {options.folds}; expected at least 1")
    return options


def main(arguments: Sequence[str] | None = None) -> None:
    """Train and evaluate missing models and write the report."""
    options = parse(arguments)
    try:
        comparison = Comparison(options)
        results: dict[str, Any] = {}
        for name in comparison.datasets:
            comparison.train(name)  # before any evaluation, since a process counts its parent's memory, too
        for name in comparison.datasets:
            results[name] = comparison.evaluate(name)
        print(comparison.write(results))
    except (InputError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
