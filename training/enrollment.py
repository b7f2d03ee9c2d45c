"""Enrolling objects in the gallery of a run directory: from meshes, and from folders of labelled frames.

from training.views.mesh_views import mesh_views
enroll_objects(Path("run"), lambda sigma_s: (["mug"], iter([mesh_views(Path("mug.glb"))])), "mesh")
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from thor2_jax.errors import InputError, with_context
from thor2_jax.files import atomic_directory
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery.enrollment import enrolled_views, instance_view
from thor2_jax.gallery.objects import ObjectGallery
from thor2_jax.model.run_directory import TrainedRun, save_run
from thor2_jax.printable import check_name, normal_name
from thor2_jax.recognizer import Recognizer
from training.readers.frames import FrameFolder
from training.storage.jobs import Progress

__all__ = ["enroll_objects", "labelled_views"]


def labelled_views(
    frames: FrameFolder,
    sigma_s: float,
    label_name: str | None = None,
    instance: int | None = None,
    on_view: Callable[[RGBDFrame, int, str], object] = lambda frame, label, name: None,
) -> tuple[dict[str, list[PreparedInstance]], list[str]]:
    """Return object -> its views in frames, and why each of the other instances cannot be used.

    Args:
        frames: the frames.
        sigma_s: scaled units per metre, see `DescriptorConfig`.
        label_name: only the object that labels.json gives this name, and the only one of frames without names.
        instance: number of the object called `label_name`, in place of labels.json.
        on_view: called with the frame, the label and the object of each usable instance, in the order of the views.

    Raises:
        InputError: a folder or a frame cannot be read, or an object has no usable view. Instances whose name
            `check_name` refuses are skipped.
    """
    views: dict[str, list[PreparedInstance]] = {}
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
                    name = check_name(name) if label_name is None else name
                    of_object = views.setdefault(name, [])
                    of_object.append(instance_view(item.frame, label, sigma_s))
                    on_view(item.frame, of_object[-1].label, name)
            except InputError as error:
                skipped.append((name, str(error)))
    empty = [name for name, of_object in views.items() if not of_object]
    if empty:
        reason = next(reason for name, reason in skipped if name == empty[0])
        raise InputError(f"frames: {empty[0]!r} has no usable view ({reason})")
    if not views:
        if skipped:
            raise InputError(f"frames: {skipped[0][1]}")
        wanted = "an object" if label_name is None else repr(label_name)
        raise InputError(f"frames: no frame has a label for {wanted}; see labels.json, or give --instance")
    return views, [reason for _, reason in skipped]


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
            objects.gallery.name_to_enroll(name, extend=extend, replace=replace)
        given, views = read(recognizer.run.config.sigma_s)
        names = [objects.gallery.name_to_enroll(each, extend=extend, replace=replace) for each in given]
        for number, each in enumerate(names):
            progress("enroll", number, len(names), each)
            of_object = next(views)
            if source == "frames":
                of_object = [recognizer.model.corrected(view) for view in of_object]
            added[each] = enrolled_views(objects.embedding, of_object, source)
        progress("enroll", len(names), len(names), "")
        objects.add(added, extend=extend, replace=replace)
    return {each: len(objects.gallery.objects[each].clouds) for each in names}, objects
