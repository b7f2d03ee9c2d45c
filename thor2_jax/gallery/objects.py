"""The enrolled objects of a recognizer: a gallery that can be taught, in memory or on disk, with its embedding."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from thor2_jax.errors import InputError
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery import store
from thor2_jax.gallery.embedding import Embedding, load_default
from thor2_jax.gallery.enrollment import embed_views, enrolled_views
from thor2_jax.gallery.gallery import Gallery, GalleryObject

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
        self._embedding = embedding
        self.directory: Path | None = None
        self.gallery = Gallery("", trained=trained, search=search)
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
    def weak_rejection(self) -> str:
        """Why unknown objects are hardly rejected, and what helps, in words; empty if they are not."""
        objects, references = self.gallery.objects.values(), self.gallery.references
        few = sum(len(views.clouds) < FEW for views in objects)
        if few:
            return f"{few} of {len(objects)} enrolled objects have fewer than {FEW} views; add some from other sides"
        if objects and references is None and not self.gallery.trained and len(objects) < FEW:
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
            return
        trained, embedding = self.gallery.trained, None if rebuild else self.embedding.fingerprint

        def change_stored(stored: Gallery) -> Gallery:
            return change(dataclasses.replace(stored, trained=trained))

        self._set(
            store.update_gallery(self.directory, change_stored, embedding, self.gallery, self.lock_seconds, rebuild)
        )

    def _set(self, gallery: Gallery) -> None:
        """Keep a gallery, with what the run and the options add to it; references only once it has objects."""
        self.gallery = dataclasses.replace(
            gallery,
            trained=self.gallery.trained,
            search=self.gallery.search,
            references=self.embedding.references if gallery.objects else None,
            version=self.embedding.sizes.version,
        )

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
        name = self.gallery.name_to_enroll(name, extend=extend, replace=replace)
        self.add({name: enrolled_views(self.embedding, views, source)}, extend=extend, replace=replace)

    def add(self, objects: Mapping[str, GalleryObject], *, extend: bool = False, replace: bool = False) -> None:
        """Add embedded objects in one change; the arguments and errors are those of `enroll`."""

        def change(gallery: Gallery) -> Gallery:
            for name, views in objects.items():
                gallery = gallery.with_object(name, views, extend=extend, replace=replace)
            return gallery

        self._change(change)

    def forget(self, name: str) -> None:
        """Remove the views of an object, and never answer its trained class again.

        Raises:
            InputError: no object has this name.
            OSError: the gallery cannot be written; it is as before.
        """
        if self.directory is not None and store.gallery_stamp(self.directory) is None:
            self.gallery.without(name)  # a name that is refused leaves nothing behind
        self._change(lambda gallery: gallery.without(name))

    def undo(self, generation: int) -> None:
        """Take back the last change of a gallery on disk; `generation` is the one after that change.

        Raises:
            InputError: the gallery is in memory, or as `store.previous_gallery`.
            OSError: the gallery cannot be written; it is as before.
        """
        if self.directory is None:
            raise InputError("undo needs a gallery on disk; open one")
        self._change(functools.partial(store.previous_gallery, self.directory, generation))
