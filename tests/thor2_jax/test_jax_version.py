"""Rejected versions of jax."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("package", "version"), [("jax", "0.10.2"), ("jaxlib", "0.10.2"), ("jax", "0.11.0"), ("jaxlib", "1.0.0rc1")]
)
def test_import_rejects_versions_that_are_wrong_or_untested(package: str, version: str) -> None:
    program = (
        "import importlib.metadata as m; real = m.version; "
        f"m.version = lambda name: '{version}' if name == '{package}' else real(name); import thor2_jax"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: {package} {version} ")
    assert "issues/39103" in last and "constraints.txt" in last
