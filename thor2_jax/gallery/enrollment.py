"""Enrollment: augmentation and embedding of the views of an object, and a gallery that can be changed.

Another camera may see an object differently than its views, whether these are a few frames or renderings of a mesh.
Augmented copies of the views therefore have other light, sensor noise and cut masks; they are made without rendering.
The random numbers are seeded with the cloud, so that each copy of a view is the same for every embedding.
"""

import dataclasses
import datetime
import functools
import math
import threading
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colornet.colors import LUMA
from thor2_jax.capacity import batch_points, point_bucket
from thor2_jax.descriptor.looks import describe_looks
from thor2_jax.errors import InputError
from thor2_jax.frames.prepared_instance import MIN_POINTS, PreparedInstance, pack_instances
from thor2_jax.gallery import store
from thor2_jax.gallery.compact_clouds import CompactClouds
from thor2_jax.gallery.gallery import Gallery, GalleryObject
from thor2_jax.networks.embedding import Embedding, load_default
from thor2_jax.printable import first_names

__all__ = [
    "LOOKS",
    "ObjectGallery",
    "augmented_view",
    "embed_looks",
    "embedded_object",
    "gallery_object",
    "views_to_embed",
]

LOOKS = 2
"""Number of looks at a view, which are all embedded, and at a query, whose scores are averaged over them."""

ROWS = 4
"""Number of clouds embedded in one call, as in recognition."""

MANY_ROWS = 16
"""Number of clouds embedded in one call if there are many, since a call costs as much as several clouds."""


def embed_looks(embedding: Embedding, views: Sequence[PreparedInstance]) -> NDArray[np.float32]:
    """Return the embeddings [V, K, D] of the looks at views."""
    rows = MANY_ROWS if len(views) > 4 * MANY_ROWS else ROWS
    batches = []
    for start in range(0, len(views), rows):
        chunk = views[start : start + rows]
        clouds = pack_instances(chunk, rows, batch_points(len(view.points) for view in chunk))
        looks = describe_looks(clouds, embedding.network, embedding.config, LOOKS)
        batches.append(embedding.embed_oriented(looks, clouds))
    return np.concatenate(batches)[: len(views)]


def gallery_object(
    embeddings: NDArray[Any], clouds: CompactClouds, source: str, surface: Mapping[str, NDArray[Any]] | None = None
) -> GalleryObject:
    """Return an object that is enrolled at this time; `embeddings` [..., D] are those of `views_to_embed`."""
    date = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
    flat = embeddings.reshape(-1, embeddings.shape[-1]).astype(np.float16)
    return GalleryObject(flat, clouds, source, date, surface)


def embedded_object(
    embedding: Embedding, clouds: CompactClouds, source: str, surface: Mapping[str, NDArray[Any]] | None = None
) -> GalleryObject:
    """Return the views of an object as a gallery stores them; for `source` and `surface` see `ObjectGallery.enroll`.

    Raises:
        InputError: there is no view.
    """
    if not clouds:
        raise InputError("views is empty; expected at least one view of the object")
    # Views of similar size share a bucket.
    views = sorted(views_to_embed(clouds, source), key=lambda view: point_bucket(len(view.points)))
    return gallery_object(embed_looks(embedding, views), clouds, source, surface)


def _contents(clouds: CompactClouds) -> list[bytes]:
    return [view.points.tobytes() + view.colors.tobytes() + view.boundary.tobytes() for view in clouds.views()]


def _new_views(clouds: CompactClouds, surface: object, stored: GalleryObject | None) -> CompactClouds:
    """Return the views that an object lacks, without repetitions; all, if it gets its first surface."""
    known = [] if stored is None or (surface is not None and stored.surface is None) else _contents(stored.clouds)
    new = {content: number for number, content in enumerate(_contents(clouds)) if content not in known}
    return clouds.select([*new.values()])


MAX_COPIES = 8
"""Largest number of copies of all views from frames together."""

MESH_COPIES = 1
"""Number of copies of each view from a mesh."""

CAST, MESH_CAST = 0.06, 0.2
"""Largest deviation from 1 of the factor of each colour channel, for objects from frames and for those with a mesh."""


def views_to_embed(clouds: CompactClouds, source: str) -> list[PreparedInstance]:
    """Return the views of one object and augmented copies of them.

    Args:
        clouds: the views.
        source: "mesh" or "mesh and frames" for `MESH_COPIES` of each view, with colour casts up to `MESH_CAST`;
            "frames" for up to `MAX_COPIES` in all, with casts up to `CAST`, or none for more views than that.
    """
    of_mesh = source.startswith("mesh")
    copies, cast = (MESH_COPIES, MESH_CAST) if of_mesh else (MAX_COPIES // max(len(clouds), 1), CAST)
    views = list(clouds.views())
    return views + [augmented_view(view, copy, cast) for view in views for copy in range(copies)]


def augmented_view(view: PreparedInstance, copy: int, cast: float = CAST) -> PreparedInstance:
    """Return an augmented copy of a view; equal arguments give equal copies.

    Args:
        view: a view with at least one point.
        copy: number of the copy.
        cast: largest deviation from 1 of the factor of each colour channel.
    """
    rng = np.random.default_rng([zlib.crc32(view.colors.tobytes()), len(view.points), copy])
    points, keep = _sensed(view.points, rng), ~_cut(view.points, rng)
    if keep.sum() < MIN_POINTS:
        keep[:] = True
    colors = _relit(view.colors, cast, rng)
    return PreparedInstance(view.label, points[keep], colors[keep], view.boundary[keep], view.occluded)


def _relit(colors: NDArray[np.uint8], cast: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the colours under another light: gamma, gain, colour cast, saturation, stray light and noise."""
    gamma, gain, saturation = rng.uniform(0.8, 1.25), rng.uniform(0.75, 1.25), rng.uniform(0.75, 1.3)
    channels, veil = rng.uniform(1 - cast, 1 + cast, 3), rng.uniform(0, 0.05)
    values = (colors / np.float32(255)) ** np.float32(gamma) * np.float32(gain) * channels.astype(np.float32)
    grey = (values @ LUMA)[:, None]
    values = (grey + np.float32(saturation) * (values - grey)) * np.float32(1 - veil) + np.float32(veil)
    values += np.float32(rng.uniform(0, 0.01)) * rng.standard_normal(values.shape, np.float32)
    return np.rint(255 * values).clip(0, 255).astype(np.uint8)


def _sensed(points: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the points with noise along their rays, at most half of a depth camera's noise."""
    deviation = rng.uniform(0, 0.5) * (0.0012 + 0.0019 * (points[:, 2:] - 0.4) ** 2)
    noise = deviation * rng.standard_normal((len(points), 1))
    return (points * (1 + noise / np.maximum(points[:, 2:], 0.1))).astype(np.float32)


def _cut(points: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return the points that a mask misses on one side of the silhouette, at most an eighth of them."""
    angle = rng.uniform(0, 2 * np.pi)
    rays = points[:, :2] / np.maximum(points[:, 2:], 0.1)
    along = rays @ np.array([np.cos(angle), np.sin(angle)])
    rank = math.ceil(rng.uniform(0, 0.125) * (len(along) - 1))
    return np.asarray(along < np.partition(along, rank)[rank])


FEW = 10
"""Number of views of an object (without a background: of objects) below which few unknown objects are rejected."""


_CHANGE = threading.Lock()
"""Held while a thread changes the gallery in memory or reads it again, so that it loses no change of another thread.

An attribute could not be pickled."""


Report = Callable[[int, int], Any]
"""Called with the number of objects embedded again and of all."""


class ObjectGallery:
    """Enrolled objects beside the trained classes of a run.

    Each change replaces the immutable gallery by a new one, so that other threads see the state before or after it. A
    shallow copy shares the gallery; a change through one of the two is visible to the other after `refresh`.

    Attributes:
        gallery: the gallery.
        directory: directory of the gallery; None if it is in memory. `open` sets it.
        lock_seconds: time that a change waits for other processes and threads that write to the gallery on disk.
    """

    def __init__(self, trained: tuple[str, ...], embedding: Embedding | None = None, search: str = "exact") -> None:
        """Create an empty gallery in memory.

        Args:
            trained: class names of the run.
            embedding: embedding of the views; by default the packaged one.
            search: "exact" or "usearch", see `Gallery`.

        Raises:
            InputError: `search` is unknown.
        """
        self._embedding = embedding
        self.directory: Path | None = None
        self.gallery = Gallery("", trained=trained, search=search)
        self.lock_seconds = store.LOCK_SECONDS

    def open(self, directory: Path, *, reembed: bool = False, report: Report = lambda done, total: None) -> None:
        """Read the gallery in a directory, which may not exist yet, and write all later changes to it.

        Args:
            directory: directory of the gallery.
            reembed: embed all views again with the embedding of this run, whatever their embedding was, and rebuild a
                lost index.
            report: function that shows the progress.

        Raises:
            InputError: as `refresh`.
            OSError: the gallery cannot be written; it is unchanged.
        """
        self.directory = directory = directory.absolute()  # later changes of the working directory do not matter
        if reembed and directory.exists():
            store.check_open_to_changes(directory)
            change = functools.partial(self._reembedded, report, {})
            change(store.load_gallery(directory, rebuild=True))  # takes long, without the lock
            self._change(change, reembed=True)  # embeds what was enrolled meanwhile
        else:
            store.check_index(directory)
            self.refresh()

    @property
    def embedding(self) -> Embedding:
        """The embedding of the views; the packaged one is loaded on first use."""
        return self._embedding or load_default()

    @property
    def weak_rejection(self) -> str:
        """Message that explains why few unknown objects are rejected, and what helps; empty if there is no cause."""
        objects, references = self.gallery.objects.values(), self.gallery.references
        if few := [name for name, enrolled in self.gallery.objects.items() if len(enrolled.clouds) < FEW]:
            count = f"{len(few)} of {len(objects)} ({first_names(few)})"
            return f"enrolled objects with fewer than {FEW} views: {count}; add views from other sides"
        has_surfaces = all(enrolled.surface is not None for enrolled in objects)
        if objects and not has_surfaces and references is None and not self.gallery.trained and len(objects) < FEW:
            return f"objects enrolled in a run without reference views: {len(objects)}; enroll more of them"
        return ""

    def refresh(self) -> bool:
        """Read the gallery again if it has changed on disk, and return whether it has.

        Raises:
            InputError: the gallery cannot be read, or has another embedding; the gallery in memory is unchanged.
        """
        with _CHANGE:
            if self.directory is None or store.gallery_stamp(self.directory) == self.gallery.stamp:
                return False
            self.gallery = self._of_run(store.load_gallery(self.directory, self.embedding.fingerprint, self.gallery))
            return True

    def _reembedded(self, report: Report, embedded: dict[str | None, GalleryObject], gallery: Gallery) -> Gallery:
        """Return the gallery with embedded objects; `embedded` has those of some files, and gets the others."""
        objects, total = dict[str, GalleryObject](), len(gallery.objects)
        for name, enrolled in gallery.objects.items():
            if enrolled.file not in embedded:
                report(len(objects), total)
                embedded[enrolled.file] = embedded_object(
                    self.embedding, enrolled.clouds, enrolled.source, enrolled.surface
                )
            objects[name] = dataclasses.replace(embedded[enrolled.file], date=enrolled.date)
        report(total, total)
        return dataclasses.replace(gallery, embedding=self.embedding.fingerprint, objects=objects)

    def _change(self, change: Callable[[Gallery], Gallery], reembed: bool = False) -> None:
        def changed(stored: Gallery) -> Gallery:
            return self._of_run(change(self._of_run(stored)))

        embedding = None if reembed else self.embedding.fingerprint
        if self.directory is None:
            with _CHANGE:
                self.gallery = changed(self.gallery)
        else:
            self.gallery = store.update_gallery(self.directory, changed, embedding, self.gallery, self.lock_seconds)
            self.refresh()  # Another thread may have changed it since, and may have set the attribute before.

    def _of_run(self, gallery: Gallery) -> Gallery:
        """Return a gallery with the values of the run and the options; it has references only if it has objects."""
        return dataclasses.replace(
            gallery,
            trained=self.gallery.trained,
            search=self.gallery.search,
            references=self.embedding.references if gallery.objects else None,
            embedding_version=self.embedding.sizes.version,
        )

    def enroll(
        self,
        name: str,
        views: Sequence[PreparedInstance],
        source: str,
        surface: Mapping[str, NDArray[Any]] | None = None,
        *,
        extend: bool = False,
        replace: bool = False,
    ) -> None:
        """Enroll an object from prepared views.

        Args:
            name: name of the object.
            views: its views.
            source: "mesh" for views rendered from a mesh, or "frames".
            surface: `Surfaces.arrays` of the mesh, with which instances are compared (`training.objects.surfaces`).
            extend: add the views to an existing object with this name, see `new_views`.
            replace: discard the views of an object with this name, and the classifiers' output for it.

        Raises:
            InputError: a view cannot be used, or the name exists and neither `extend` nor `replace` is given. Nothing
                is enrolled.
            OSError: the gallery cannot be written; it is unchanged.
        """
        self.refresh()  # another process may have forgotten the object
        name = self.gallery.name_to_enroll(name, extend=extend, replace=replace)
        clouds = self.new_views(name, views, surface, extend=extend)
        if clouds or not views:
            self.add({name: embedded_object(self.embedding, clouds, source, surface)}, extend=extend, replace=replace)

    def new_views(
        self, name: str, views: Sequence[PreparedInstance], surface: Mapping[str, NDArray[Any]] | None, *, extend: bool
    ) -> CompactClouds:
        """Return views as a gallery stores them, without repetitions.

        With `extend`, those that the object `name` has already are left out, unless it gets its first surface.

        Raises:
            InputError: a view has no points or is too large.
        """
        return _new_views(CompactClouds.of(views), surface, self.gallery.objects.get(name) if extend else None)

    def add(self, objects: Mapping[str, GalleryObject], *, extend: bool = False, replace: bool = False) -> None:
        """Add embedded objects in one change; the arguments and errors are those of `enroll`."""

        def change(gallery: Gallery) -> Gallery:
            for name, enrolled in objects.items():
                # Another change may have added the same views, or some of them, since `new_views`.
                new = _new_views(enrolled.clouds, enrolled.surface, gallery.objects.get(name) if extend else None)
                if 0 < len(new) < len(enrolled.clouds):
                    enrolled = embedded_object(self.embedding, new, enrolled.source, enrolled.surface)
                if new:
                    gallery = gallery.with_object(name, enrolled, extend=extend, replace=replace)
            return gallery

        self._change(change)

    def forget(self, name: str) -> None:
        """Remove the views of an object; a trained class is no longer predicted.

        Raises:
            InputError: no object has this name.
            OSError: the gallery cannot be written; it is unchanged.
        """
        if self.directory is not None and store.gallery_stamp(self.directory) is None:
            self.gallery.without(name)  # raises for an unknown name before a gallery is created on disk
        self._change(lambda gallery: gallery.without(name))

    def undo(self, generation: int) -> None:
        """Undo the last change of a gallery on disk; `generation` is the gallery's generation after that change.

        Raises:
            InputError: the gallery is in memory; also as `store.previous_gallery`.
            OSError: the gallery cannot be written; it is unchanged.
        """
        if self.directory is None:
            raise InputError("undo needs a gallery on disk; open one")
        self._change(functools.partial(store.previous_gallery, self.directory, generation))
