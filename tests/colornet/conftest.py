"""The packaged colour network."""

import pytest

import colornet


@pytest.fixture(scope="session")
def network() -> colornet.ColorNetwork:
    return colornet.load_default()
