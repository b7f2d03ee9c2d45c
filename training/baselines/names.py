"""Names of the baselines."""

from collections.abc import Sequence

from thor2_jax.errors import InputError

__all__ = ["BASELINES", "CLOUD_BASELINES", "NETWORKS", "TEMPLATES", "TITLES", "check_baselines", "crop_size"]

CLOUD_BASELINES = ("thor", "forest", "pointnet")
"""Baselines on point clouds."""

NETWORKS = ("rcfusion", "rcfusion-small", "vit-cnn", "vit-cnn-small", "rgbd-vit", "rgbd-vit-small")
"""Image networks on crops of colour and surface normals."""

TEMPLATES = "templates"
"""The nearest template by the features of a frozen backbone, which may be that of a network of the same run."""

BASELINES = (*CLOUD_BASELINES, *NETWORKS, TEMPLATES)
"""Names on the command line and in run directories, in the order of training."""

TITLES = {
    "forest": "forest",
    "pointnet": "PointNet",
    "thor": "THOR",
    "rcfusion": "RCFusion",
    "rcfusion-small": "RCFusion-small",
    "vit-cnn": "ViT-CNN",
    "vit-cnn-small": "ViT-CNN-small",
    "rgbd-vit": "RGB-D ViT",
    "rgbd-vit-small": "RGB-D ViT-small",
    "templates": "templates",
}
"""Column titles of the baselines, in the order of the columns."""

LARGE_CROP, SMALL_CROP = 224, 96
"""Side of the crops of the networks and of their small variants, pixels."""


def crop_size(names: Sequence[str], weights: bool) -> int | None:
    """Return the side of the crops in pixels that baselines are trained on, the largest one; None if they need none.

    Args:
        names: names of the baselines.
        weights: whether there are pretrained weights: DINOv2, by which templates are compared then, reads large crops.
    """
    sizes = [SMALL_CROP if name.endswith("-small") else LARGE_CROP for name in names if name in NETWORKS]
    if TEMPLATES in names:
        sizes.append(LARGE_CROP if weights else SMALL_CROP)
    return max(sizes, default=None)


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
