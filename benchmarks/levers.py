"""Effects of settings on other cameras: `python -m benchmarks.levers --meshes DIR --frames DIR... --out OUT`.

A lever is a row of `LEVERS`. For each lever, `thor2 train` trains recognizers with several seeds on views that are
rendered once by `thor2 render`; they are evaluated like in `benchmarks.cameras`. Levers that differ only in recognition
share their trainings. The results are in

OUT/views/*, OUT/runs/*/seed-N    views and trained runs
OUT/cells/LEVER/seed-N.json       results of one run
OUT/levers.json, OUT/levers.md    mean and standard deviation of each lever; written again after each lever

When the command is repeated, it resumes: finished views, runs and cells are kept, and there may be more levers or
seeds. The cells of a lever are computed again if its row has changed.

The relaxed descriptor is not among the levers, since training with it takes several times as long.
"""

import argparse
import dataclasses
import json
import math
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import cameras
from benchmarks.paper import markdown_table
from benchmarks.timing import print_step
from thor2_jax.errors import InputError
from thor2_jax.files import write_text
from thor2_jax.model.fusion import DEFAULT_RULE
from training.evaluation.answers import ALL_CLASSIFIERS, BOTH, GALLERY, Rule
from training.evaluation.runs import Run, load_runs
from training.objects.meshes import find_meshes, load_mesh
from training.objects.surfaces import surfaces_of
from training.readers.labelled import LabelledFrame
from training.storage.jobs import begin_job
from training.views.mesh_views import mesh_views

RENDER = "--azimuth-step 20 --polar-step 15 --copies 2 --illumination --occlusion --sensor --segmentation"
"""Default options for all renderings: the cameras and the first four augmentations of the default protocol."""


@dataclasses.dataclass(frozen=True)
class Lever:
    """A change of training or recognition; the default values change nothing.

    Attributes:
        name: name in the table.
        render: additional options of `thor2 render`.
        train: additional options of `thor2 train`.
        looks: number of looks at a cloud in recognition; None uses the number of the run.
        fusion: evaluated column, see `fusions`; None uses the column with the run's answers. With "gallery" or "both",
            the meshes are enrolled.
        rule: fusion rule.
    """

    name: str
    render: str = ""
    train: str = ""
    looks: int | None = 1
    fusion: str | None = "THOR2"
    rule: Rule = DEFAULT_RULE

    @property
    def training(self) -> str:
        """Directory name of its runs."""
        return _slug(f"{self.render} {self.train}")

    @property
    def enrolls(self) -> bool:
        """Whether the meshes are enrolled in its recognizer."""
        return self.fusion in (GALLERY, BOTH)


PLAIN = "--epochs 24 --orientation-copies 0 --embedding 0"
ORIENTED = "--epochs 24 --orientation-copies 2 --embedding 0"
DISTRACTED = "--epochs 24 --orientation-copies 2 --embedding 1500 --classifiers tops,tops2,ce"
"""Options of trainings without orientation copies and embedding, with the copies only, and with both."""

LEVERS = (
    Lever("default", train=PLAIN),
    Lever("2 looks in recognition", train=PLAIN, looks=2),
    Lever("4 looks in recognition", train=PLAIN, looks=4),
    Lever("orientation copies in training", train=ORIENTED),
    Lever("orientation copies, 4 looks", train=ORIENTED, looks=4),
    Lever("embedding fitted on distractors, alone", train=DISTRACTED, looks=4, fusion="embedding"),
    Lever("with THOR2", train=DISTRACTED, looks=4, fusion=ALL_CLASSIFIERS),
    Lever('fusion rule "max"', train=PLAIN, rule="max"),
    Lever('fusion rule "mean"', train=PLAIN, rule="mean"),
    Lever("CE, TOPS and TOPS2", train=PLAIN, fusion="CE+TOPS+TOPS2"),
    Lever("gallery", train=PLAIN, fusion=GALLERY),
    Lever("classifiers and gallery", train=PLAIN, fusion=BOTH),
    Lever("registration and base in training", render="--registration --base", train=PLAIN),
    Lever("five copies in fewer epochs", render="--copies 5", train="--epochs 16 --orientation-copies 1 --embedding 0"),
    Lever("total", render="--registration --base --copies 5", looks=None, fusion=None),
)
"""The table's rows. The default is as in versions without orientation copies and distractors; "total" is the present
default of `thor2 train` and of recognition."""

COLUMNS = {
    "real frames": (cameras.ORIGINAL, "accuracy"),
    "simulated cameras": (cameras.ALL, "accuracy"),
    "steady, real": (cameras.ORIGINAL, "steadiness"),
    "steady, simulated": (cameras.ALL, "steadiness"),
    "AUROC, real": (cameras.ORIGINAL, "auroc"),
    "AUROC, simulated": (cameras.ALL, "auroc"),
    "unknown named, real": (cameras.ORIGINAL, "unknown_named"),
    "unknown named, simulated": (cameras.ALL, "unknown_named"),
    "calibration error": (cameras.ORIGINAL, "calibration_error"),
}
"""Column of the table -> frames and metric."""


def _slug(options: str) -> str:
    """Return options as a directory name."""
    words = (re.sub(r"[^\w.-]|_", "-", word.strip("-")) for word in shlex.split(options))
    return "_".join(words) or "default"


class Table:
    """The cells of the table in a directory, with the data for computing them.

    Attributes:
        out: directory of the table.
        options: command line.
        frames: the labelled frames.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        """Read the frames, and check that the directory is new or belongs to the same job.

        Raises:
            InputError: the directory belongs to another job, or a frame or a mesh table cannot be read.
            OSError: a file cannot be read or written.
        """
        self.out: Path = options.out
        self.options = options
        self.meshes = find_meshes(options.meshes, options.names)
        self.frames: list[LabelledFrame] = cameras.labelled_frames(options.frames, options.ignore)
        job = {
            "meshes": {name: str(path.resolve()) for name, path in self.meshes.items()},
            "frames": [item.identifier for item in self.frames],
            "ignore": list(options.ignore),
            "cameras": options.cameras,
            "render": options.render,
            "train": options.train,
        }
        begin_job(self.out, job)

    def cell(self, lever: Lever, seed: int) -> cameras.RunResults | None:
        """Return the results of a lever with a seed; None if they are not computed yet."""
        file = self._cell_file(lever, seed)
        if not file.is_file():
            return None
        stored = json.loads(file.read_bytes())
        return stored["results"] if stored["lever"] == dataclasses.asdict(lever) else None

    def _cell_file(self, lever: Lever, seed: int) -> Path:
        return self.out / "cells" / _slug(shlex.quote(lever.name)) / f"seed-{seed}.json"

    def train(self, lever: Lever, seed: int) -> Path:
        """Render the views and train a run, unless both are finished, and return the run directory."""
        source = ["--meshes", str(self.options.meshes)]
        if self.options.names:
            source += ["--names", str(self.options.names)]
        views, run = self.out / "views" / _slug(lever.render), self.out / "runs" / lever.training / f"seed-{seed}"
        workers = ["--workers", str(self.options.workers)]
        _thor2("render", *source, "--out", views, *workers, *shlex.split(f"{self.options.render} {lever.render}"))
        training = shlex.split(f"{self.options.train} {lever.train}")
        _thor2("train", "--dataset", views, "--out", run, "--seed", seed, *training)
        return run

    def _load(self, lever: Lever, directories: Sequence[Path]) -> list[Run]:
        """Load runs and apply the lever's changes to them."""
        runs = load_runs(directories)
        for run in runs:
            recognizer = run.recognizer
            if lever.looks is not None:
                config = dataclasses.replace(recognizer.run.config, looks=lever.looks)
                changed = dataclasses.replace(recognizer.run, config=config)
                recognizer.model = dataclasses.replace(recognizer.model, run=changed)
            if lever.enrolls:
                recognizer.objects.open(
                    self.out / "galleries" / f"{recognizer.objects.embedding.fingerprint[:12]}-surfaces"
                )
                for name, path in self.meshes.items():
                    if name in run.classes and name not in recognizer.gallery.objects:
                        surface = surfaces_of([load_mesh(path)]).arrays
                        recognizer.objects.enroll(name, mesh_views(path), "mesh", surface, extend=True)
        return runs

    def compute(self, levers: Sequence[Lever], seeds: Sequence[int]) -> None:
        """Compute the missing cells of levers that differ only in the fusion, with one evaluation."""
        missing = [seed for seed in seeds if any(self.cell(lever, seed) is None for lever in levers)]
        if not missing:
            return
        directories = []
        for seed in missing:
            print_step(f"{levers[0].name}: training with seed {seed}")
            directories.append(self.train(levers[0], seed))
        runs = self._load(levers[0], directories)

        names = ", ".join(lever.name for lever in levers)
        seen = cameras.CAMERAS[self.options.cameras]
        answers = cameras.answers_by_camera(runs, self.frames, seen, lambda camera: print_step(f"{names}: {camera}"))
        for lever in levers:
            for seed, results in zip(missing, cameras.measure(runs, answers, lever.fusion, lever.rule), strict=True):
                self._write_cell(lever, seed, results)

    def _write_cell(self, lever: Lever, seed: int, results: cameras.RunResults) -> None:
        file = self._cell_file(lever, seed)
        file.parent.mkdir(parents=True, exist_ok=True)
        plain = {
            name: {metric: None if math.isnan(value) else value for metric, value in values.items()}
            for name, values in results.items()
        }
        write_text(file, json.dumps({"lever": dataclasses.asdict(lever), "results": plain}, indent=1) + "\n")

    def write(self, levers: Sequence[Lever], seeds: Sequence[int]) -> str:
        """Write mean and standard deviation of the levers with complete cells, and return the table."""
        report, rows = {}, []
        for lever in levers:
            cells = [results for seed in seeds if (results := self.cell(lever, seed)) is not None]
            if len(cells) < len(seeds):
                continue
            summary = report[lever.name] = cameras.summarize(cells)
            values = [
                cameras.mean_and_deviation(summary[part][metric]).replace("+-", "±") if part in summary else "-"
                for part, metric in COLUMNS.values()
            ]
            rows.append([lever.name, str(len(cells)), *values])
        table = markdown_table(["lever", "runs", *COLUMNS], rows)
        write_text(self.out / "levers.json", json.dumps(report, indent=1) + "\n")
        write_text(self.out / "levers.md", table)
        return table


def _thor2(*arguments: object) -> None:
    command = [sys.executable, "-m", "training.cli", *map(str, arguments), "--quiet"]
    if subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode:
        raise InputError(f"the command failed: {shlex.join(command)}")


def grouped(levers: Sequence[Lever]) -> list[list[Lever]]:
    """Return groups of levers that share trainings, descriptors and galleries, in the order of their first levers."""
    groups: dict[tuple[Any, ...], list[Lever]] = {}
    for lever in levers:
        key = lever.training, lever.looks, lever.enrolls
        groups.setdefault(key, []).append(lever)
    return list(groups.values())


def main() -> None:
    """Compute the missing cells and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", type=Path, required=True, metavar="DIR", help="as for thor2 render")
    parser.add_argument("--names", type=Path, metavar="FILE", help="as for thor2 render")
    parser.add_argument("--frames", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, metavar="OUT")
    parser.add_argument("--seeds", type=int, default=3, help="number of trainings (%(default)s)")
    parser.add_argument("--levers", nargs="+", metavar="NAME", help=f"of: {', '.join(lever.name for lever in LEVERS)}")
    cameras.add_camera_options(parser)
    parser.add_argument("--render", default=RENDER, metavar="OPTIONS", help='for all renderings ("%(default)s")')
    parser.add_argument("--train", default="", metavar="OPTIONS", help="for all trainings")
    parser.add_argument("--workers", type=int, default=2, help="rendering processes")
    options = parser.parse_args()
    by_name = {lever.name: lever for lever in LEVERS}
    unknown = [name for name in options.levers or () if name not in by_name]
    if unknown:
        parser.error(f"levers: {unknown[0]!r} is none of {', '.join(by_name)}")
    if options.seeds < 1:
        parser.error(f"seeds is {options.seeds}; expected at least 1")
    levers = [by_name[name] for name in options.levers or by_name]
    seeds = range(options.seeds)
    try:
        table = Table(options)
        for group in grouped(levers):
            table.compute(group, seeds)
            print(table.write(LEVERS, seeds), flush=True)
    except (InputError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
