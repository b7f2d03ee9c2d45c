"""Fixtures shared by all tests."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real scans, frames and golden files beside the checkout; skips where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("no shared/ folder with real scans beside the checkout")
    return SHARED
