"""Regions and similarity against colour matrices of the golden files."""

from pathlib import Path

import numpy as np
from helpers import as_8_bit

import colornet


def test_region_weights_strip_by_strip(golden_files: tuple[Path, ...], network: colornet.ColorNetwork) -> None:
    for path in golden_files:
        with np.load(path) as golden:
            aligned, expected = golden["aligned"].astype(np.float64), golden["paper_color"]
            weights = network.membership(as_8_bit(golden["colors"]))
        i, j = np.floor(aligned[:, 2] / 0.1).astype(int), np.floor(aligned[:, 0] / 0.025).astype(int)
        color = np.zeros((7, 31, 22))
        np.add.at(color, (i, j), weights)
        np.testing.assert_allclose(color, expected, atol=1e-4, err_msg=path.name)
        assert expected.sum(axis=-1).any()


def test_similarity(golden_files: tuple[Path, ...], network: colornet.ColorNetwork) -> None:
    """Embeddings are the product of colour matrix and Delta, float32 in the files."""
    for path in golden_files:
        with np.load(path) as golden:
            color, embedding = golden["paper_color"].astype(np.float64), golden["paper_embedding"]
        np.testing.assert_allclose(color @ network.similarity, embedding, rtol=2e-7, err_msg=path.name)
