"""Figures of the network: complete, in the colours of the regions, and without leftover files."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import colornet
from colornet.draw import draw_network, draw_similarity

DRAW = [draw_network, draw_similarity]


@pytest.mark.parametrize("draw", DRAW)
def test_every_region_shows_its_mean_color(
    network: colornet.ColorNetwork, tmp_path: Path, draw: Callable[[colornet.ColorNetwork, Path], None]
) -> None:
    path = tmp_path / "picture.png"
    draw(network, path)
    assert os.listdir(tmp_path) == ["picture.png"]
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert min(pixels.shape[:2]) >= 1000
    shown, counts = np.unique(pixels @ [2**16, 2**8, 1], return_counts=True)
    colors = shown[:, None] // [2**16, 2**8, 1] % 2**8
    for r, mean in enumerate(network.mean_rgb):
        near = counts[np.abs(colors - mean).max(axis=-1) <= 1]
        assert near.sum() > 100, f"region {r}"


@pytest.mark.parametrize("draw", DRAW)
def test_a_missing_directory_is_an_error(
    network: colornet.ColorNetwork, tmp_path: Path, draw: Callable[[colornet.ColorNetwork, Path], None]
) -> None:
    with pytest.raises(OSError):
        draw(network, tmp_path / "nowhere" / "picture.png")
