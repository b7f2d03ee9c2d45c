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


@functools.cache
def described(
    paths: tuple[Path, ...], config: thor2.DescriptorConfig
) -> tuple[thor2.Descriptors, thor2.Strips, thor2.Diagrams]:
    """Descriptors of all views in one batch, from the reference's alignment."""
    aligned = thor2.PointClouds.pack([(load(path)["aligned"], load(path)["colors"]) for path in paths])
    network = colornet.load_default()
    return (
        thor2.describe_aligned(aligned, network, config),
        thor2.strips(aligned, network, config),
        thor2.diagrams(aligned, config),
    )


@pytest.mark.parametrize("homology", ["gudhi", "closed_form"])
def test_paper_convention(golden_files: tuple[Path, ...], homology: str) -> None:
    descriptors, strips, diagrams = described(golden_files, thor2.DescriptorConfig(homology=homology))
    assert not np.asarray(descriptors.overflow).any()
    for values in (diagrams.births, diagrams.deaths):
        assert not np.asarray(values)[~np.asarray(diagrams.mask)].any()
    for row, path in enumerate(golden_files):
        golden, close = load(path), functools.partial(np.testing.assert_allclose, err_msg=path.name, atol=TOLERANCE)
        close(descriptors.images[row], golden["paper_images"])
        close(descriptors.embeddings[row], golden["paper_embedding"].transpose(0, 2, 1), rtol=TOLERANCE)
        close(strips.color[row], golden["paper_color"])


@pytest.mark.parametrize("homology", ["gudhi", "closed_form"])
def test_released_convention(golden_files: tuple[Path, ...], homology: str) -> None:
    descriptors, strips, diagrams = described(golden_files, thor2.DescriptorConfig.released(homology=homology))
    assert not np.asarray(descriptors.overflow).any()
    for row, path in enumerate(golden_files):
        golden, close = load(path), functools.partial(np.testing.assert_allclose, err_msg=path.name, atol=TOLERANCE)
        close(descriptors.images[row], golden["released_images"])
        close(strips.color[row], golden["released_color"])
        births, deaths, mask = (np.asarray(a[row]) for a in (diagrams.births, diagrams.deaths, diagrams.mask))
        pairs = np.stack([np.nonzero(mask)[0], births[mask], deaths[mask]], axis=1)
        close(pairs, golden["released_diagrams"])
        assert not births[~mask].any() and not deaths[~mask].any()


@pytest.mark.slow
def test_the_script_reproduces_the_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parent)
    import make_golden

    objects = make_golden.builtin_objects()
    for name, angles in make_golden.VIEWS.items():
        made, kept = make_golden.golden(objects[name], *angles), load(make_golden.FOLDER / f"{name}.npz")
        assert set(made) == set(kept)
        for key, array in made.items():
            assert array.dtype == kept[key].dtype
            np.testing.assert_allclose(array, kept[key], rtol=1e-6, atol=1e-6, err_msg=f"{name} {key}")
