"""Loading the baselines of a run directory: RUN/baselines/{thor,forest,pointnet}.safetensors."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from thor2_jax.errors import InputError
from thor2_jax.recognition.run_directory import TrainedRun
from training.baselines.baseline import Baseline
from training.baselines.files import baseline_file, read_baseline
from training.baselines.forest import Forest
from training.baselines.pointnet import ColoredPointNet
from training.baselines.thor import THOR

__all__ = ["load_baselines"]

_BUILD: dict[str, Callable[[Mapping[str, Any], TrainedRun], Baseline]] = {
    "thor": lambda arrays, run: THOR.with_arrays(arrays, run.config, len(run.classes)),
    "forest": lambda arrays, run: Forest(arrays, run.network, run.config),
    "pointnet": lambda arrays, run: ColoredPointNet.with_arrays(arrays, len(run.classes)),
}


def load_baselines(path: Path, run: TrainedRun) -> tuple[dict[str, Baseline], dict[str, float]]:
    """Return the baselines of a run directory, and the temperatures of those that were calibrated.

    Raises:
        InputError: a file is damaged or does not match the run.
    """
    models: dict[str, Baseline] = {}
    temperatures: dict[str, float] = {}
    for name, build in _BUILD.items():
        file = baseline_file(path, name)
        if not file.is_file():
            continue
        stored = read_baseline(file, run.classes)
        try:
            models[name] = build(stored.arrays, run)
        except ValueError as error:
            raise InputError(
                f"model: {file} does not match its run ({error}); delete it and train the baseline again"
            ) from None
        if stored.temperature is not None:
            temperatures[name] = stored.temperature
    return models, temperatures
