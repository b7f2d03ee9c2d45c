"""Names of the baselines."""

from collections.abc import Sequence

from thor2_jax.errors import InputError

__all__ = ["BASELINES", "TITLES", "check_baselines"]

BASELINES = ("thor", "forest", "pointnet")
"""Names on the command line and in run directories, in the order of training."""

TITLES = {"forest": "forest", "pointnet": "PointNet", "thor": "THOR"}
"""Column titles of the baselines, in the order of the columns."""


def check_baselines(names: Sequence[str]) -> tuple[str, ...]:
    """Return `names` in the order of BASELINES.

    Raises:
        InputError: a name is unknown or given twice.
    """
    if not set(names) <= set(BASELINES) or len(set(names)) != len(names):
        raise InputError(
            f"baselines is {', '.join(names)}; expected any of {', '.join(BASELINES)}; give each at most once"
        )
    return tuple(name for name in BASELINES if name in names)
