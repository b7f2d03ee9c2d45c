"""The enrolled objects of a recognizer: a gallery that can be taught, in memory or on disk, with its embedding."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from thor2_jax.errors import InputError
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery import store
from thor2_jax.gallery.embedding import Embedding, load_default
from thor2_jax.gallery.enrollment import embed_views, enrolled_views
from thor2_jax.gallery.gallery import CompactClouds, Gallery, GalleryObject
from thor2_jax.gallery.union import ClassUnion
from thor2_jax.printable import check_name, find_name

__all__ = ["ObjectGallery"]

FEW = 10
"""With fewer views of an object, or without a background and with fewer objects, most unknown objects are named."""


class ObjectGallery:
    """Enrolled objects beside the trained classes of a run.

    Each change is one immutable gallery in place of another, so that another thread reads the one or the other. A
    shallow copy shares the gallery, and neither sees what is changed through the other one before it is refreshed.

    Attributes:
        gallery: the gallery.
        directory: directory of the gallery; None if it is in memory. `open` sets it.
        lock_seconds: time that a change waits for another process that writes to the gallery.
    """

    def __init__(self, trained: tuple[str, ...], embedding: Embedding | None = None, search: str = "exact") -> None:
        """Begin with an empty gallery in memory.

        Args:
            trained: class names of the run.
            embedding: embedding of the views; by default the packaged one.
            search: "exact" or "usearch", see `Gallery`.

        Raises:
            InputError: `search` is unknown.
        """
        self._trained = trained
        self._search = search
        self._embedding = embedding
        self.directory: Path | None = None
        self.gallery = Gallery("", search=search)
        self.lock_seconds = store.LOCK_SECONDS

    def open(self, directory: Path, *, reembed: bool = False) -> None:
        """Read the gallery in a directory, which may not exist yet, and write all later changes to it.

        Args:
            directory: directory of the gallery.
            reembed: embed all views again, with the embedding of this run, whatever they were embedded by; and rebuild
                an index that was lost.

        Raises:
            InputError: see `refresh`.
            OSError: the gallery cannot be written; it is as before.
        """
        self.directory, self.gallery = directory, dataclasses.replace(self.gallery, stamp=None)
        if reembed and directory.exists():
            embed = functools.partial(embed_views, self.embedding)
            self._change(lambda gallery: gallery.reembed(self.embedding.fingerprint, embed), rebuild=True)
        else:
            store.check_index(directory)
            self.refresh()

    @property
    def embedding(self) -> Embedding:
        """The embedding of the views; the packaged one is read when it is first needed."""
        if self._embedding is None:
            self._embedding = load_default()
        return self._embedding

    @property
    def union(self) -> ClassUnion:
        """The trained classes and the objects of the gallery."""
        return ClassUnion(self._trained, self.gallery.names, self.gallery.hidden)

    @property
    def weak_rejection(self) -> str:
        """Why unknown objects are hardly rejected, and what helps, in words; empty if they are not."""
        objects, references = self.gallery.objects.values(), self.gallery.references
        few = sum(len(views.clouds) < FEW for views in objects)
        if few:
            return f"{few} of {len(objects)} enrolled objects have fewer than {FEW} views; add some from other sides"
        if objects and references is None and not self._trained and len(objects) < FEW:
            return f"{len(objects)} objects are enrolled in a run without background views; enroll more of them"
        return ""

    def refresh(self) -> bool:
        """Read the gallery again if it has changed on disk, and return whether it has.

        Raises:
            InputError: it cannot be read, or has another embedding; the gallery in memory stays.
        """
        if self.directory is None or store.gallery_stamp(self.directory) == self.gallery.stamp:
            return False
        self._set(store.load_gallery(self.directory, self.embedding.fingerprint, self.gallery))
        return True

    def _change(self, change: Callable[[Gallery], Gallery], rebuild: bool = False) -> None:
        if self.directory is None:
            self._set(change(self.gallery))
        else:
            embedding = None if rebuild else self.embedding.fingerprint
            self._set(store.update_gallery(self.directory, change, embedding, self.gallery, self.lock_seconds, rebuild))

    def _set(self, gallery: Gallery) -> None:
        """Keep a gallery, with what the embedding and the options add to it; references only once it has objects."""
        references, version = self.embedding.references if gallery.objects else None, self.embedding.sizes.version
        self.gallery = dataclasses.replace(gallery, search=self._search, references=references, version=version)

    def check(self, name: str, *, extend: bool = False, replace: bool = False) -> str:
        """Return the name under which `enroll` would enroll an object, before its views are rendered or embedded.

        Raises:
            InputError: `enroll` would refuse it.
        """
        name = self._found(self.gallery, name) or check_name(name)
        none = GalleryObject(np.zeros((0, self.embedding.size), np.float16), CompactClouds.of([]), "", "")
        self._with_objects(self.gallery, {name: none}, extend, replace)
        return name

    def _found(self, gallery: Gallery, name: str) -> str | None:
        return find_name(name, (*gallery.objects, *self._trained))

    def _with_objects(
        self, gallery: Gallery, objects: Mapping[str, GalleryObject], extend: bool, replace: bool
    ) -> Gallery:
        for given, views in objects.items():
            name = self._found(gallery, given) or check_name(given)
            gallery = gallery.with_object(name, views, extend=extend, replace=replace)
            if name in self._trained and name not in gallery.hidden:
                if replace:
                    gallery = dataclasses.replace(gallery, hidden=(*gallery.hidden, name))
                elif not extend:
                    raise InputError(
                        f"name: {name!r} is a trained class; add views to it (extend) or replace it (replace)"
                    )
        return gallery

    def enroll(
        self, name: str, views: Sequence[PreparedInstance], source: str, *, extend: bool = False, replace: bool = False
    ) -> None:
        """Enroll an object from prepared views.

        Args:
            name: name of the object.
            views: its views.
            source: "mesh" for views that are rendered from a mesh, or "frames".
            extend: add the views to those of an object with this name.
            replace: discard the views, and the output of the classifiers, of an object with this name.

        Raises:
            InputError: a view cannot be used, or the name exists and neither `extend` nor `replace` is given. Nothing
                is enrolled.
            OSError: the gallery cannot be written; it is as before.
        """
        name = self.check(name, extend=extend, replace=replace)
        self.add({name: enrolled_views(self.embedding, views, source)}, extend=extend, replace=replace)

    def add(self, objects: Mapping[str, GalleryObject], *, extend: bool = False, replace: bool = False) -> None:
        """Add embedded objects in one change; the arguments and errors are those of `enroll`."""
        self._change(lambda gallery: self._with_objects(gallery, objects, extend, replace))

    def forget(self, name: str) -> None:
        """Remove the views of an object, and never answer its trained class again.

        Raises:
            InputError: no object has this name.
            OSError: the gallery cannot be written; it is as before.
        """

        def change(gallery: Gallery) -> Gallery:
            known = self._found(gallery, name) or name
            return gallery.without(known, hide=known in self._trained and known not in gallery.hidden)

        if self.directory is not None and store.gallery_stamp(self.directory) is None:
            change(self.gallery)  # a name that is refused leaves nothing behind
        self._change(change)

    def undo(self, generation: int) -> None:
        """Take back the last change of a gallery on disk; `generation` is the one after that change.

        Raises:
            InputError: the gallery is in memory, or as `store.previous_gallery`.
            OSError: the gallery cannot be written; it is as before.
        """
        if self.directory is None:
            raise InputError("undo needs a gallery on disk; open one")
        self._change(functools.partial(store.previous_gallery, self.directory, generation))
