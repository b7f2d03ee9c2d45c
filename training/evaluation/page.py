"""An evaluation as one page for people: `report.html` and its pictures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from training.baselines.baseline import TITLES
from training.evaluation.frame_pictures import Gallery
from training.evaluation.fusion import RULES
from training.evaluation.published import published, published_seconds
from training.evaluation.results import COVERAGE
from training.reports.html import Picture, Section, Table, write_page
from training.reports.instance_pictures import draw_reliability
from training.reports.plots import draw_accuracy, draw_confusion_counts

__all__ = ["accuracy_table", "figure_text", "write_report_page"]

WORST = 12
"""Confusions shown."""

NOTHING = {"mean": None, "std": None}

BARS = ("forest", "PointNet", "THOR", "CE", "TOPS", "TOPS2", "THOR2")
MOST_BARS = 8
"""Cells that fit into a picture."""


def figure_text(figure: Mapping[str, Any]) -> str:
    """Mean, and standard deviation if there are several runs."""
    if figure["mean"] is None:
        return "–"
    return f"{figure['mean']:.3f}" + ("" if figure["std"] is None else f" ±\u00a0{figure['std']:.3f}")


def accuracy_table(table: Mapping[str, Any], joinings: Sequence[str], methods: Sequence[str] = ()) -> Table:
    """Header and rows of a table as `results` gives it; beside it, what is published of `methods` for its cells."""
    methods = [method for method in methods if any(method in cell["published"] for cell in table["cells"])]
    header = [", ".join(table["by"]), "instances", *joinings, *(f"{method}, published" for method in methods)]
    rows = []
    for cell in table["cells"]:
        others = [cell["published"].get(method) for method in methods]
        rows.append(
            [
                ", ".join(cell["where"].values()) or "all",
                f"{cell['instances']:,}",
                *(figure_text(cell["accuracy"][name]) for name in joinings),
                *("–" if value is None else f"{value:.3f}" for value in others),
            ]
        )
    return header, rows


def write_report_page(found: Mapping[str, Any], gallery: Gallery, out: Path) -> None:
    """Draw the pictures and write the page, which appears whole or not at all.

    Args:
        found: what `results` gives, with "dataset" (kind, path), "worst" (confusions) and "shown" (names of the
            gallery's frames) added.
        gallery: of the pictures taken on the way.
        out: folder of the page; that of the gallery.

    Raises:
        OSError: something cannot be written.
    """
    sections: list[Section] = []
    if found["joinings"]:
        sections += [
            *_accuracy(found, out),
            _joined(found),
            _confidence(found, out),
            _confusions(found, gallery, out),
        ]
    pictures = [
        Picture(_relative(gallery.frame(number), out), f"Frame {name}.", half=True)
        for number, name in zip(gallery.shown, found["shown"], strict=True)
    ]
    text = "Green: named rightly. Red: the answer, and in brackets the truth. Answers of the first run."
    sections += [("Frames", text, None, pictures), _measured(found)]
    dataset, counts = found["dataset"], found["instances"]
    runs = f"{len(found['runs'])} trained {'run' if len(found['runs']) == 1 else 'runs'}"
    lead = f"{found['speed']['frames']:,} frames, {counts['scored']:,} instances scored, {runs}, {dataset['path']}"
    write_page(out / "report.html", title=f"Evaluation on {dataset['kind']}", lead=lead, sections=sections)


def _relative(path: Path, out: Path) -> str:
    return path.relative_to(out).as_posix()


def _accuracy(found: Mapping[str, Any], out: Path) -> list[Section]:
    known = published(found["dataset"]["kind"])
    methods = known.methods if known else ()
    text = "Share of instances named rightly; those that could not be described count as wrong. CE reads colour alone, "
    text += f"TOPS shape alone, TOPS2 both; several are joined by {found['rule']} (below, ways to join are compared). "
    if not set(found["joinings"]).isdisjoint(TITLES.values()):
        text += (
            "Trained on the same views and asked about the same described instances: THOR, the predecessor, a library "
        )
        text += "of classifiers of shape; a random forest on colour histogram and extents; a coloured PointNet. "
    if len(found["runs"]) > 1:
        text += f"Mean and sample standard deviation over {len(found['runs'])} runs. "
    if known:
        text += f"Published figures: {known.source}. They are of {known.concerns}; only the same frames compare. "
        text += f"Not found, so not shown: {known.missing}."
    whole, *tables = found["accuracy"][found["rule"]]
    sections: list[Section] = [("Accuracy", text, accuracy_table(whole, found["joinings"], methods), [])]
    names = [name for name in BARS if name in found["joinings"]]
    for number, table in enumerate(tables):
        pictures = []
        if names and 1 < len(table["cells"]) <= MOST_BARS:
            cells = {"\n".join(cell["where"].values()): cell for cell in table["cells"]}
            file = out / f"accuracy-{number}.png"
            heights = {part: [cell["accuracy"][n]["mean"] for n in names] for part, cell in cells.items()}
            draw_accuracy(names, heights, {part: cell["instances"] for part, cell in cells.items()}, file)
            pictures = [Picture(file.name, f"Accuracy by {' and '.join(table['by'])}.")]
        heading = f"By {' and '.join(table['by'])}"
        sections.append((heading, "", accuracy_table(table, found["joinings"], methods), pictures))
    return sections


def _joined(found: Mapping[str, Any]) -> Section:
    cells = {rule: found["accuracy"][rule][0]["cells"][0]["accuracy"] for rule in RULES}
    joined = [n for n in found["joinings"] if "+" in n or n == "THOR2"]
    rows = [[n, *(figure_text(cells[rule].get(n, NOTHING)) for rule in RULES)] for n in joined]
    text = (
        "The paper's rule takes the classifier with the larger top-1 probability; the others take the largest mean "
        "of the probabilities, or of their logarithms; \"calibrated\" is the paper's rule after each classifier's own "
        f"temperature. thor2 recognize and the tables of this page use {found['rule']}."
    )
    return "Ways to join classifiers", text, (["", *RULES], rows), []


def _confidence(found: Mapping[str, Any], out: Path) -> Section:
    columns = {
        "expected calibration error": ("confidence", "expected_calibration_error"),
        "calibrated": ("calibrated_confidence", "expected_calibration_error"),
        "AUROC right or wrong": ("confidence", "auroc_right"),
        f"accuracy of the surest {COVERAGE:.0%}": ("confidence", "accuracy_at_coverage"),
        "their least confidence": ("confidence", "threshold_at_coverage"),
        "AUROC known or unknown": ("confidence", "auroc_known"),
        "after calibration": ("calibrated_confidence", "auroc_known"),
        "unknown below that confidence": ("confidence", "unknown_refused"),
    }
    rows = [
        [name, *(figure_text(found[table].get(name, {}).get(key, NOTHING)) for table, key in columns.values())]
        for name in found["confidence"]
    ]
    text = (
        "Calibration error over 15 bins of equal width, before and after temperatures fitted on the synthetic views "
        f"that each run's training held out{_temperatures(found)}. AUROC: the chance that a right answer is surer than "
        "a wrong one, or that to an object of the training surer than that to another object. Where the least sure "
        f"{1 - COVERAGE:.0%} of the answers to objects of the training are called unknown, the last column tells how "
        "many of the other objects are."
    )
    draw_reliability(found["reliability"], found["main"], out / "reliability.png")
    caption = f"How often {found['main']} is right, by its confidence."
    return "Confidence", text, (["", *columns], rows), [Picture("reliability.png", caption, half=True)]


def _temperatures(found: Mapping[str, Any]) -> str:
    known = [f"{name} {figure_text(t)}" for name, t in found["temperatures"].items() if t["runs"]]
    return f" ({', '.join(known)})" if known else "; these runs held out none"


def _confusions(found: Mapping[str, Any], gallery: Gallery, out: Path) -> Section:
    counts, classes, main = np.array(found["confusion"]), found["classes"], found["main"]
    draw_confusion_counts(counts, classes, main, out / "confusion.png")
    pictures = [Picture("confusion.png", f"Counts of {main}'s answers, all runs together.")]
    rows = []
    for worst in found["worst"]:
        truth, answer = worst["truth"], worst["answer"]
        rows.append([f"{truth} named {answer}", f"{worst['count']}", f"{worst['share']:.0%}"])
        crop = gallery.confusion(truth, answer)
        if crop.is_file():
            pictures.append(Picture(_relative(crop, out), f"{truth} named {answer}", small=True))
    if not rows:
        return "Confusions", "There are none.", None, pictures
    text = "The most frequent confusions, each with the instance that the wrong answer was surest of."
    return "Confusions", text, (["", "answers", "of all to this object"], rows), pictures


def _measured(found: Mapping[str, Any]) -> Section:
    speed, counts = found["speed"], found["instances"]
    rate = f"{speed['frames_per_second']:.2f}" if speed["frames_per_second"] else "–"
    text = f"{rate} frames a second from files to all answers of all runs, compilation included"
    if speed["median_seconds"]:
        text += f"; median {speed['median_seconds']:.2f} s a frame"
    text += "." + "".join(f" {name}: {seconds} s a frame." for name, seconds in published_seconds().items())
    text += f" Runs: {', '.join(found['runs'])}."
    rows = [[f"not described: {reason}", f"{n:,}"] for reason, n in counts["not_described"].items()]
    rows += [[f"not scored, no class of the runs: {name}", f"{n:,}"] for name, n in counts["no_class"].items()]
    return "How it was measured", text, (["", "instances"], rows) if rows else None, []
