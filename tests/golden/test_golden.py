"""Each stage of the descriptor against outputs of an independent implementation.

Views of built-in objects, from `make_golden.py`, and views of real scans where the folder `shared` is present.
"""

import functools
from pathlib import Path

import numpy as np
import pytest

import colornet
import thor2_jax as thor2

TOLERANCE = 1e-6
"""Absolute for images, diagrams and colour matrices, relative for embeddings (float32 sums)."""


@functools.cache
def load(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as file:
        return dict(file)


@pytest.mark.parametrize("homology", ["gudhi", "closed_form"])
@pytest.mark.parametrize("convention", ["paper", "released"])
def test_each_stage_of_both_conventions(golden_files: tuple[Path, ...], convention: str, homology: str) -> None:
    """All views are one batch, and begin with the reference's alignment."""
    configs = {"paper": thor2.DescriptorConfig, "released": thor2.DescriptorConfig.released}
    config, network = configs[convention](homology=homology), colornet.load_default()
    clouds = thor2.PointClouds.pack([(load(path)["aligned"], load(path)["colors"]) for path in golden_files])
    descriptors, strips = thor2.describe_aligned(clouds, network, config), thor2.strips(clouds, network, config)
    diagrams = thor2.diagrams(clouds, config)
    births, deaths, mask = (np.asarray(values) for values in (diagrams.births, diagrams.deaths, diagrams.mask))
    assert not np.asarray(descriptors.overflow).any()
    assert not births[~mask].any() and not deaths[~mask].any()
    for row, path in enumerate(golden_files):
        golden, close = load(path), functools.partial(np.testing.assert_allclose, err_msg=path.name, atol=TOLERANCE)
        close(descriptors.images[row], golden[f"{convention}_images"])
        close(strips.color[row], golden[f"{convention}_color"])
        if convention == "paper":
            close(descriptors.embeddings[row], golden["paper_embedding"].transpose(0, 2, 1), rtol=TOLERANCE)
        else:
            pairs = [np.nonzero(mask[row])[0], births[row][mask[row]], deaths[row][mask[row]]]
            close(np.stack(pairs, axis=1), golden["released_diagrams"])


@pytest.mark.slow
def test_the_script_reproduces_the_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parent)
    import make_golden

    objects = make_golden.builtin_objects()
    for name, angles in make_golden.VIEWS.items():
        made, kept = make_golden.golden(objects[name], *angles), load(make_golden.FOLDER / f"{name}.npz")
        assert set(made) == set(kept)
        for key, array in made.items():
            np.testing.assert_allclose(array, kept[key], 1e-6, 1e-6, err_msg=f"{name} {key}", strict=True)
