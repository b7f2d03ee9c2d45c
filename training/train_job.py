"""The job of `thor2 train`: render or open the views, add labelled instances, train the runs and their baselines."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax

from thor2_jax.errors import InputError
from thor2_jax.files import remove_leftovers
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.model.run_record import run_directories
from thor2_jax.printable import normal_name
from training.baselines.baseline import baseline_file
from training.baselines.job import check_baselines, crop_size, train_baselines
from training.baselines.thor import types_of_views
from training.fitting.loop import wait_for_all
from training.objects.mesh import TexturedMesh
from training.objects.meshes import find_meshes, scaled_meshes
from training.protocol import DEFAULT, PAPER, Protocol
from training.readers.frames import FrameFolder, find_frames
from training.storage.jobs import Progress, add_prefix, check_same_job, numbered, of_stage
from training.storage.workers import local_workers
from training.train_run import VIEWS, check_out, check_trained, finished_record, is_finished, train_run
from training.views.dataset import ViewDataset, remove_views, render_crops, render_dataset
from training.views.labelled_views import MAX_COPIES, LabelledInstances, WithLabelledViews, read_instances
from training.views.normalized_views import ViewSource, WithoutClasses, check_classes, sequence_sources

__all__ = ["TrainJob", "run_train_job"]


@dataclasses.dataclass(frozen=True)
class TrainJob:
    """A training and its views: from `meshes` or `dataset`, from `frames`, or from both.

    Attributes:
        out: run directory; with `sequences`, the directory that contains the run directories.
        protocol: the settings of the runs and of their views.
        meshes: folder of meshes, or name -> mesh in metres (then `names` and `mesh_scale` are not used). Their views
            are rendered for this run and removed afterwards.
        dataset: directory written by `thor2 render`.
        frames: folders of labelled frames, see `FrameFolder`; their instances are used as views of their classes, too.
            A run with an embedding also enrolls those of classes without a mesh: a few views are recognized better by
            comparison with each other than by networks that were fitted on them.
        names: table of object name -> mesh in `meshes`; None uses all meshes.
        baselines: any of `BASELINES`.
        weights: folder of pretrained weights for the image networks; None trains them from scratch.
        leave_out: objects to leave out of the training.
        sequences: table of sequence -> its objects; one run is trained for each sequence.
        workers: rendering processes.
        mesh_scale: factor from the unit of the meshes to metres.
    """

    out: Path
    protocol: Protocol
    meshes: Path | Mapping[str, TexturedMesh] | None = None
    dataset: Path | None = None
    frames: Sequence[Path] = ()
    names: Path | None = None
    baselines: Sequence[str] = ()
    weights: Path | None = None
    leave_out: Sequence[str] = ()
    sequences: Path | None = None
    workers: int = 1
    mesh_scale: float = 1.0

    @property
    def crop_size(self) -> int | None:
        """Side of the crops that the baselines are trained on, pixels; None if they need none."""
        return crop_size(self.baselines, self.weights is not None) if self.baselines else None

    @property
    def stages(self) -> dict[str, float]:
        """The stages of the training of a run, see `Protocol.stages`; baselines are not included."""
        if self.meshes is None:
            return self.protocol.stages
        return {"render": 1.0} | ({"render crops": 1.0} if self.crop_size is not None else {}) | self.protocol.stages


def run_train_job(job: TrainJob, progress: Progress) -> dict[Path, list[TrainedRun]]:
    """Train all runs and baselines of the job that are not finished yet.

    Args:
        job: the job.
        progress: called with (stage, done, total, note); the stages are numbered, those of a sequence after its name.

    Returns:
        Run directory -> the runs of its folds that this call has trained; empty if they were already finished.

    Raises:
        InputError: an option is invalid, or a directory holds results of another job.
        OSError: a file cannot be written.
    """
    baselines = check_baselines(job.baselines, job.weights, job.out)
    labelled = _read_frames(job)
    if job.sequences is None and not is_finished(job.out):
        check_out(job.out)
    elif job.sequences is None and job.meshes is not None and _is_complete(job, labelled):
        return {job.out: []}
    shown = numbered(progress, job.stages)
    source, enrolled = _open_views(job, labelled, shown)
    sources = {job.out: source} if job.sequences is None else sequence_sources(source, job.sequences, job.out)
    for directory, views in sources.items():
        _check_views(job, directory, views)
    runs: dict[Path, list[TrainedRun]] = {}
    for directory, views in sources.items():
        remove_leftovers(directory)  # a process may have been killed while it removed the checkpoints
        if job.sequences is not None:
            shown = numbered(add_prefix(progress, str(directory.relative_to(job.out))), job.stages)
        runs[directory] = [] if is_finished(directory) else train_run(views, directory, job.protocol, shown, enrolled)
        if baselines and jax.process_index() == 0:
            train_baselines(directory, views, baselines, shown, weights=job.weights)
        wait_for_all("finished")  # JAX lets no process end more than five minutes before the others
    if job.meshes is not None and jax.process_index() == 0:
        remove_views(job.out / VIEWS)
    return runs


def _check_views(job: TrainJob, directory: Path, views: ViewSource) -> None:
    """Raise InputError if a run cannot be trained on views, or its directory holds results of another job."""
    _check_batch_size(job.protocol, sum(shard.views for shard in views.shards))
    if job.protocol.classifiers:
        check_classes(views)
    if not is_finished(directory):
        check_out(directory)
        if job.crop_size is not None:
            views.read_crops(0, job.crop_size)  # raises if there are none
    elif not job.baselines or job.sequences is not None:
        check_trained(views.digest, directory, job.protocol)


def _check_batch_size(protocol: Protocol, n_views: int) -> None:
    """Raise InputError if a batch is larger than all samples; default batch sizes are reduced later instead."""
    size = protocol.fit.batch_size
    n_samples = n_views * (len(protocol.mirrors) + protocol.orientation_copies)
    if size > n_samples and size not in (DEFAULT.fit.batch_size, PAPER.fit.batch_size):
        raise InputError(f"batch_size is {size}; expected at most {n_samples}, the samples of {n_views} views")


def _is_complete(job: TrainJob, labelled: LabelledInstances | None) -> bool:
    """Return whether a finished run has all that the job asks for; if so, remove leftovers of a killed process.

    With `weights`, the result is False, since the baselines may have been trained with others.

    Only views of this job are removed, since another training may read other views.

    Raises:
        InputError: the run is of another job.
    """
    record = finished_record(job.out)
    stored = record["dataset"]
    trained = {
        "seed": record["seed"],
        "leave_out": stored.get("classes_left_out", []),
        "dataset": stored.get("job"),
        "frames": stored.get("frames", {}).get("digest"),
    }
    requested = {
        "seed": job.protocol.fit.seed,
        "leave_out": sorted(set(job.leave_out)),  # compared before the dataset, whose objects depend on it
        "dataset": job.protocol.render_job(_kept_meshes(job)).record(),
        "frames": labelled.digest if labelled else None,
    }
    check_same_job(job.out, trained, requested)
    files = [baseline_file(run, name) for run in run_directories(job.out) for name in job.baselines]
    if job.weights is not None or not all(file.is_file() for file in files):
        return False
    if not job.baselines:
        check_trained(stored["digest"], job.out, job.protocol)
    remove_leftovers(job.out)
    with contextlib.suppress(InputError):
        if ViewDataset.open(job.out / VIEWS).job == stored["job"]:
            remove_views(job.out / VIEWS)
    return True


def _find_meshes(job: TrainJob) -> Mapping[str, Path | TexturedMesh]:
    return find_meshes(job.meshes, job.names) if isinstance(job.meshes, Path) else job.meshes or {}


def _kept_meshes(job: TrainJob) -> dict[str, Path | TexturedMesh]:
    """Return the meshes that are rendered, in metres; those that are left out are not read."""
    kept = {name: mesh for name, mesh in _find_meshes(job).items() if name not in job.leave_out}
    return scaled_meshes(kept, job.mesh_scale)


def _read_frames(job: TrainJob) -> LabelledInstances | None:
    """Return the instances of the labelled frames; None if the job has no frames.

    Raises:
        InputError: a frame cannot be read or has no usable instance of an object, or the job cannot use frames.
    """
    if not job.frames:
        return None
    if job.sequences is not None:
        raise InputError(
            f"sequences is {job.sequences}; expected none with frames, since the runs are trained on different objects"
        )
    if "thor" in job.baselines:
        raise InputError("baselines: thor needs the camera angles of all views, and frames have none; leave out thor")
    frames = FrameFolder(find_frames(job.frames))
    read = read_instances(frames, job.protocol.config.sigma_s, crop_size=job.crop_size)
    return dataclasses.replace(read, left_out=job.leave_out)


def _check_names(job: TrainJob, names: Sequence[str], instances: Mapping[str, Sequence[PreparedInstance]]) -> None:
    """Raise InputError before views are rendered if the classes cannot be trained.

    Args:
        job: the job.
        names: classes of the meshes or of the dataset.
        instances: class -> its instances in the frames.
    """
    known = dict.fromkeys([*names, *instances])
    if missing := sorted(set(job.leave_out) - set(known)):
        raise InputError(f"leave_out has {', '.join(map(repr, missing))}; expected some of {', '.join(known)}")
    classes = [name for name in known if name not in job.leave_out]
    if not classes:
        raise InputError(f"leave_out has {', '.join(known)}, all objects; expected at least one that is trained")
    if job.protocol.distractors is not None:
        job.protocol.distractors.check(classes)
    if len(classes) < 2 and (instances or job.protocol.classifiers):
        raise InputError(f"the objects are {classes[0]}; expected at least two; add another one")
    folded: dict[str, str] = {}
    for name in classes:
        other = folded.setdefault(normal_name(name).casefold(), name)
        if other != name:
            raise InputError(f"objects {other!r} and {name!r} differ only by case or form; expected distinct names")
    if single := [name for name in classes if name not in names and len(instances[name]) < 2]:
        raise InputError(
            f"frames: one usable instance of {', '.join(map(repr, single))}; expected at least two without a mesh: "
            "label it in another frame, or leave it out with --leave-out"
        )


def _open_views(
    job: TrainJob, labelled: LabelledInstances | None, progress: Progress
) -> tuple[ViewSource, Mapping[str, Sequence[PreparedInstance]]]:
    """Open the dataset, or render the meshes to `out`/views; add the labelled instances, and leave objects out.

    Returns:
        The views, and the labelled instances of each class without a mesh.
    """
    instances = labelled.views if labelled else {}
    source: ViewSource | None = None if job.dataset is None else ViewDataset.open(job.dataset)
    names = source.classes if source else tuple(_find_meshes(job))
    _check_names(job, names, instances)
    if "thor" in job.baselines:
        types_of_views(source.record["job"] if source else vars(job.protocol))  # raises if there are too few
    if meshes := _kept_meshes(job):
        rendering, workers, size = job.protocol.render_job(meshes), local_workers(job.workers), job.crop_size
        # Folds and batches are checked later again, since some views may have too few points.
        folds, n_rendered = job.protocol.folds, len(rendering.angles)
        for name in meshes:
            n_views = n_rendered + len(instances.get(name, ()))
            if n_views < folds:
                raise InputError(f"folds is {folds}; expected at most {n_views}, the number of views of class {name!r}")
        n_clouds = len(meshes) * n_rendered * rendering.copies + sum(map(len, instances.values())) * (1 + MAX_COPIES)
        _check_batch_size(job.protocol, n_clouds)
        source = render_dataset(rendering, job.out / VIEWS, workers, progress)
        if size is not None:
            render_crops(rendering, source, size, workers, of_stage(progress, "render crops"))
    if labelled is not None:
        source = WithLabelledViews(labelled, job.protocol.config, source)
    assert source is not None
    enrolled = {name: views for name, views in instances.items() if name not in (*names, *job.leave_out)}
    return WithoutClasses(source, job.leave_out) if job.leave_out else source, enrolled
