"""From rendered views to a run folder: dataset, one classifier a feature, record."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import colornet
from thor2_jax.classifier import MLP, Feature, check_features
from thor2_jax.config import DescriptorConfig
from thor2_jax.run_folder import TrainedRun, check_new, save_run
from training.dataset import build_dataset
from training.fit import EpochFigures, FitOptions, fit
from training.views import Cloud

__all__ = ["Progress", "train_run"]

Progress = Callable[[str, int, int, str], object]
"""Called with (stage, done, total, note)."""


def train_run(
    views: Mapping[str, Sequence[Cloud]],
    out: str | Path,
    features: Sequence[str],
    options: FitOptions,
    progress: Progress = lambda stage, done, total, note: None,
    config: DescriptorConfig | None = None,
) -> TrainedRun:
    """Train one classifier a feature on rendered views and write the run folder.

    Args:
        views: class name -> clouds in metres, camera frame.
        out: the run folder; must not exist, or be empty.
        features: any of "ce", "tops", "tops2".
        options: of the fit; the same for every classifier.
        progress: told of each step.
        config: the descriptor; by default the paper's, with diagrams in closed form.

    Raises:
        InputError: unknown features, `out` exists (both told before any work), classes without views, a loss that is
            not finite. Nothing is written then.
    """
    names = check_features(features, "classifiers")
    check_new(out)
    config = config or DescriptorConfig(homology="closed_form")
    network = colornet.load_default()
    total, done = sum(len(clouds) for clouds in views.values()), 0

    def described(count: int) -> None:
        nonlocal done
        done += count
        progress("describe", done, total, "views")

    dataset = build_dataset(views, network, config, progress=described)
    classifiers: dict[Feature, MLP] = {}
    curves: dict[str, list[dict[str, Any]]] = {}
    for name in names:
        curve = curves.setdefault(name, [])

        def report(figures: EpochFigures, name: str = name, curve: list[dict[str, Any]] = curve) -> None:
            curve.append({"epoch": figures.epoch, "loss": figures.loss, "accuracy": figures.accuracy})
            note = f"loss {figures.loss:.3f}, accuracy {figures.accuracy:.3f}"
            progress(f"fit {name}", figures.epoch, options.epochs, note)

        classifiers[name] = fit(dataset, network, config, name, options, report)
    record = {
        "views": {name: len(clouds) for name, clouds in views.items()},
        "samples": len(dataset),
        "epochs": options.epochs,
        "learning_rates": list(options.learning_rates),
        "batch_size": options.batch_size,
        "seed": options.seed,
        "curves": curves,
    }
    run = TrainedRun(config, network, dataset.classes, classifiers, record)
    save_run(run, out)
    return run
