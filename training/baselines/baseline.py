"""The interface of a trained baseline and the inputs it reads."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.view_normalization import view_normalize
from thor2_jax.recognition.answers import DescribedFrame
from thor2_jax.types import PointClouds

__all__ = ["Baseline", "BaselineInputs", "baseline_inputs"]


class BaselineInputs(NamedTuple):
    """The B instances of a described frame, as baselines read them.

    Attributes:
        normal: view-normalized clouds, scaled units.
        tops: [B, F] float32, their TOPS descriptors.
    """

    normal: PointClouds
    tops: NDArray[np.float32]


def baseline_inputs(described: DescribedFrame, config: DescriptorConfig) -> BaselineInputs:
    """Return the instances of a frame, in the row order of `described.packed`."""
    return BaselineInputs(view_normalize(described.packed, config), np.asarray(described.descriptors.tops))


class Baseline(Protocol):
    """A trained baseline."""

    def probabilities(self, inputs: BaselineInputs) -> NDArray[np.float32]:
        """Return class probabilities, [B, C]."""

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return all fitted parameters by name."""
