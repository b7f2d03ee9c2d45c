"""Figures of the network: complete, in the colours of the regions, and without leftover files."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import colornet
from colornet.draw import draw_network, draw_similarity

NETWORK = colornet.load_default()


@pytest.mark.parametrize("draw", [draw_network, draw_similarity])
def test_every_region_shows_its_mean_color(tmp_path: Path, draw: Callable[[colornet.ColorNetwork, Path], None]) -> None:
    draw(NETWORK, tmp_path / "picture.png")
    assert os.listdir(tmp_path) == ["picture.png"]
    picture = Image.open(tmp_path / "picture.png").convert("RGB")
    assert picture.width * picture.height >= 1000**2
    counts, shown = map(np.array, zip(*picture.getcolors(256**3), strict=True))
    for region, mean in enumerate(NETWORK.mean_rgb):
        near = counts[np.abs(shown - mean).max(axis=-1) <= 1]
        assert near.sum() > 100, f"region {region}"
