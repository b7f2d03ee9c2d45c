"""Enroll objects in the gallery of a run directory.

enroll_objects(Path("run"), {"mug": Path("mug.glb")})
enroll_objects(Path("run"), FrameFolder("labelled-frames"))
"""

import contextlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from thor2_jax import InputError, Recognizer
from thor2_jax.files import atomic_directory
from thor2_jax.gallery.enrollment import ObjectGallery, embedded_object
from thor2_jax.gallery.gallery import GalleryObject
from thor2_jax.gallery.store import GALLERY_DIRECTORY, check_open_to_changes
from thor2_jax.model.run_directory import TrainedRun, save_run
from thor2_jax.printable import first_names
from training.objects.meshes import load_mesh
from training.objects.surfaces import surfaces_of
from training.readers.frames import FrameFolder
from training.storage.jobs import Progress
from training.storage.workers import IN_PROCESS, WorkerPool
from training.views import mesh_views
from training.views.labelled_views import read_instances

__all__ = ["enroll_objects"]


def enroll_objects(
    model: Path,
    source: FrameFolder | Mapping[str, Path],
    *,
    name: str | None = None,
    label_name: str | None = None,
    instance: int | None = None,
    extend: bool = False,
    replace: bool = False,
    gallery: Path | None = None,
    mesh_scale: float = 1.0,
    pool: WorkerPool = IN_PROCESS,
    progress: Progress = lambda stage, done, total, note: None,
) -> tuple[dict[str, int], ObjectGallery, Sequence[str]]:
    """Enroll objects in the gallery of a run directory, all or none; a missing run directory is created.

    Args:
        model: the run directory.
        source: labelled frames, or the meshes of objects by name.
        name: the only object to enroll; its name is checked before anything is read. None enrolls all objects.
        label_name: name of this object in the frames; by default `name`.
        instance: number of this object in the frames, see `read_instances`.
        extend: add the views to existing objects; those that an object has already are left out.
        replace: replace the views of existing objects.
        gallery: directory of the gallery, for an existing run directory; by default `gallery` in the run directory.
        mesh_scale: factor that converts the unit of the meshes to metres.
        pool: worker processes that render the meshes.
        progress: called with ("enroll", objects done, number of objects, name).

    Returns:
        Object -> number of its views in the gallery; the gallery; notes on views that are left out, and on new names
        with `extend`.

    Raises:
        InputError: the run directory cannot be read, the gallery cannot be written, a view cannot be used, the frames
            have no usable view (as `read_instances`), or a name exists and neither `extend` nor `replace` is given.
            Nothing is enrolled.
        OSError: a file cannot be written; the gallery is unchanged, and no run directory is created.
    """
    if not isinstance(source, FrameFolder):
        for file in source.values():
            load_mesh(file, mesh_scale)  # raises if it cannot be used
    model = model.resolve()
    is_new = _is_empty(model)
    if is_new and gallery is not None:
        raise InputError(f"gallery is {gallery}, and {model} is not a run directory; give one, or leave out gallery")
    added: dict[str, GalleryObject] = {}
    notes: list[str] = []
    with contextlib.ExitStack() as stack:
        run = stack.enter_context(atomic_directory(model)) if is_new else model
        if is_new:
            embedding = ObjectGallery(()).embedding
            save_run(TrainedRun(embedding.config, embedding.network, (), {}, {}), run)
        recognizer = Recognizer.load(run, gallery=gallery)
        objects = recognizer.objects
        check_open_to_changes(gallery or run / GALLERY_DIRECTORY)
        if name is not None:
            objects.gallery.name_to_enroll(name, extend=extend, replace=replace)
        surfaces: Iterator[Any] = itertools.repeat(None)
        if isinstance(source, FrameFolder):
            instances = read_instances(source, recognizer.run.config.sigma_s, label_name or name, instance)
            notes += [f"skipped: {reason}" for reason in instances.skipped]
            views = ([recognizer.model.corrected(view) for view in each] for each in instances.views.values())
            names, kind = [name or each for each in instances.views], "frames"
        else:
            render = partial(mesh_views.mesh_views, mesh_scale=mesh_scale, cameras=mesh_views.MESH_VIEWS)
            views = stack.enter_context(contextlib.closing(pool(render, source.values())))
            surfaces = (surfaces_of([load_mesh(file, mesh_scale)]).arrays for file in source.values())
            names, kind = list(source), "mesh"
        names = [objects.gallery.name_to_enroll(each, extend=extend, replace=replace) for each in names]
        if extend and (new_names := [each for each in names if each not in objects.gallery.answered_names]):
            notes.append(f"enrolled as new, since the model has no object with this name: {first_names(new_names)}")
        for number, each in enumerate(names):
            progress("enroll", number, len(names), each)  # before its views are rendered
            given, surface = next(views), next(surfaces)
            new = objects.new_views(each, given, surface, extend=extend)
            if len(new) < len(given):
                notes.append(f"skipped: views of {each} that are repeated or enrolled already: {len(given) - len(new)}")
            if new or not given:
                added[each] = embedded_object(objects.embedding, new, kind, surface)
        progress("enroll", len(names), len(names), "")
        if added:
            objects.add(added, extend=extend, replace=replace)
        if is_new and not _is_empty(model):
            raise InputError(f"model: {model} was created by another command meanwhile; repeat this one to add to it")
    return {each: len(objects.gallery.objects[each].clouds) for each in names}, objects, notes


def _is_empty(directory: Path) -> bool:
    """Return whether a directory is empty or does not exist."""
    return not directory.exists() or (directory.is_dir() and not any(directory.iterdir()))
