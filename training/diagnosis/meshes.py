"""Check of the unit of meshes."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from thor2_jax.errors import InputError
from training.diagnosis.findings import Diagnosis
from training.objects.meshes import MAX_SIDE, MIN_SIDE, longest_side

__all__ = ["check_meshes"]

USUAL_SIDE = (0.03, 0.6)
"""Range of the median longest side of objects on a table, metres."""

SCALES = {0.001: "millimetres", 0.01: "centimetres", 0.0254: "inches", 1000.0: "kilometres"}


def check_meshes(diagnosis: Diagnosis, meshes: Mapping[str, Path], scale: float = 1.0) -> dict[str, float]:
    """Check the unit of mesh files; return object -> longest side in metres, or nothing if the unit is likely wrong.

    Args:
        diagnosis: receives the findings.
        meshes: object -> mesh file.
        scale: factor that converts their unit to metres.
    """
    sides = {}
    for name, path in meshes.items():
        try:
            sides[name] = longest_side(path) * scale
        except InputError as error:
            diagnosis.add("mesh", f"A mesh cannot be used: {error}.", "Repair it, or leave it out.")
    if not sides:
        return {}
    values = list(sides.values())
    median = float(np.median(values))
    if MIN_SIDE <= min(values) and max(values) <= MAX_SIDE and median >= USUAL_SIDE[0] / 3:
        return sides
    fitting = [each for each in SCALES if USUAL_SIDE[0] <= median * each <= USUAL_SIDE[1]]
    unit = f"it is likely in {SCALES[fitting[0]]}" if fitting else "its unit is unknown"
    mend = f"--mesh-scale {fitting[0] * scale:g} mends it" if fitting else "--mesh-scale sets the factor"
    diagnosis.add(
        "mesh-unit",
        f"The longest side of the mesh{'es' if len(sides) > 1 else ''} is {median:.4g}"
        f"{' (median)' if len(sides) > 1 else ''}; in metres, objects on a table have {USUAL_SIDE[0]:g} to "
        f"{USUAL_SIDE[1]:g}: {unit}.",
        f"Meshes are read in metres; {mend}.",
    )
    return {}
