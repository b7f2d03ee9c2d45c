"""Fixtures shared by the tests of the command line."""

from pathlib import Path

import pytest
from helpers import untrained_run

from thor2_jax.config import DescriptorConfig
from thor2_jax.model.run_directory import save_run


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run directory with random weights."""
    directory = tmp_path_factory.mktemp("run")
    config = DescriptorConfig(homology="closed_form")  # a small grid would overflow, so that nothing has a name
    save_run(untrained_run(("bowl", "mug", "plate"), config=config), directory)
    return directory
