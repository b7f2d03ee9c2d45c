"""Regions and similarity against colour matrices computed outside this project, on views of real scans."""

from pathlib import Path

import numpy as np

import colornet


def as_8_bit(colors: np.ndarray) -> np.ndarray:
    """Colours in [0, 1], float32, to the nearest of 256 levels, halves up."""
    return np.floor(colors * np.float32(255) + np.float32(0.5)).astype(np.uint8)


def golden_files(shared: Path) -> list[Path]:
    paths = sorted((shared / "golden").glob("*.npz"))
    assert len(paths) == 24
    return paths


def test_region_weights_strip_by_strip(shared: Path, network: colornet.ColorNetwork) -> None:
    strips = 0
    for path in golden_files(shared):
        with np.load(path) as golden:
            aligned, expected = golden["aligned"].astype(np.float64), golden["paper_color"]
            weights = network.membership(as_8_bit(golden["colors"]))
        i, j = np.floor(aligned[:, 2] / 0.1).astype(int), np.floor(aligned[:, 0] / 0.025).astype(int)
        found = np.zeros((7, 31, 22))
        np.add.at(found, (i, j), weights)
        np.testing.assert_allclose(found, expected, atol=1e-4, err_msg=path.name)
        strips += int((expected.sum(axis=-1) > 0).sum())
    assert strips == 644


def test_similarity(shared: Path, network: colornet.ColorNetwork) -> None:
    """The embeddings are colour matrix times Delta; float32 in the files."""
    for path in golden_files(shared):
        with np.load(path) as golden:
            color, embedding = golden["paper_color"].astype(np.float64), golden["paper_embedding"]
        np.testing.assert_allclose(color @ network.similarity, embedding, rtol=2e-7, err_msg=path.name)
