"""The report of an evaluation as a page: `report.html` and its pictures."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thor2_jax.networks.networks import EMBEDDING
from training.baselines.job import TITLES
from training.evaluation.answers import ALL_CLASSIFIERS, RULES, main_fusion
from training.evaluation.published import published_seconds
from training.evaluation.scores import COVERAGE
from training.reports.html import Picture, Section, Table, write_page
from training.reports.plots import draw_accuracy, draw_confusion, draw_known_unknown, draw_reliability

__all__ = ["accuracy_table", "answer_texts", "comparison", "marked", "upright", "write_report_page"]

NO_VALUE = {"mean": None, "std": None}

BARS = ("forest", "PointNet", "THOR", "CE", "TOPS", "TOPS2", "THOR2")
"""Columns of the bar charts."""

MAX_GROUPS = 8
"""Largest number of table rows for which a bar chart is drawn."""


def _mean_std(statistics: Mapping[str, Any], factor: float = 1.0, digits: int = 3) -> str:
    """Return the mean as text, with the standard deviation if there are several runs."""
    if statistics["mean"] is None:
        return "–"
    values = [value for value in (statistics["mean"], statistics["std"]) if value is not None]
    return " ±\u00a0".join(f"{factor * value:.{digits}f}" for value in values)


def _marked(title: str, main: str) -> str:
    return f"{title} (thor2 recognize)" if title == main else title


def marked(table: Table, main: str) -> Table:
    """Return a table in which the column `main`, which has the answers of `thor2 recognize`, is marked."""
    header, rows = table
    return [_marked(title, main) for title in header], rows


def upright(table: Table) -> Table:
    """Return an accuracy table, transposed to one row for each fusion if it has fewer rows than fusions."""
    header, rows = table
    n_fusions = len(header) - 2
    if len(rows) >= n_fusions:
        return table
    first, *others = map(list, zip(header, *rows, strict=True))
    return ["", *first[1:]], others


def accuracy_table(table: Mapping[str, Any], titles: Sequence[str]) -> Table:
    """Return header and rows of an accuracy table of `compute_results`.

    Args:
        table: an entry of `report["accuracy"][rule]`.
        titles: fusions to show.
    """
    rows = [_row(cell, [cell["accuracy"][title] for title in titles]) for cell in table["cells"]]
    return [", ".join(table["by"]), "instances", *titles], rows


def _row(
    cell: Mapping[str, Any], values: Sequence[Mapping[str, Any]], factor: float = 1.0, digits: int = 3
) -> list[str]:
    where = ", ".join(cell["where"].values()) or "all"
    return [where, f"{cell['instances']:,}", *(_mean_std(value, factor, digits) for value in values)]


def comparison(table: Mapping[str, Any], main: str) -> tuple[str, str, Table]:
    """Return the heading, the notes, and the accuracies of a published table beside the measured ones, in percent.

    The notes have the source of the table and the differences between the data. The measured column of a published
    method, if there is one, stands before it. The column `main` is always shown.

    Args:
        table: an entry of `report["published_tables"]`.
        main: title of the column whose answers the recognizer gives.
    """
    number = "" if table["number"] is None else f" table {table['number']}"
    text = " ".join([f"In percent. Source: {table['source']}.", *table["notes"], *table["differences"]])
    methods = dict.fromkeys(method for cell in table["cells"] for method in cell["published"])
    columns: list[tuple[str, str]] = [] if main in table["ours"].values() else [("accuracy", main)]
    for method in methods:
        if method in table["ours"]:
            columns.append(("accuracy", table["ours"][method]))
        columns.append(("published", method))
    header = ["", "instances", *(f"{name}, published" if key == "published" else name for key, name in columns)]
    # The values are in percent with two decimals, as in the publications.
    rows = [_row(cell, [cell[key].get(name, NO_VALUE) for key, name in columns], 100.0, 2) for cell in table["cells"]]
    return f"Published{number}: {table['title']}", text, (header, rows)


def write_report_page(report: Mapping[str, Any], out: Path) -> None:
    """Draw the plots and write the page.

    Args:
        report: content of report.json, with scored instances.
        out: directory of the report, with the pictures of `draw_pictures`.

    Raises:
        OSError: a file cannot be written.
    """
    main = report["main"]
    published = (comparison(table, main) for table in report["published_tables"])
    sections = [
        _answer_section(report, out),
        *_accuracy_sections(report, out),
        *(Section(title, text, marked(table, main)) for title, text, table in published),
        *_fusion_sections(report),
        *_placement_sections(report),
        _confidence_section(report, out),
        *_unknown_sections(report, out),
        _frame_section(report),
        _measurement_section(report),
    ]
    dataset, runs = report["dataset"], len(report["runs"])
    lead = (
        f"Frames: {report['speed']['frames']:,}. Instances of known objects: {report['instances']['scored']:,}. "
        f"Trained models: {runs}. Dataset: {dataset['path']}"
    )
    write_page(out / "report.html", title=f"Evaluation on {dataset['kind']}", lead=lead, sections=sections)


def answer_texts(report: Mapping[str, Any]) -> list[str]:
    """Return sentences on the answers: accuracy, unknown objects that are named, wrong names."""
    counts, worst = report["answers"], report["worst"]
    without = counts["known"] - counts["correct"] - counts["wrong"]
    # The runs of sequences have no threshold.
    of = "without rejection" if report["rejection"]["threshold"]["mean"] is None else "of thor2 recognize"
    models = f", summed over {n} models" if (n := len(report["runs"])) > 1 else ""
    texts = [
        f"Accuracy of the answers {of}: {counts['correct'] / counts['known']:.3f}. "
        f"Of {counts['known']:,} instances of known objects, {counts['correct']:,} are recognized correctly, "
        f"{counts['wrong']:,} get a wrong name and {without:,} get no name{models}.",
        f"Unknown objects: {counts['unknown_named']:,} of {counts['unknown']:,} instances get a name."
        if counts["unknown"]
        else "The dataset has no unknown objects, so it does not show whether they are rejected.",
    ]
    pairs = [f"{p['truth']}{'' if p['known'] else ' (unknown)'} as {p['answer']} ({p['count']})" for p in worst]
    return texts + [f"Wrong names: {', '.join(pairs)}."] * bool(pairs)


def _answer_section(report: Mapping[str, Any], out: Path) -> Section:
    shown, rows = [], []
    for k, pair in enumerate(report["worst"]):
        truth, name = f"{pair['truth']}{'' if pair['known'] else ' (unknown object)'}", pair["answer"]
        rows.append([truth, name, f"{pair['count']}", f"{pair['share']:.0%}"])
        caption = f"{truth}, recognized as {name}: frame {pair['frame']}, label {pair['label']}"
        shown.append(Picture(f"confusions/{k}.jpg", caption, "small"))
    texts = answer_texts(report)[:2] + ["Most frequent wrong names, with the most confident instance:"] * bool(rows)
    draw_confusion(np.array(report["confusion"]), report["classes"], report["main"], out / "confusion.png")
    caption = f"Confusion matrix of {report['main']} without rejection, of objects that occur, summed over models."
    matrix = Section("Confusion matrix of the known objects", pictures=[Picture("confusion.png", caption)])
    header = ["object", "recognized as", "count", "fraction of the object's instances"]
    return Section("Answers", " ".join(texts), (header, rows) if rows else None, shown, matrix)


def _accuracy_sections(report: Mapping[str, Any], out: Path) -> list[Section]:
    sections, text = [], _accuracy_text(report)
    for number, table in enumerate(report["accuracy"][report["rule"]]):
        heading = f"Accuracy by {' and '.join(table['by'])}" if table["by"] else "Accuracy without rejection"
        chart = _bar_chart(table, report["fusions"], heading, out / f"accuracy-{number - 1}.png")
        every = upright(marked(accuracy_table(table, report["fusions"]), report["main"]))
        main = marked(accuracy_table(table, [report["main"]]), report["main"])
        sections.append(_with_fold(Section(heading, text, main), every, chart))
        text = ""
    return sections


def _with_fold(section: Section, every: Table, pictures: Sequence[Picture] = ()) -> Section:
    """Return a section on the answers of `recognize`; a whole table with more columns is folded below it."""
    if every == section.table:
        return dataclasses.replace(section, pictures=[*section.pictures, *pictures])
    folded = Section("Every classifier and baseline", table=every, pictures=pictures)
    return dataclasses.replace(section, folded=folded)


def _accuracy_text(report: Mapping[str, Any]) -> str:
    text = (
        "Fraction of the instances that are recognized correctly; an instance that could not be described counts as "
        "incorrect. "
    )
    if _fused_titles(report):
        text += (
            "CE uses colour only, TOPS uses shape only, TOPS2 uses both. THOR2 is the fusion of TOPS and TOPS2; a plus "
            f"sign marks other fusions. The fusion rule is {report['rule']}; other rules are compared below. "
        )
    elif EMBEDDING in report["fusions"]:
        text += f"The entry {EMBEDDING} shows the answers of the embedding, which uses shape and colour. "
    if ALL_CLASSIFIERS in report["fusions"]:
        named_by = main_fusion(title for title in report["fusions"] if title != ALL_CLASSIFIERS)
        names = f"the names from {named_by} with" if named_by != EMBEDDING else "these names with"
        text += (
            f"The entry {ALL_CLASSIFIERS} shows {names} the confidence from the embedding; answers below the "
            "threshold keep their names in this table. "
        )
    if not set(report["fusions"]).isdisjoint(TITLES.values()):
        text += (
            "Baselines, trained on the same views and evaluated on the same instances: THOR, the predecessor, "
            "a library of shape classifiers; a random forest on a colour histogram and side "
            "lengths; a PointNet with colour; RCFusion, ViT-CNN and RGB-D ViT, networks on crops of colour and surface "
            "normals; templates, the nearest training crop by the features of a frozen backbone. "
        )
    if report["scratch"]:
        text += (
            f"{', '.join(report['scratch'])}: trained from scratch, without pretrained weights; the accuracy does not "
            "represent the published networks. "
        )
    if len(report["runs"]) > 1:
        text += f"Values are the mean and the sample standard deviation over {len(report['runs'])} models. "
    return text


def _bar_chart(table: Mapping[str, Any], titles: Sequence[str], caption: str, path: Path) -> list[Picture]:
    names = [name for name in BARS if name in titles]
    if not names or not 1 < len(table["cells"]) <= MAX_GROUPS:
        return []
    cells = {"\n".join(cell["where"].values()): cell for cell in table["cells"]}
    heights = {group: [cell["accuracy"][name]["mean"] for name in names] for group, cell in cells.items()}
    draw_accuracy(names, heights, {group: cell["instances"] for group, cell in cells.items()}, path)
    return [Picture(path.name, f"{caption}.")]


def _fused_titles(report: Mapping[str, Any]) -> list[str]:
    return [title for title in report["fusions"] if "+" in title or title == "THOR2"]


def _fusion_sections(report: Mapping[str, Any]) -> list[Section]:
    """Return the section on fusion rules, or an empty list if no classifiers are fused."""
    cells = {rule: report["accuracy"][rule][0]["cells"][0]["accuracy"] for rule in RULES}
    titles = _fused_titles(report)
    if not titles:
        return []
    rows = [[title, *(_mean_std(cells[rule].get(title, NO_VALUE)) for rule in RULES)] for title in titles]
    text = (
        'Accuracy on all instances by fusion rule. With "max", the paper\'s rule, the classifier with the higher top-1 '
        'probability decides. "mean" and "log-mean" take the class with the highest mean probability or mean '
        'log-probability. "calibrated" is "max" after temperature scaling of each classifier. '
        f"This page and the command thor2 recognize use {report['rule']}."
    )
    return [Section("Fusion rules", text, folded=Section("Accuracy by rule", table=(["fusion", *RULES], rows)))]


def _placement_sections(report: Mapping[str, Any]) -> list[Section]:
    """Return the section on placements, or an empty list if every instance is a placement of its own."""
    placements, overall = report["placements"], report["accuracy"][report["rule"]][0]["cells"][0]
    if placements["count"] == overall["instances"]:
        return []
    header = ["", "accuracy over instances", "accuracy over placements", "steadiness"]
    columns = overall["accuracy"], placements["accuracy"], placements["steadiness"]
    rows = [[title, *(_mean_std(column[title]) for column in columns)] for title in report["fusions"]]
    text = (
        f"The {overall['instances']:,} instances are {placements['count']:,} placements: an object that does not move "
        "in neighbouring frames is one placement, since its answers are not independent. Accuracy over placements is "
        "the mean of the placements' accuracies. Steadiness is the fraction of instances that have the most frequent "
        "answer of their placement, among placements with at least two instances."
    )
    return [_main_row(Section("Placements", text, (header, rows)), report["main"])]


def _main_row(section: Section, main: str) -> Section:
    """Return a section whose table has one row for each fusion, with the main row shown and the table folded."""
    assert section.table is not None
    header, rows = section.table
    every = [[_marked(row[0], main), *row[1:]] for row in rows]
    shown = [row for each, row in zip(rows, every, strict=True) if each[0] == main]
    return _with_fold(dataclasses.replace(section, table=(header, shown)), (header, every))


def _unknown_sections(report: Mapping[str, Any], out: Path) -> list[Section]:
    """Return the section on rejection, or an empty list without unknown objects and without a threshold."""
    shares, curve, main = report["rejection"], report["known_unknown"], report["main"]
    n_unknown = sum(report["instances"]["no_class"].values())
    if curve is None and not shares["threshold"]["runs"]:
        return []
    n_known = report["instances"]["scored"]
    values = {name: _mean_std(statistics) for name, statistics in shares.items()}
    table = [
        [f"known, recognized correctly ({n_known:,} instances)", values["accuracy"], values["accuracy_at_threshold"]],
        ["known, recognized incorrectly", values["incorrect"], values["incorrect_at_threshold"]],
    ]
    if n_unknown:
        table.append([f"unknown, named ({n_unknown:,} instances)", "1.000", values["unknown_named_at_threshold"]])
    header = ["objects", "without rejection", f"threshold {values['threshold']}"]
    text = (
        f"Fractions of the instances for {main}. If the confidence is below the threshold, the object is rejected as "
        "unknown. The threshold is stored in the models; a dash means that they have none. Of several "
        "thresholds, such as those of enrolled objects, the median is shown."
    )
    pictures = []
    if curve is not None:
        statistics = report["confidence"][main]["unknown_named"]
        draw_known_unknown(curve, (COVERAGE, statistics["mean"]), main, out / "known-unknown.png")
        text += f" With a threshold that keeps {COVERAGE:.0%} of the correct answers, {_mean_std(statistics)} of the "
        text += "unknown objects get a name."
        caption = f"Unknown objects that {main} names, against the fraction of its correct answers above the threshold."
        pictures = [Picture("known-unknown.png", caption, "half")]
    return [Section("Unknown objects", text, (header, table), pictures)]


def _confidence_section(report: Mapping[str, Any], out: Path) -> Section:
    columns = {
        "calibration error": ("confidence", "expected_calibration_error"),
        "calibration error, calibrated": ("calibrated_confidence", "expected_calibration_error"),
        "AUROC correct/incorrect": ("confidence", "auroc_right"),
        f"accuracy at {COVERAGE:.0%} coverage": ("confidence", "accuracy_at_coverage"),
        "threshold": ("confidence", "threshold_at_coverage"),
        "AUROC known/unknown": ("confidence", "auroc_known"),
        "AUROC known/unknown, calibrated": ("calibrated_confidence", "auroc_known"),
        "unknown objects rejected": ("confidence", "unknown_refused"),
    }
    rows = [
        [title, *(_mean_std(report[table].get(title, {}).get(key, NO_VALUE)) for table, key in columns.values())]
        for title in report["confidence"]
    ]
    temperatures = [f"{name} {_mean_std(t)}" for name, t in report["temperatures"].items() if t["runs"]]
    text = (
        "Calibration error is the expected calibration error over 15 bins. Calibrated columns use temperatures of the "
        "classifiers, fitted on the held-out synthetic views of each training"
        + (f" ({', '.join(temperatures)})" if temperatures else "; these models have none")
        + ". AUROC is the probability that a correct answer has a higher confidence than an incorrect one, or a known "
        "object than an unknown one; known objects are the classes of the models. Open-set rejection: the "
        f"threshold accepts {COVERAGE:.0%} of the known objects, and instances below it are rejected as unknown. It "
        "is the value for the option --unknown-below of thor2 recognize. A dash means that there is no value, for "
        "instance because no answer is incorrect or the dataset has no unknown objects."
    )
    draw_reliability(report["reliability"], report["main"], out / "reliability.png")
    pictures = [Picture("reliability.png", f"Accuracy of {report['main']} by confidence.", "half")]
    return _main_row(Section("Confidence", text, (["", *columns], rows), pictures), report["main"])


def _frame_section(report: Mapping[str, Any]) -> Section:
    text = (
        "Answers of the first model. Green: correct, including rejected unknown objects. Orange: incorrect. The true "
        "object is in brackets. An instance that could not be described is called none."
    )
    shown = [Picture(f"frames/{k}.jpg", f"Frame {name}.", "half") for k, name in enumerate(report["shown"])]
    return Section("Frames", text, pictures=shown)


def _measurement_section(report: Mapping[str, Any]) -> Section:
    speed, counts = report["speed"], report["instances"]
    text = f"Models: {', '.join(report['runs'])}. "
    text += f"Speed: {speed['frames_per_second']:.2f} frames per second, from reading the files to the answers of all "
    text += f"models, compilation included; median {speed['median_seconds']:.2f} s per frame."
    published_speed = [f"{name} {seconds} s" for name, seconds in published_seconds().items()]
    text += f" Published times per frame: {', '.join(published_speed)}."
    rows = [
        [f"not described, counted as incorrect: {reason}", f"{n:,}"] for reason, n in counts["not_described"].items()
    ]
    rows += [[f"unknown object, not scored: {name}", f"{n:,}"] for name, n in counts["no_class"].items()]
    return Section("Measurement", text, (["", "instances"], rows) if rows else None)
