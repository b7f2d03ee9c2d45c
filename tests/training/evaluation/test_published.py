"""The published tables, and reports that show them beside measured accuracies."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from toy_recognizers import ToyRun

from training.evaluation.page import comparison, marked
from training.evaluation.published import compare_with_published, published_seconds, published_tables

OWN: tuple[Any, Any] = [ToyRun("run", own_objects=True)] * 2, 10


def thor2_tables() -> list[dict[str, Any]]:
    tables = [table for kind in ("uwis", "ocid") for table in published_tables(kind) if "2408.01579" in table["source"]]
    return sorted(tables, key=lambda table: table["number"] or 0)


def test_every_figure_equals_the_transcription(shared: Path) -> None:
    """The transcription of all tables of the paper beside the checkout has the same tables, rows and figures."""
    source = json.loads((shared / "published" / "thor2_tables.json").read_text())
    tables = thor2_tables()
    assert [table["number"] for table in tables] == list(range(1, len(source["tables"]) + 1))
    for table, (name, cells) in zip(tables, source["tables"].items(), strict=True):
        ours = [(cell["where"], cell["accuracy"]) for cell in table["cells"]]
        assert ours == [(cell["where"], cell["accuracy"]) for cell in cells], name
        assert table["title"].startswith("OCID" if name.startswith("ocid") else "UW-IS Occluded")


def test_published_figures_are_complete() -> None:
    figures = [figure for table in thor2_tables() for cell in table["cells"] for figure in cell["accuracy"].values()]
    assert len(figures) == 5 * (75 + 17) + 7 * 7 + 5 * 6 + 4 * 7
    assert all(0 <= mean <= 100 and std is not None and 0 <= std < 10 for mean, std in figures)
    assert all(seconds > 0 for seconds in published_seconds().values())
    # UW-IS Occluded has 20 objects, of which the paper does not score three.
    assert {table["objects"] for table in published_tables("uwis")} == {20 - 3}


def test_measured_values_stand_beside_the_published_ones() -> None:
    """Four instances in two sequences, two runs: means and deviations by hand.

    Rows and tables without instances, as that of the upper camera, are left out.
    """
    where = {"camera": "lower", "place": "table", "type": "curved", "sequence": "table/bottom/curved/seq25"}
    other = {**where, "place": "floor", "type": "mixed", "sequence": "floor/bottom/mixed/seq08"}
    marks = [np.array([1, 1, 0, 0], bool), np.array([1, 0, 0, 1], bool)]
    correct = {"THOR2": marks, "PointNet": marks}
    own = compare_with_published("ocid", *OWN, [where, where, where, other], ["a", "b", "a", "c"], correct)
    assert [table["number"] for table in own] == [1, 8, None]
    cells = {cell["where"].get("sequence"): cell for cell in own[0]["cells"]}
    assert list(cells) == ["S-25", "S-08", None]
    assert [cell["instances"] for cell in cells.values()] == [3, 1, 4]
    assert cells["S-25"]["accuracy"]["THOR2"] == {
        "mean": pytest.approx(1 / 2), "std": pytest.approx(np.std([2 / 3, 1 / 3], ddof=1)), "runs": 2,
    }  # fmt: skip
    assert cells["S-08"]["published"]["THOR"] == {"mean": pytest.approx(0.4343), "std": pytest.approx(0.013)}
    assert own[0]["ours"] == {"THOR2": "THOR2"} and own[1]["ours"] == {"THOR2, synthetic": "THOR2"}
    parts = "OCID", "5 models", "frames 10, objects 3, models 2", "log-mean; 3 of", "25 rows"
    assert all(part in " ".join(own[0]["differences"]) for part in parts) and "max" in own[0]["source"]

    (table,) = compare_with_published("ocid", [ToyRun("run")], 10, [where] * 4, ["a"] * 4, correct)
    assert table["number"] == 3
    assert "26 objects" in " ".join(table["differences"])
    assert all(compare_with_published(kind, *OWN, [where] * 4, ["a"] * 4, correct) == [] for kind in ("frames", "bop"))


def test_comparison_table_pairs_columns_and_prints_percent() -> None:
    attributes = {"environment": "lounge", "light": "2"}
    correct = {"THOR2": [np.ones(8, bool), np.arange(8) < 7], "THOR": [np.zeros(8, bool)] * 2}
    tables = compare_with_published("uwis", *OWN, [attributes] * 8, ["a"] * 8, correct)
    (light,) = (table for table in tables if table["number"] == 6)
    title, text, table = comparison(light, "THOR2")
    assert title.startswith("Published table 6: ") and "assumed" in text
    header, (row,) = marked(table, "THOR2")
    assert row[:2] == ["lounge, dim", "8"] and len(header) == 9
    assert list(zip(header, row, strict=True))[5:] == [
        ("THOR", "0.00 ±\u00a00.00"), ("THOR, published", "57.64 ±\u00a00.39"),
        ("THOR2 (thor2 recognize)", "93.75 ±\u00a08.84"), ("THOR2, published", "63.95 ±\u00a00.51"),
    ]  # fmt: skip
    header, (row,) = comparison(light, "gallery")[2]
    assert header[2] == "gallery" and row[2] == "–"


def test_networks_stand_beside_their_published_figures() -> None:
    """Small ones too, trained without or with real views, and what was trained from scratch is said."""
    marks = [np.array([True, False])]
    attributes = [{"environment": "lounge", "occlusion": "high", "light": "1", "category": "food"}] * 2

    def ours(number: int, real: bool, titles: list[str]) -> tuple[dict[str, str], str]:
        scratch = {"rcfusion-small": SimpleNamespace(weights={})}
        run = ToyRun("run", has_real_views=real, baselines=scratch)
        tables = compare_with_published("uwis", [run], 1, attributes, ["a", "b"], dict.fromkeys(titles, marks))
        (table,) = [table for table in tables if table["number"] == number]
        return table["ours"], " ".join(table["differences"])

    titles = ["THOR2", "RCFusion-small", "ViT-CNN", "ViT-CNN-small"]
    columns, text = ours(4, False, titles)
    assert columns == {"THOR2": "THOR2", "RCFusion": "RCFusion-small", "ViT-CNN": "ViT-CNN"}
    assert text.count("RCFusion-small") == 2 and "scratch" in text and "ViT-CNN" not in text
    assert ours(9, False, titles)[0] == {"THOR2, synthetic": "THOR2"}
    assert ours(9, True, titles)[0] == {"RCFusion, +100 % YCB": "RCFusion-small", "ViT-CNN, +100 % YCB": "ViT-CNN"}
