"""The report of `benchmarks.paper` as Markdown and as a picture."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from thor2_jax.files import atomic_write
from thor2_jax.model.fusion import DEFAULT_RULE
from training.baselines.job import TITLES
from training.evaluation.page import accuracy_table, comparison

__all__ = ["draw_claims", "markdown_table", "report_text"]

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
