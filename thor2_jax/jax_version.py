"""Which versions of jax this package runs on; others are refused when this module is imported, before anything else."""

import re
from importlib.metadata import version

__all__ = ["check_jax_version"]

WRONG_NUMBERS = {
    "0.10.2": "it computes rotations of more than 32,768 points wrongly on CPU (https://github.com/jax-ml/jax/issues/39103)"
}
"""Version -> what is wrong with it."""

NEWEST_SERIES = (0, 10)
"""Major and minor version of the newest series that the tests have run on."""


def check_jax_version(package: str, found: str) -> None:
    """Refuse a version of jax or jaxlib; the same rule stands in pyproject.toml, for installers.

    Raises:
        ImportError: with the package, the version, the reason and what to install.
    """
    advice = "install the set of packages in constraints.txt, or another 0.10"
    if found in WRONG_NUMBERS:
        raise ImportError(f"{package} {found} is refused: {WRONG_NUMBERS[found]}; {advice}")
    series = tuple(int(part) for part in re.findall(r"\d+", found)[:2])
    if series > NEWEST_SERIES:
        newest = ".".join(map(str, NEWEST_SERIES))
        raise ImportError(f"{package} {found} is refused: it is newer than {newest}, the last one tested; {advice}")


for package in ("jax", "jaxlib"):
    check_jax_version(package, version(package))
