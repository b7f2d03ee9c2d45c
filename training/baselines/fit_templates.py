"""Collecting the templates: the features of all training crops."""

import numpy as np

from thor2_jax.errors import InputError
from thor2_jax.files import file_digest
from training.baselines.files import baseline_file, read_baseline
from training.baselines.fit_network import read_samples
from training.baselines.image_network import ImageNetwork
from training.baselines.networks.vit import ViT
from training.baselines.networks.weights import load_backbone
from training.baselines.pretrained import weights_file
from training.baselines.task import FitTask, FittedBaseline
from training.baselines.templates import BACKBONES, DINOV2, Templates, backbone_size, create_backbone

__all__ = ["fit_templates"]


def _backbone(task: FitTask) -> tuple[int, ViT, dict[str, str]]:
    """Return the number of the backbone, the backbone, and the digests of its files of weights.

    Raises:
        InputError: there is no backbone, or its file cannot be used.
    """
    if task.weights is not None:
        path = weights_file(task.weights, DINOV2)
        model = create_backbone(DINOV2)
        load_backbone(model, path)
        return BACKBONES.index(DINOV2), model, {path.name: file_digest(path)}
    for number, name in enumerate(BACKBONES):
        file = baseline_file(task.run, name)
        if file.is_file():
            stored = read_baseline(file, task.source.classes)
            network = ImageNetwork.with_arrays(name, stored.arrays, len(task.source.classes))
            return number, network.model.color, dict(stored.weights)  # type: ignore[attr-defined]
    raise InputError(
        f"baselines: templates needs a backbone; expected --weights with {DINOV2}.safetensors, or the "
        "baseline rgbd-vit or rgbd-vit-small in the same run"
    )


def fit_templates(task: FitTask) -> FittedBaseline:
    """Store the features of all crops that are not held out.

    Raises:
        InputError: there is no backbone, or the source has no crops.
    """
    number, model, weights = _backbone(task)
    n_classes = len(task.source.classes)
    samples = read_samples(task, "templates", backbone_size(BACKBONES[number]))
    held_out = task.held_out(samples.label, samples.view)
    features = Templates(number, model, np.zeros((0, 0), np.float16), np.zeros(0, np.int16), n_classes).embed(
        samples.crops
    )
    task.progress("collect templates", 1, 1, f"{len(features)} crops")
    stored = features[~held_out].astype(np.float16)
    templates = Templates(number, model, stored, samples.label[~held_out].astype(np.int16), n_classes)
    probabilities = templates.compare(features[held_out]) if held_out.any() else np.zeros((0, n_classes), np.float32)
    return FittedBaseline(templates, probabilities, samples.label[held_out], weights)
