"""Labelled real instances as views of their classes, beside rendered views or alone.

source = WithLabelledViews({"mug": instances}, config, ViewDataset.open("views"))
"""

import functools
import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import with_context
from thor2_jax.files import content_digest
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery.enrollment import augmented_view
from training.views.crops import QuantizedCrop, ViewCrops, stacked
from training.views.normalized_views import NormalizedViews, SourceShard, ViewSource, normalize_views

__all__ = ["MAX_COPIES", "WithLabelledViews", "digest_of_instances"]

MAX_COPIES = 8
"""Most augmented copies of an instance."""

CLOUDS = 200
"""Clouds of a class, as given and augmented, that copies are added up to if there are no rendered views."""

FIRST_VIEW = 1_000_000
"""Number of the first labelled view of a class; rendered views have smaller ones."""


def digest_of_instances(views: Mapping[str, Sequence[PreparedInstance]]) -> str:
    """Return the SHA-256 of the names and the clouds of labelled instances."""
    arrays = (a for each in views.values() for view in each for a in (view.points, view.colors, view.boundary))
    sizes = [(name, [len(view.points) for view in each]) for name, each in views.items()]
    return content_digest([repr(sizes), *(a.tobytes() for a in arrays)])


class WithLabelledViews:
    """A source of views joined with labelled real instances.

    An instance is one view, as it is and in augmented copies, as many as bring the instances of its class to about the
    number of the rendered clouds of a class, and at most `MAX_COPIES`.
    """

    def __init__(
        self,
        views: Mapping[str, Sequence[PreparedInstance]],
        config: DescriptorConfig,
        rendered: ViewSource | None = None,
        skipped: Sequence[str] = (),
        crops: Mapping[str, Sequence[QuantizedCrop]] | None = None,
    ) -> None:
        """Keep the instances; nothing is computed yet.

        Args:
            views: class -> its prepared instances, at least one each. Classes that `rendered` does not have are added
                after its classes.
            config: descriptor; only `sigma_s` is used.
            rendered: other views; None if there are none.
            skipped: why further instances could not be used, for the record.
            crops: class -> the crops of its instances, of one size; None if nothing reads them.
        """
        self._rendered, self._views, self._config, self._skipped = rendered, dict(views), config, list(skipped)
        self._crops = crops
        self.classes = tuple(dict.fromkeys([*(rendered.classes if rendered else ()), *views]))
        shards = list(rendered.shards) if rendered else []
        clouds = [0] * len(self.classes)
        for shard in shards:
            clouds[shard.label] += shard.views
        self._wanted = max(clouds) or CLOUDS
        self._first = len(shards)
        sizes = {name: len(each) * (1 + self._copies(name)) for name, each in views.items()}
        self.shards = (*shards, *(SourceShard(self.classes.index(name), size) for name, size in sizes.items()))

    def _copies(self, name: str) -> int:
        return min(MAX_COPIES, max(self._wanted // len(self._views[name]) - 1, 0))

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the digest of the rendered views, the instances and the numbers of their copies."""
        rendered = self._rendered.digest if self._rendered else None
        copies = [self._copies(name) for name in self._views]
        return hashlib.sha256(repr((rendered, digest_of_instances(self._views), copies)).encode()).hexdigest()

    @property
    def record(self) -> Mapping[str, Any]:
        """Record of the rendered views, and of the instances and copies of each class."""
        return {
            **(self._rendered.record if self._rendered else {}),
            "digest": self.digest,
            "views": sum(shard.views for shard in self.shards),
            "frames": {
                "digest": digest_of_instances(self._views),
                "instances": {name: len(each) for name, each in self._views.items()},
                "copies": {name: self._copies(name) for name in self._views},
                "skipped": self._skipped,
            },
        }

    def read(self, index: int) -> NormalizedViews:
        """Read a shard of the rendered views, or augment and normalize the instances of a class.

        Raises:
            InputError: as the source of the rendered views, or an instance is too long.
        """
        if index < self._first:
            assert self._rendered is not None
            return self._rendered.read(index)
        name, label = list(self._views)[index - self._first], self.shards[index].label
        views, copies = self._views[name], self._copies(name)
        each = [[view, *(augmented_view(view, copy) for copy in range(copies))] for view in views]
        flat = [view for group in each for view in group]
        clouds, boundary = [(view.points, view.colors) for view in flat], [view.boundary for view in flat]
        view = np.repeat(FIRST_VIEW + np.arange(len(views)), 1 + copies).tolist()
        copy = list(range(1 + copies)) * len(views)
        with with_context(f"frames: {name!r}"):
            return normalize_views(clouds, label, view, copy, self._config, boundary)

    def read_crops(self, index: int, size: int) -> ViewCrops:
        """Read the crops of a shard of the rendered views, or repeat those of a class's instances for their copies.

        Raises:
            InputError: as the source of the rendered views.
        """
        if index < self._first:
            assert self._rendered is not None
            return self._rendered.read_crops(index, size)
        assert self._crops is not None
        name = list(self._views)[index - self._first]
        crops, times = self._crops[name], 1 + self._copies(name)
        reduced = stacked(crops, len(crops[0][0])).reduced(size)
        return ViewCrops(reduced.color.repeat(times, axis=0), reduced.normals.repeat(times, axis=0))
