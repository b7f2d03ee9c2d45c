"""Enrolling objects in the gallery of a run directory.

from training.views.mesh_views import mesh_views
enroll_objects(Path("run"), lambda sigma_s: (["mug"], iter([mesh_views(Path("mug.glb"))])), "mesh")
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from thor2_jax.errors import InputError
from thor2_jax.files import atomic_directory
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery.enrollment import enrolled_views
from thor2_jax.gallery.objects import ObjectGallery
from thor2_jax.model.run_directory import TrainedRun, save_run
from thor2_jax.recognizer import Recognizer
from training.storage.jobs import Progress

__all__ = ["enroll_objects"]


def enroll_objects(
    model: Path,
    read: Callable[[float], tuple[Iterable[str], Iterator[Sequence[PreparedInstance]]]],
    source: str,
    *,
    name: str | None = None,
    extend: bool = False,
    replace: bool = False,
    gallery: Path | None = None,
    progress: Progress = lambda stage, done, total, note: None,
) -> tuple[dict[str, int], ObjectGallery]:
    """Enroll objects in the gallery of a run directory, in one change; one that does not exist is created.

    Args:
        model: the run directory.
        read: function of sigma_s that returns the objects, and an iterator of their views, in the same order.
        source: "mesh" or "frames".
        name: the name that `read` will return, if there is one: it is checked before anything is read.
        extend: add the views to those of objects that exist.
        replace: discard the views of objects that exist.
        gallery: directory of the gallery, of a run directory that exists; by default `gallery` in the run directory.
        progress: called with ("enroll", objects done, number of objects, name).

    Returns:
        Object -> number of its views in the gallery, and the gallery.

    Raises:
        InputError: the run directory cannot be read, a view cannot be used, or a name exists and neither `extend` nor
            `replace` is given. Nothing is enrolled.
        OSError: a file cannot be written; the gallery is as before, and no run directory is created.
    """
    model = model.resolve()
    is_new = not model.exists() or (model.is_dir() and not any(model.iterdir()))
    if is_new and gallery is not None:
        raise InputError(f"gallery is {gallery}, and {model} is no run directory; expected one, or leave out gallery")
    added = {}
    with atomic_directory(model) if is_new else contextlib.nullcontext(model) as run:
        if is_new:
            embedding = ObjectGallery(()).embedding
            save_run(TrainedRun(embedding.config, embedding.network, (), {}, {}), run)
        recognizer = Recognizer.load(run, gallery=gallery)
        objects = recognizer.objects
        if name is not None:
            objects.check(name, extend=extend, replace=replace)
        given, views = read(recognizer.run.config.sigma_s)
        names = [objects.check(each, extend=extend, replace=replace) for each in given]
        for number, each in enumerate(names):
            progress("enroll", number, len(names), each)
            of_object = next(views)
            if source == "frames":
                of_object = [recognizer.model.corrected(view) for view in of_object]
            added[each] = enrolled_views(objects.embedding, of_object, source)
        progress("enroll", len(names), len(names), "")
        objects.add(added, extend=extend, replace=replace)
    return {each: len(objects.gallery.objects[each].clouds) for each in names}, objects
