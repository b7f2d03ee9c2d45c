"""The interface of a trained baseline and the inputs it reads."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.view_normalization import view_normalize
from thor2_jax.errors import InputError
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.model.answers import DescribedFrame
from thor2_jax.types import PointClouds
from training.views.crops import rgbd_crop
from training.views.view_crops import ViewCrops, quantized, stacked

__all__ = ["Baseline", "BaselineInputs", "baseline_inputs"]


def _no_crops(size: int) -> ViewCrops:
    raise InputError("frame is missing; expected the frame of the instances: image networks read crops of it")


class BaselineInputs(NamedTuple):
    """The B instances of a described frame, as baselines read them.

    Attributes:
        normal: view-normalized clouds, scaled units.
        tops: [B, F] float32, their TOPS descriptors.
        crops: function of the side in pixels that returns the crops of the instances; only those of padding rows are
            missing.
    """

    normal: PointClouds
    tops: NDArray[np.float32]
    crops: Callable[[int], ViewCrops] = _no_crops


def baseline_inputs(described: DescribedFrame, config: DescriptorConfig, frame: RGBDFrame) -> BaselineInputs:
    """Return the instances of a frame, in the row order of `described.packed`; crops are made when a baseline asks."""

    @functools.cache
    def crops(size: int) -> ViewCrops:
        return stacked([quantized(rgbd_crop(frame, view.label, size)) for view in described.usable], size)

    return BaselineInputs(view_normalize(described.packed, config), np.asarray(described.descriptors.tops), crops)


class Baseline(Protocol):
    """A trained baseline."""

    def probabilities(self, inputs: BaselineInputs) -> NDArray[np.float32]:
        """Return class probabilities, [B, C]."""

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return all fitted parameters by name."""
