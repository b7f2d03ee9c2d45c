"""Loading the baselines of a run directory, RUN/baselines/NAME.safetensors."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from thor2_jax.errors import InputError
from thor2_jax.model.run_directory import TrainedRun
from training.baselines.baseline import Baseline
from training.baselines.files import baseline_file, read_baseline
from training.baselines.forest import Forest
from training.baselines.image_network import ImageNetwork
from training.baselines.names import NETWORKS
from training.baselines.pointnet import ColoredPointNet
from training.baselines.templates import Templates
from training.baselines.thor import THOR

__all__ = ["LoadedBaselines", "load_baselines"]


class LoadedBaselines(NamedTuple):
    """The baselines of a run directory.

    Attributes:
        models: name -> baseline.
        temperatures: temperatures of those that were calibrated.
        seconds: training times.
        weights: the files of pretrained weights that each was fitted from; empty if it was trained from scratch.
    """

    models: dict[str, Baseline]
    temperatures: dict[str, float]
    seconds: dict[str, float]
    weights: dict[str, list[str]]


def _network(name: str, arrays: Mapping[str, Any], run: TrainedRun) -> Baseline:
    return ImageNetwork.with_arrays(name, arrays, len(run.classes))


_BUILD: dict[str, Callable[[Mapping[str, Any], TrainedRun], Baseline]] = {
    "thor": lambda arrays, run: THOR.with_arrays(arrays, run.config, len(run.classes)),
    "forest": lambda arrays, run: Forest(arrays, run.network, run.config),
    "pointnet": lambda arrays, run: ColoredPointNet.with_arrays(arrays, len(run.classes)),
    **{name: partial(_network, name) for name in NETWORKS},
    "templates": lambda arrays, run: Templates.with_arrays(arrays, len(run.classes)),
}


def load_baselines(path: Path, run: TrainedRun) -> LoadedBaselines:
    """Return the baselines of a run directory.

    Raises:
        InputError: a file is damaged or does not match the run.
    """
    loaded = LoadedBaselines({}, {}, {}, {})
    for name, build in _BUILD.items():
        file = baseline_file(path, name)
        if not file.is_file():
            continue
        stored = read_baseline(file, run.classes)
        try:
            loaded.models[name] = build(stored.arrays, run)
        except ValueError as error:
            raise InputError(
                f"model: {file} does not match its run ({error}); delete it and train the baseline again"
            ) from None
        if stored.temperature is not None:
            loaded.temperatures[name] = stored.temperature
        loaded.seconds[name], loaded.weights[name] = stored.seconds, sorted(stored.weights)
    return loaded
