"""Clouds in memory as a source of views for training.

source = MemoryViews(render_views(find_meshes("meshes")), config)
"""

import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.files import content_digest
from thor2_jax.types import Cloud
from training.views.normalized_views import NormalizedViews, normalize_views
from training.views.view_crops import ViewCrops

__all__ = ["MemoryViews"]


class _Shard(NamedTuple):
    label: int
    views: int


class MemoryViews:
    """Clouds in memory as a source of views, one shard per class; `read` normalizes them."""

    def __init__(self, views: Mapping[str, Sequence[Cloud]], config: DescriptorConfig) -> None:
        """Keep the clouds; nothing is computed yet.

        Args:
            views: class name -> clouds (xyz [n, 3] float32 metres in the camera frame, rgb [n, 3] uint8).
            config: descriptor; only `sigma_s` is used.
        """
        self.classes = tuple(views)
        self.shards = tuple(_Shard(label, len(clouds)) for label, clouds in enumerate(views.values()))
        self._clouds = tuple(views.values())
        self._config = config

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the class names and clouds."""
        arrays = (array for clouds in self._clouds for cloud in clouds for array in cloud)
        return content_digest(itertools.chain([repr((self.classes, self.shards))], (a.tobytes() for a in arrays)))

    @property
    def record(self) -> Mapping[str, Any]:
        """Digest and number of views, for the record of a run."""
        return {"digest": self.digest, "views": sum(shard.views for shard in self.shards)}

    def read(self, index: int) -> NormalizedViews:
        """Normalize the views of a class.

        Raises:
            InputError: A cloud has more points than the largest bucket, or is too long.
        """
        clouds = self._clouds[index]
        return normalize_views(clouds, index, range(len(clouds)), [0] * len(clouds), self._config)

    def read_crops(self, index: int, size: int) -> ViewCrops:
        """Raise InputError: clouds in memory have no images."""
        raise InputError("dataset: clouds in memory have no crops; give a rendered dataset with --dataset")
