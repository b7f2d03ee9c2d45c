"""Labelled real instances as views of their classes, together with rendered views or alone.

instances = read_instances(FrameFolder(find_frames([Path("frames")])), config.sigma_s)
source = WithLabelledViews(instances, config, ViewDataset.open("views"))
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError, with_context
from thor2_jax.files import content_digest
from thor2_jax.frames.prepared_instance import PreparedInstance, instance_view
from thor2_jax.gallery.enrollment import augmented_view
from thor2_jax.printable import check_name, first_names, normal_name
from thor2_jax.surfaces.surfaces import Surfaces
from training.readers.frames import FrameFolder
from training.views.crops import Crop, ViewCrops, rgbd_crop
from training.views.normalized_views import MemoryViews, NormalizedViews, SourceShard, ViewSource, normalize_views

__all__ = ["MAX_COPIES", "LabelledInstances", "WithLabelledViews", "read_instances"]

MAX_COPIES = 8
"""Largest number of augmented copies of an instance."""

CLOUDS = 200
"""Number of clouds of a class, including augmented copies, to reach if there are no rendered views."""

FIRST_VIEW = 1_000_000
"""Number of the first labelled view of a class; rendered views have smaller numbers."""


@dataclasses.dataclass(frozen=True)
class LabelledInstances:
    """The instances of labelled frames.

    Attributes:
        views: object -> its usable instances, at least one per object.
        skipped: for each unusable instance, the reason.
        crops: object -> the crops of its usable instances, all of one size; empty if no crops are needed.
        left_out: objects that `WithoutClasses` will omit.
    """

    views: Mapping[str, Sequence[PreparedInstance]]
    skipped: Sequence[str] = ()
    crops: Mapping[str, Sequence[Crop]] = dataclasses.field(default_factory=dict)
    left_out: Sequence[str] = ()

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the names and the clouds of the instances."""
        each = [view for views in self.views.values() for view in views]
        arrays = (array for view in each for array in (view.points, view.colors, view.boundary))
        sizes = [(name, [len(view.points) for view in views]) for name, views in self.views.items()]
        return content_digest([repr(sizes), *(array.tobytes() for array in arrays)])


def read_instances(
    frames: FrameFolder,
    sigma_s: float,
    label_name: str | None = None,
    instance: int | None = None,
    crop_size: int | None = None,
) -> LabelledInstances:
    """Read the instances of labelled frames.

    Args:
        frames: the frames.
        sigma_s: scaled units per metre, see `DescriptorConfig`.
        label_name: read only the object with this name in labels.json, or the only instance of frames without names.
        instance: number of the object called `label_name`, in place of labels.json.
        crop_size: side of the crops, pixels; None makes no crops.

    Raises:
        InputError: a folder or a frame cannot be read, or an object has no usable view. Instances with a name that
            `check_name` refuses are skipped.
    """
    views: dict[str, list[PreparedInstance]] = {}
    crops: dict[str, list[Crop]] = {}
    skipped = [("", frames.note)] if frames.note else []
    for item in frames:
        labels: list[tuple[int | None, str]] = [*sorted(item.truth.items())]
        if label_name is not None:
            labels = [(label, label_name) for label, name in labels if normal_name(name) == normal_name(label_name)]
            if instance is not None or not frames.named:
                labels = [(instance, label_name)]
        for label, name in labels:
            try:
                with with_context(item.identifier):
                    if label is None and (count := len(item.frame.instances)) > 1:
                        raise InputError(f"it has {count} instances; expected one, or the object's number (--instance)")
                    name = check_name(name) if label_name is None else name
                    of_object = views.setdefault(name, [])
                    of_object.append(instance_view(item.frame, label, sigma_s))
                    if crop_size is not None:
                        crops.setdefault(name, []).append(rgbd_crop(item.frame, of_object[-1].label, crop_size))
            except InputError as error:
                skipped.append((name, str(error)))
    if empty := [name for name, of_object in views.items() if not of_object]:
        reason = next(reason for name, reason in skipped if name == empty[0])
        raise InputError(f"frames: {empty[0]!r} has no usable view ({reason})")
    if not views:
        if skipped:
            raise InputError(f"frames: {skipped[0][1]}")
        if label_name is None:
            raise InputError("frames: no frame has a label; expected the names of the objects in labels.json")
        names = first_names(sorted(frames.names() or ())) or "the names in labels.json, which has none"
        raise InputError(f"frames: no label is {label_name!r}; expected one of {names}; see --label-name, --instance")
    return LabelledInstances(views, [reason for _, reason in skipped], crops)


class WithLabelledViews:
    """A source of views, extended by labelled real instances.

    Each instance is one view with augmented copies. Their number is chosen so that the class gets about as many clouds
    of instances as a class has rendered clouds, but it is at most `MAX_COPIES` per instance.
    """

    def __init__(
        self, instances: LabelledInstances, config: DescriptorConfig, rendered: ViewSource | None = None
    ) -> None:
        """Store the instances; nothing is computed yet.

        Args:
            instances: the instances. Their new classes are added after the classes of `rendered`.
            config: descriptor; only `sigma_s` is used.
            rendered: source of rendered views, or None.
        """
        self._rendered: ViewSource = MemoryViews({}, config) if rendered is None else rendered
        self._instances, self._config, views = instances, config, instances.views
        self.classes = tuple(dict.fromkeys([*self._rendered.classes, *views]))
        shards = self._rendered.shards
        clouds = np.bincount([shard.label for shard in shards], [shard.views for shard in shards])
        wanted = int(max(clouds, default=0)) or CLOUDS
        self._copies = {name: min(MAX_COPIES, max(wanted // len(each) - 1, 0)) for name, each in views.items()}
        sizes = {name: len(each) * (1 + self._copies[name]) for name, each in views.items()}
        self.shards = (*shards, *(SourceShard(self.classes.index(name), size) for name, size in sizes.items()))

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the digest of the rendered views, the instances and the numbers of their copies."""
        rendered = self._rendered.digest if self._rendered.classes else None
        return content_digest([repr((rendered, self._instances.digest, list(self._copies.values())))])

    @property
    def record(self) -> Mapping[str, Any]:
        """Record of the rendered views, and of the instances and copies of each class."""
        return {
            **self._rendered.record,
            "digest": self.digest,
            "views": sum(shard.views for shard in self.shards),
            "frames": {
                "digest": self._instances.digest,
                "instances": {name: len(each) for name, each in self._instances.views.items()},
                "copies": self._copies,
                "skipped": list(self._instances.skipped),
            },
        }

    @property
    def surfaces(self) -> Surfaces | None:
        """Surfaces of the rendered views; None if a class that is not left out has labelled views only."""
        with_surfaces = {*self._rendered.classes, *self._instances.left_out}
        return self._rendered.surfaces if with_surfaces.issuperset(self.classes) else None

    def read(self, index: int) -> NormalizedViews:
        """Read a shard of the rendered views, or augment and normalize the instances of a class.

        Raises:
            InputError: an instance is too long; also as the source of the rendered views.
        """
        if index < len(self._rendered.shards):
            return self._rendered.read(index)
        label = self.shards[index].label
        name = self.classes[label]
        views, copies = self._instances.views[name], self._copies[name]
        flat = [each for view in views for each in (view, *(augmented_view(view, copy) for copy in range(copies)))]
        clouds, boundary = [(view.points, view.colors) for view in flat], [view.boundary for view in flat]
        view = np.repeat(FIRST_VIEW + np.arange(len(views)), 1 + copies).tolist()
        copy = list(range(1 + copies)) * len(views)
        with with_context(f"frames: {name!r}"):
            return normalize_views(clouds, label, view, copy, self._config, boundary)

    def read_crops(self, index: int, size: int) -> ViewCrops:
        """Read the crops of a shard of the rendered views, or the crops of a class's instances, repeated for copies.

        Raises:
            InputError: as the source of the rendered views.
        """
        if index < len(self._rendered.shards):
            return self._rendered.read_crops(index, size)
        name = self.classes[self.shards[index].label]
        crops, times = self._instances.crops[name], 1 + self._copies[name]
        reduced = ViewCrops.stacked(crops, len(crops[0][0])).reduced(size)
        return ViewCrops(reduced.color.repeat(times, axis=0), reduced.normals.repeat(times, axis=0))
