"""Make tests/golden/networks/outputs.json: outputs of torch and timm for random weights that the tests draw, too.

    pip install torch torchvision timm && python tests/golden/make_networks.py

Run it in an environment of its own: the project does not need torch. `tests/training/baselines/test_image_networks.py`
compares the networks of `training.baselines` with these outputs. The weights come from `network_weights` by the names
of the PyTorch tensors, and everything is computed in float64.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import timm
import torch
from network_weights import random_images, random_tensor, sampled

OUT = Path(__file__).parent / "networks" / "outputs.json"

VITS: dict[str, tuple[str, dict[str, Any]]] = {
    "vit_tiny_4": ("vit_tiny_patch16_224", {"img_size": 96, "depth": 4}),
    "vit_tiny": ("vit_tiny_patch16_224", {"img_size": 224}),
    "vit_base": ("vit_base_patch16_224.mae", {"img_size": 224}),
    "vit_dinov2_small": ("vit_small_patch14_dinov2", {"img_size": 224}),
}
DENSENETS: dict[str, tuple[str, dict[str, Any], int]] = {
    "densenet_161": ("densenet161", {}, 64),
    "densenet_small": ("densenet121", {"growth_rate": 12, "block_config": (2, 4, 4, 2)}, 96),
}


def filled(model: torch.nn.Module) -> torch.nn.Module:
    """Return a model in float64 and evaluation mode with the random weights of its tensors' names."""
    state = {
        name: torch.from_numpy(random_tensor(name, tuple(value.shape))) if value.ndim else value
        for name, value in model.state_dict().items()
    }
    model.load_state_dict(state)
    return model.double().eval()


def images(name: str, count: int, size: int) -> torch.Tensor:
    """Return the inputs of `random_images` as PyTorch orders them."""
    return torch.from_numpy(random_images(name, count, size)).double().permute(0, 3, 1, 2)


def resnet_outputs() -> np.ndarray:
    """Return the sampled features of the four stages of timm's ResNet-18."""
    model: Any = filled(timm.create_model("resnet18"))
    x = model.maxpool(model.act1(model.bn1(model.conv1(images("resnet18", 2, 64)))))
    outputs = []
    for stage in (model.layer1, model.layer2, model.layer3, model.layer4):
        x = stage(x)
        outputs.append(sampled(x.permute(0, 2, 3, 1).numpy()))
    return np.concatenate(outputs)


def fusion_outputs() -> np.ndarray:
    """Return the sampled state of PyTorch's GRU for a sequence of four vectors of 10 values; memory 7."""
    model: Any = filled(torch.nn.GRU(10, 7, batch_first=True))
    sequence = torch.from_numpy(random_images("gru", 3, 10)[:, :4, :, 0]).double()
    return sampled(model(sequence)[1][0].numpy())


def resampled_outputs() -> np.ndarray:
    """Return the sampled positions of a ViT-Ti for 96 pixels, resampled by timm from those for 224."""
    positions = torch.from_numpy(random_tensor("pos_embed", (1, 197, 192)))
    return sampled(timm.layers.resample_abs_pos_embed(positions, [6, 6]).numpy())


def outputs() -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the sampled output of each case."""
    yield "resnet18", resnet_outputs()
    for name, (model, arguments, size) in DENSENETS.items():
        network: Any = filled(timm.create_model(model, **arguments))
        features = network.forward_features(images(name, 2, size))
        yield name, sampled(network.forward_head(features, pre_logits=True).numpy())
    for name, (model, arguments) in VITS.items():
        network = filled(timm.create_model(model, **arguments))
        yield name, sampled(network.forward_features(images(name, 2, arguments["img_size"]))[:, 0].numpy())
    yield "gru", fusion_outputs()
    yield "positions", resampled_outputs()


def main() -> None:
    """Write the outputs."""
    torch.set_grad_enabled(False)
    values = {name: [float(f"{value:.7g}") for value in output] for name, output in outputs()}
    OUT.parent.mkdir(exist_ok=True)
    versions = {"torch": torch.__version__.split("+")[0], "timm": timm.__version__}
    OUT.write_text(json.dumps({"versions": versions, "outputs": values}) + "\n")


if __name__ == "__main__":
    main()
