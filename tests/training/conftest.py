"""Fixtures shared by the tests of training."""

from collections.abc import Iterator

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

import colornet
from thor2_jax import figures
from thor2_jax.descriptor.color_membership import region_sets
from training.fitting.samples import Samples

SAVEFIG = Figure.savefig


@pytest.fixture(scope="module", autouse=True)
def blank_pictures() -> Iterator[None]:
    """Let the pictures of figures be blank: many commands draw some, which takes a fifth of the time of a training."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda _, file, **options: Image.new("RGB", (400, 300)).save(file, "PNG"))
        yield


@pytest.fixture
def drawn_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let figures be drawn, with a fifth of their pixels."""
    monkeypatch.setattr(Figure, "savefig", SAVEFIG)
    monkeypatch.setattr(figures, "_DPI", 60)


@pytest.fixture
def separable() -> Samples:
    """Return 48 samples of 2 x 5 strips; the classes differ in the length or the colour of the strips."""
    n, strips = 48, 10
    rng = np.random.default_rng(0)
    label = np.arange(n, dtype=np.int32) % 3
    length = np.where(label == 0, 0.05, 0.2)[:, None] + rng.random((n, strips)) * 0.01
    weights = np.asarray(region_sets(colornet.load_default()).weights)
    only_8, only_3 = (int(np.flatnonzero(weights[:, region] == 1)[0]) for region in (8, 3))
    color_set = np.repeat(np.where(label == 2, only_3, only_8), strips)
    every = np.tile(np.arange(strips, dtype=np.uint16), n)
    return Samples(
        strip_start=np.arange(n + 1) * strips,
        color_start=np.arange(n + 1) * strips,
        strip=every,
        length=length.reshape(-1).astype(np.float32),
        color_strip=every,
        color_set=color_set.astype(np.uint16),
        color_count=rng.integers(8, 12, n * strips).astype(np.float32),
        label=label,
        view=np.arange(n, dtype=np.int32),
        classes=("a", "b", "c"),
    )
