"""Fixtures shared by the tests of the command line."""

import dataclasses
from pathlib import Path

import pytest
import small_runs
from commands import Command, Recognize, json_lines

from training import protocol
from training.protocol import DEFAULT, PAPER

COVERING = dataclasses.replace(small_runs.SMALL_CONFIG, sigma_1=0.4, sigma_2=0.2)
"""A small descriptor whose grid covers the objects: if it overflowed, nothing would have a name."""


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run directory with random weights."""
    folder, classes = tmp_path_factory.mktemp("run"), ("bowl", "mug", "plate")
    return small_runs.save_untrained_run(folder, classes, ("tops", "tops2"), COVERING, seed=1)


@pytest.fixture
def recognize(model: Path, printed: Command) -> Recognize:
    """Return a function that recognizes frames with the model and returns what it prints, an object for each frame."""
    return lambda *options: json_lines(printed("recognize", "--model", model, *options))


@pytest.fixture(scope="module")
def small_descriptors(small_networks: None, module_patch: pytest.MonkeyPatch) -> None:
    """Let the protocols describe views by small descriptors, and fit one small network on few views."""
    networks = dataclasses.replace(DEFAULT.distractors, networks=1, views=2)
    module_patch.setattr(protocol, "DEFAULT", dataclasses.replace(DEFAULT, config=COVERING, distractors=networks))
    module_patch.setattr(protocol, "PAPER", dataclasses.replace(PAPER, config=COVERING))


@pytest.fixture(scope="module")
def small_embedding(module_patch: pytest.MonkeyPatch) -> None:
    """Replace the packaged embedding by a small one with random weights, which compiles quickly."""
    small = small_runs.small_embedding()
    for module in ("gallery.enrollment", "model.model", "networks.embedding"):
        module_patch.setattr(f"thor2_jax.{module}.load_default", lambda: small)
    module_patch.setattr("training.views.mesh_views.MESH_VIEWS", 1)
