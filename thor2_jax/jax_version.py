"""The versions of jax that this package supports; importing this module rejects all others."""

import re
from importlib.metadata import version

__all__ = ["check_jax_version"]

REJECTED_VERSIONS = {
    "0.10.2": "it computes rotations of more than 32,768 points wrongly on CPU (https://github.com/jax-ml/jax/issues/39103)"
}
"""Rejected version -> reason."""

NEWEST_TESTED_SERIES = (0, 10)
"""Major and minor version of the newest release series that the tests have run on."""


def check_jax_version(package: str, installed: str) -> None:
    """Reject unsupported versions of jax or jaxlib. Installers read the same rule from pyproject.toml.

    Raises:
        ImportError: the version is not supported; the message has the reason and what to install.
    """
    advice = "install the versions in constraints.txt, or another 0.10"
    if installed in REJECTED_VERSIONS:
        raise ImportError(f"{package} {installed} is not supported: {REJECTED_VERSIONS[installed]}; {advice}")
    series = tuple(int(part) for part in re.findall(r"\d+", installed)[:2])
    if series > NEWEST_TESTED_SERIES:
        newest = ".".join(map(str, NEWEST_TESTED_SERIES))
        raise ImportError(f"{package} {installed} is not supported: the newest tested series is {newest}; {advice}")


for package in ("jax", "jaxlib"):
    check_jax_version(package, version(package))
