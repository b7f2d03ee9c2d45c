"""scikit-learn transformers from lists of point clouds to TOPS and TOPS2.

>>> import numpy as np
>>> clouds = [(np.random.rand(300, 3) / 10, np.random.rand(300, 3)) for _ in range(4)]
>>> Tops2Transformer().fit_transform(clouds).shape
(4, 11942)
"""

import itertools
import warnings
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin

import colornet
from colornet import ColorNetwork
from thor2_jax.capacity import BATCH_BUCKETS, POINT_BUCKETS, batch_bucket
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import describe_stream
from thor2_jax.errors import InputError, as_array
from thor2_jax.types import check_capacity, check_cloud

__all__ = ["Tops2Transformer", "TopsTransformer"]

MAX_EXTENT = 2.0
"""Largest extent of a cloud, metres. A larger cloud is probably not in metres, since descriptors cover about 0.3 m."""


class _CloudTransformer(TransformerMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn has no type hints
    """Base of both transformers: they learn nothing, so `fit` only checks its arguments."""

    config: DescriptorConfig | None
    network: ColorNetwork | None = None
    capacity: int | None
    _has_color = True

    def fit(self, X: Sequence[Any], y: Any = None) -> Self:
        """Check the parameters and the clouds; nothing is learned, so calling it before `transform` is optional.

        Args:
            X: clouds, as in `transform`.
            y: ignored.

        Raises:
            InputError: as `transform`.
        """
        self._check_parameters()
        self._clouds(X)
        return self

    def transform(self, X: Sequence[Any]) -> NDArray[np.float32]:
        """Return the descriptors of clouds, one row for each.

        Clouds are described in batches of up to 256. A batch is padded to a batch bucket and to the point bucket of its
        largest cloud (see `thor2_jax.capacity`), so that few shapes are ever compiled. The same cloud in another batch
        has the same descriptor up to float32 rounding.

        Args:
            X: clouds in metres and the camera frame, as the class describes them; at least one.

        Returns:
            [len(X), number of features] float32, or a data frame if `set_output` says so.

        Raises:
            InputError: a parameter has another type, `X` is empty or is not a list of clouds, or a cloud is invalid or
                larger than `capacity`. The message gives the index of the cloud.

        Warns:
            UserWarning: a cloud is too long for coordinates in metres. Nearly all of its points overflow the slices and
                strips, which cover about 0.3 m, so that its row is near zero; `Descriptors.overflow` has the number.
        """
        config, network = self._check_parameters()
        clouds = self._clouds(X)
        batch = batch_bucket(min(len(clouds), BATCH_BUCKETS[-1]))
        # Empty clouds fill the last batch, so that later computations on it have few shapes, too.
        empty = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
        padded = itertools.chain(clouds, [empty] * (-len(clouds) % batch))
        described = describe_stream(padded, network, config, self.capacity, batch)
        rows = [np.asarray(each.tops2 if self._has_color else each.tops) for each in described]
        return np.concatenate(rows)[: len(clouds)]

    def get_feature_names_out(self, input_features: Any = None) -> NDArray[np.object_]:
        """Return the names of the features, in the order of the columns of `transform`.

        Args:
            input_features: ignored, since a cloud has no features.
        """
        config, network = self._check_parameters()
        pixels, names = range(config.image_size), []
        for i in range(config.n_slices):
            names += [f"slice{i}_birth{b}_persistence{p}" for b in pixels for p in pixels]
            if self._has_color:
                strips = range(config.n_strips)
                names += [f"slice{i}_region{r}_strip{j}" for r in range(network.n_regions) for j in strips]
        return np.array(names, object)

    def _check_parameters(self) -> tuple[DescriptorConfig, ColorNetwork]:
        config = DescriptorConfig(homology="closed_form") if self.config is None else self.config
        if not isinstance(config, DescriptorConfig):
            raise InputError(f"config is {config!r}; expected a DescriptorConfig, or None for the default one")
        network = self.network
        if not (network is None or isinstance(network, ColorNetwork)):
            raise InputError(f"network is {network!r}; expected a ColorNetwork, or None for the packaged one")
        check_capacity(self.capacity)
        return config, colornet.load_default() if network is None else network

    def _clouds(self, X: Sequence[Any]) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        if isinstance(X, str | bytes) or not isinstance(X, Sequence | np.ndarray) or getattr(X, "ndim", 1) == 0:
            raise InputError(f"X is of type {type(X).__name__}; expected a list of clouds")
        if len(X) == 0:
            raise InputError("X is empty; expected a list of at least one cloud")
        if isinstance(X, tuple) and len(X) == 2 and getattr(X[0], "shape", 0) == getattr(X[1], "shape", 1):
            raise InputError("X is two arrays of one shape; expected a list of clouds: [(xyz, rgb)] or [xyz, xyz]")
        limit = POINT_BUCKETS[-1] if self.capacity is None else self.capacity
        clouds = []
        for i in range(len(X)):
            xyz, rgb = check_cloud(self._pair(X[i], f"X[{i}]"), f"X[{i}]")
            if len(xyz) > limit:
                raise InputError(f"X[{i}] has {len(xyz)} points; expected at most {limit}; give a larger capacity")
            clouds.append((xyz, rgb))
        extents = [float(np.ptp(xyz, axis=0).max()) if len(xyz) else 0.0 for xyz, _ in clouds]
        if max(extents) > MAX_EXTENT:
            i = extents.index(max(extents))
            warnings.warn(
                f"X[{i}] is {extents[i]:.4g} m long; expected coordinates in metres, of at most {MAX_EXTENT:g} m: if "
                "they are millimetres, multiply them by 0.001",
                stacklevel=3,
            )
        return clouds

    def _pair(self, cloud: Any, name: str) -> Any:
        return cloud

    def __sklearn_is_fitted__(self) -> bool:
        return True

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.requires_fit = False
        tags.input_tags.two_d_array = False
        return tags


class TopsTransformer(_CloudTransformer):
    """Transform point clouds to TOPS, the shape descriptor; colours are not used.

    A cloud is an array xyz [n, 3], floating, metres, in the camera frame, or a pair (xyz, rgb) as `Tops2Transformer`
    takes it, whose colours are ignored. A row has S * P * P features (7,168 by default), the persistence images of the
    slices; `slice0_birth3_persistence5` is the name of one pixel.

    Args:
        config: settings of the descriptor; by default those of the paper, with diagrams in closed form.
        capacity: padded number of points of every cloud, which it must not exceed; by default the point bucket of each
            batch, at most 8192.
    """

    _has_color = False

    def __init__(self, config: DescriptorConfig | None = None, capacity: int | None = None) -> None:
        self.config = config
        self.capacity = capacity

    def _pair(self, cloud: Any, name: str) -> Any:
        xyz = as_array(cloud[0] if isinstance(cloud, tuple | list) and len(cloud) == 2 else cloud, f"{name}: xyz")
        return xyz, np.zeros(xyz.shape, np.uint8)


class Tops2Transformer(_CloudTransformer):
    """Transform coloured point clouds to TOPS2, the descriptor of shape and colour.

    A cloud is a pair of xyz [n, 3], floating, metres, in the camera frame, and rgb [n, 3], sRGB, uint8 or floating in
    [0, 1]. A row has S * (P * P + R * J) features (11,942 by default), for each slice the pixels of its persistence
    image (`slice0_birth3_persistence5`) and its colour embedding (`slice0_region2_strip7`).

    Args:
        config: settings of the descriptor; by default those of the paper, with diagrams in closed form.
        network: the colour network; by default the packaged one, `colornet.load_default()`.
        capacity: padded number of points of every cloud, which it must not exceed; by default the point bucket of each
            batch, at most 8192.
    """

    def __init__(
        self, config: DescriptorConfig | None = None, network: ColorNetwork | None = None, capacity: int | None = None
    ) -> None:
        self.config = config
        self.network = network
        self.capacity = capacity
