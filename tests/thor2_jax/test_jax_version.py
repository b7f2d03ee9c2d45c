"""Supported and rejected versions of jax."""

import subprocess
import sys

import pytest

from thor2_jax.jax_version import check_jax_version


@pytest.mark.parametrize("version", ["0.10.0", "0.10.1", "0.10.3", "0.9.2", "0.10.1.dev20260101+abc"])
def test_supported_versions(version: str) -> None:
    check_jax_version("jax", version)


@pytest.mark.parametrize(("version", "reason"), [("0.10.2", "issues/39103"), ("0.11.0", "0.10"), ("1.0.0rc1", "0.10")])
def test_rejected_versions_have_a_reason(version: str, reason: str) -> None:
    with pytest.raises(ImportError, match=f"^jaxlib {version} .*{reason}.*constraints.txt"):
        check_jax_version("jaxlib", version)


@pytest.mark.parametrize("package", ["jax", "jaxlib"])
def test_import_rejects_them(package: str) -> None:
    program = (
        "import importlib.metadata as m; real = m.version; "
        f"m.version = lambda name: '0.10.2' if name == '{package}' else real(name); import thor2_jax"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode != 0
    assert done.stderr.splitlines()[-1].startswith(f"ImportError: {package} 0.10.2 ")
