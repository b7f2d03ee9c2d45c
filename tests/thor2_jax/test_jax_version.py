"""Rejected versions of jax."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize("package", ["jax", "jaxlib"])
def test_import_rejects_the_version_with_wrong_rotations(package: str) -> None:
    program = (
        "import importlib.metadata as m; real = m.version; "
        f"m.version = lambda name: '0.10.2' if name == '{package}' else real(name); import thor2_jax"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode != 0
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: {package} 0.10.2 ") and "issues/39103" in last and "constraints.txt" in last
