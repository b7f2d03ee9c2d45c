"""The backbones against outputs of torch and timm for the same random weights (tests/golden/make_networks.py)."""

import json
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from safetensors.numpy import save_file

from training.baselines import image_networks as networks
from training.baselines.image_baselines import load_backbone, resampled_positions, tensors
from training.baselines.image_networks import DENSENET_161, VIT_DINOV2_SMALL, VIT_TINY, VIT_TINY_4, DenseNet, ViT

GOLDEN = Path(__file__).parents[2] / "golden"
sys.path.append(str(GOLDEN))
from network_weights import random_images, random_tensor, sampled  # noqa: E402


@pytest.fixture(scope="module", autouse=True)
def _float32_products() -> Iterator[None]:
    """Recent GPUs would compute them in TF32."""
    with jax.default_matmul_precision("highest"):
        yield


OUTPUTS = json.loads((GOLDEN / "networks" / "outputs.json").read_text())["outputs"]


def assert_golden(name: str, outputs: list[Any]) -> None:
    expected = np.array(OUTPUTS[name])
    actual = np.concatenate([sampled(np.asarray(values)) for values in outputs])
    np.testing.assert_allclose(actual, expected, rtol=2e-3, atol=2e-4 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("name", "create", "size"),
    [
        ("resnet18", networks.ResNet18, 64),
        ("densenet_small", partial(DenseNet, 12, (2, 4, 4, 2)), 96),
        ("vit_tiny_4", partial(ViT, VIT_TINY_4, 96), 96),
        pytest.param("densenet_161", partial(DenseNet, **DENSENET_161), 64, marks=pytest.mark.slow),
        pytest.param("vit_tiny", partial(ViT, VIT_TINY, 224), 224, marks=pytest.mark.slow),
        pytest.param("vit_dinov2_small", partial(ViT, VIT_DINOV2_SMALL, 224), 224, marks=pytest.mark.slow),
        pytest.param("vit_base", partial(ViT, networks.VIT_BASE, 224), 224, marks=pytest.mark.slow),
    ],
)
def test_backbones_match_timm(tmp_path: Path, name: str, create: Any, size: int) -> None:
    """They have the random weights of their tensors' names, from a file."""
    model = nnx.eval_shape(lambda: create(rngs=nnx.Rngs(0)))
    save_file(
        {name: random_tensor(name, shape) for name, shape, *_ in tensors(model)}, tmp_path / "weights.safetensors"
    )
    load_backbone(model, tmp_path / "weights.safetensors")
    model.eval()
    assert_golden(name, jax.tree.leaves(nnx.jit(type(model).__call__)(model, random_images(name, 2, size))))


def test_gru_matches_torch() -> None:
    model = networks.GRU(10, 7, rngs=nnx.Rngs(0))
    for layer, kind, inputs in ((model.input, "ih", 10), (model.hidden, "hh", 7)):
        layer.kernel[...] = jnp.asarray(random_tensor(f"weight_{kind}_l0", (21, inputs)).T)
        assert layer.bias is not None
        layer.bias[...] = jnp.asarray(random_tensor(f"bias_{kind}_l0", (21,)))
    assert_golden("gru", [model(jnp.asarray(random_images("gru", 3, 10)[:, :4, :, 0]))])


def test_positions_are_resampled_as_timm_does() -> None:
    positions = random_tensor("pos_embed", (1, 197, 192))
    resampled = resampled_positions(positions, (1, 37, 192))
    assert_golden("positions", [resampled])
    np.testing.assert_array_equal(resampled[:, 0], positions[:, 0])
    assert resampled_positions(positions, (1, 37, 384)) is positions
    assert resampled_positions(positions[:, :190], (1, 37, 192)).shape == (1, 190, 192)
