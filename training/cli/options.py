"""Options that several commands share, single ones and groups."""

import dataclasses
import functools
import inspect
import itertools
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperCommand

from thor2_jax.errors import InputError
from thor2_jax.printable import normal_name
from thor2_jax.recordings.topics import DEFAULT_MAX_GAP, Topics
from training.cli.app import option_arguments, print_note

__all__ = [
    "AnswerByOption",
    "AllowHostOption",
    "FrameOptions",
    "GalleryOption",
    "HostOption",
    "MAX_WORKERS",
    "ManyFrames",
    "MeshScaleOption",
    "ModelOption",
    "NamesOption",
    "QuietOption",
    "RECORDING_OPTIONS",
    "SegmentOption",
    "UnknownOption",
    "WorkerOptions",
    "check_alone",
    "check_belongs",
    "find_segmenter",
    "given_values",
    "grouped_options",
    "recording_option",
    "split_names",
]

if TYPE_CHECKING:
    from thor2_jax.recordings.bags import Bag
    from thor2_jax.segmentation.segmenters import Segmenter
    from training.readers.frames import FrameSource
    from training.storage.workers import WorkerPool

UnknownOption = Annotated[
    float | None,
    typer.Option(
        help="Instances with a lower confidence are unknown objects (0 to 1). Default: the model's own threshold for "
        "trained classes; for enrolled objects, a threshold that depends on their number of views or on having a mesh.",
    ),
]
AnswerByOption = Annotated[
    str | None, typer.Option(help="classifiers, gallery or both. Default: all that the run has.")
]
ModelOption = Annotated[Path, typer.Option(help="Run directory of a trained model.")]
SegmentOption = Annotated[
    str | None,
    typer.Option(
        help="Segmenter to use instead of labels: table, model (for piles; only in recognize and explain), or that of "
        "another package.",
    ),
]
GalleryOption = Annotated[
    Path | None, typer.Option(help="Directory of the gallery. Default: gallery in the run directory.")
]
MeshScaleOption = Annotated[
    float, typer.Option(help="Factor from the unit of the meshes to metres; 0.001 for millimetres.")
]
NamesOption = Annotated[Path | None, typer.Option(help="JSON or YAML table: object name -> mesh. Default: all meshes.")]
HostOption = Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 for other machines.")]
AllowHostOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="Additional name or address of this machine in requests, such as robot.local; repeatable. localhost and "
        "the address of the connection are always allowed.",
    ),
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")]


recording_option = functools.partial(typer.Option, rich_help_panel="Recordings")
"""Option for recordings; the help lists these in a panel of their own."""


RECORDING_OPTIONS = ("bag", "color_topic", "depth_topic", "camera_topic", "max_gap", "every")
"""Names of the options of `FrameOptions` for recordings."""


def given_values(record: Any) -> dict[str, Any]:
    """Return the fields of a dataclass that differ from their defaults: the options that were given."""
    values = ((field, getattr(record, field.name)) for field in dataclasses.fields(record))
    return {field.name: value for field, value in values if value != field.default}


def check_belongs(owner: str, is_given: object, **values: object) -> None:
    """Raise InputError if an option that needs `owner` is given without it; None means that it was not given."""
    for name, value in values.items():
        if value is not None and not is_given:
            raise InputError(f"{name} is {value}; it belongs to {owner}")


def check_alone(option: str, given: object, **values: object) -> None:
    """Raise InputError if `option` is given together with an option that it excludes."""
    for name, value in values.items():
        value = ", ".join(map(str, value)) if isinstance(value, list) else value
        if value and given:
            pair = f"{name} and {option} are given" if given is True else f"{name} is {value} and {option} is {given}"
            raise InputError(f"{pair}; give one of them")


@dataclasses.dataclass(frozen=True)
class FrameOptions:
    """The frames that a command is given: folders, the files of one frame, or a recording."""

    frames: Annotated[
        list[Path] | None,
        typer.Argument(metavar="FRAME", help="Folders with color, depth, mask, intrinsics; their parents; BOP scenes."),
    ] = None
    color: Annotated[Path | None, typer.Option(help="Colour image, PNG, JPEG or TIFF, in place of FRAME.")] = None
    depth: Annotated[Path | None, typer.Option(help="Depth image: PNG, TIFF, NPY or EXR.")] = None
    labels: Annotated[Path | None, typer.Option(help="Instance labels, PNG or TIFF; 0 is background.")] = None
    intrinsics: Annotated[
        Path | None, typer.Option(help="Camera: fx, fy, cx, cy in JSON, ROS, BOP, RealSense, Open3D or a matrix.")
    ] = None
    depth_scale: Annotated[
        float | None, typer.Option(help="Depth units per metre. Default: as in the intrinsics, or 1000.")
    ] = None
    bag: Annotated[
        Path | None, recording_option(help="ROS 1 bag, ROS 2 bag or MCAP, in place of FRAME (extra bags).")
    ] = None
    color_topic: Annotated[str | None, recording_option(help="Topic of colour images. Default: the only one.")] = None
    depth_topic: Annotated[str | None, recording_option(help="Topic of depth. Default: the only (aligned) one.")] = None
    camera_topic: Annotated[str | None, recording_option(help="camera_info topic. Default: beside the images.")] = None
    max_gap: Annotated[float, recording_option(help="Largest time from colour to depth, seconds.")] = DEFAULT_MAX_GAP
    every: Annotated[int, recording_option(min=1, max=2**31 - 1, help="Take every N-th frame.")] = 1

    def arguments(self, n_frames: int = 0) -> list[str]:
        """Return the arguments that pass the same frames to another command, if there are at most three.

        Otherwise, FRAME stands for the folders, and of a recording only the first frame is passed.

        Args:
            n_frames: number of frames in the given folders or the recording, if it is known.
        """
        given = given_values(self)
        if self.bag is not None and n_frames > 3:
            given["every"] = n_frames * self.every
        frames = [f"./{path}" if str(path).startswith("-") else str(path) for path in given.pop("frames", ())]
        return [*(frames if self.bag or max(len(frames), n_frames) < 4 else ["FRAME"]), *option_arguments(**given)]

    def check(self) -> None:
        """Raise InputError unless exactly one of FRAME, files and a recording is given, with options that fit it."""
        check_alone("intrinsics", self.intrinsics, camera_topic=self.camera_topic)
        check_alone("bag", self.bag, frames=self.frames, color=self.color, depth=self.depth, labels=self.labels)
        check_belongs("--bag", self.bag, **{n: v for n, v in given_values(self).items() if n in RECORDING_OPTIONS})
        if self.bag is None and bool(self.frames) == any((self.color, self.depth, self.labels, self.intrinsics)):
            raise InputError("give either FRAME... or --color, --depth, --labels and --intrinsics; see --help")

    def sources(
        self, segment: str | None = None, model: "Segmenter | None" = None, *, masks: bool = True
    ) -> list["FrameSource"]:
        """Return the frames, without reading them yet.

        Args:
            segment: segmenter that replaces the labels of the frames; None reads the labels, and segments recordings.
            model: the segmenter "model", if the command has one.
            masks: whether the frames need labels; if not, recordings are not segmented.

        Raises:
            InputError: the options contradict each other, or a folder or a recording cannot be read.
            OSError: a recording cannot be opened.
        """
        from thor2_jax.segmentation.segmenters import TABLE
        from training.readers.frames import FrameFiles, find_frames, recorded_sources, segmented_source

        self.check()
        check_alone("segment", segment, labels=self.labels)
        if self.bag is not None:
            segment = segment or (TABLE if masks else None)
            sources, notes = recorded_sources(self.open_bag, self.every)
            for note in notes:
                print_note(f"note: {note}")
        elif self.frames:
            sources = find_frames(self.frames, self.depth_scale)
        else:
            needed = ["color", "depth", *["labels"] * (masks and segment is None), "intrinsics"]
            missing = ", ".join(f"--{name}" for name in needed if getattr(self, name) is None)
            if missing:
                instead = ", or --segment in place of labels" if "labels" in needed else ""
                raise InputError(f"{missing} is missing; one frame needs {', '.join(needed)}{instead}")
            assert self.color and self.depth and self.intrinsics
            files = FrameFiles(self.color, self.depth, self.labels, self.intrinsics)
            sources = [files.source(self.color.stem, self.depth_scale)]
        if segment is None:
            return sources
        segmenter = find_segmenter(segment, model)
        return [segmented_source(source, segmenter) for source in sources]

    def open_bag(self) -> "Bag":
        """Return the recording, without opening it yet."""
        from thor2_jax.frames.intrinsics import read_intrinsics
        from thor2_jax.recordings.bags import Bag

        assert self.bag is not None
        topics = Topics(self.color_topic, self.depth_topic, self.camera_topic)
        intrinsics = None if self.intrinsics is None else read_intrinsics(self.intrinsics)
        return Bag(self.bag, topics, intrinsics=intrinsics, depth_scale=self.depth_scale, max_gap=self.max_gap)


def find_segmenter(name: str, model: "Segmenter | None" = None) -> "Segmenter":
    """Return the segmenter with this name; `model` is the segmenter "model", if the command has one."""
    from thor2_jax.segmentation.segmenters import MODEL, TABLE, load_segmenter

    if model is None or name != MODEL:
        return load_segmenter(name, () if model is None else (MODEL,))
    load_segmenter(TABLE)  # "model" starts from its segments; this raises if its package is missing
    return model


def grouped_options(command: Callable[..., None], without: Collection[str] = ()) -> Callable[..., None]:
    """Decorate a command: replace parameters that are dataclasses of options (`FrameOptions`) by their fields.

    The command has no options for the fields `without`, which keep their defaults.
    """
    own = inspect.signature(command).parameters.values()
    groups: dict[str, Any] = {one.name: one.annotation for one in own if dataclasses.is_dataclass(one.annotation)}
    options = {name: inspect.signature(group).parameters for name, group in groups.items()}
    fields = {name: {each: p[each] for each in p if each not in without} for name, p in options.items()}
    expanded = [each for one in own for each in (fields[one.name].values() if one.name in fields else (one,))]

    @functools.wraps(command)
    def with_groups(**values: Any) -> None:
        made = {name: group(**{each: values.pop(each) for each in fields[name]}) for name, group in groups.items()}
        command(**made, **values)

    parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in expanded]
    with_groups.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return with_groups


class ManyFrames(TyperCommand):
    """A command whose option --frames takes all values up to the next option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments after repeating --frames before each further value that follows it."""
        expanded: list[str] = []
        taking = False
        for previous, argument in itertools.pairwise(["", *args]):
            if argument.startswith("-") and argument != "-":
                taking = argument == "--frames"
            elif taking and previous != "--frames":
                expanded.append("--frames")
            expanded.append(argument)
        return super().parse_args(ctx, expanded)


def split_names(names: str) -> list[str]:
    """Return the entries of a comma-separated option."""
    return [normal_name(name) for name in names.split(",")] if names else []


MAX_WORKERS = 1024
"""Largest number of processes of a command; each process needs memory and open files."""

WorkersOption = Annotated[
    int, typer.Option(min=1, max=MAX_WORKERS, help="Worker processes; with Ray, concurrent tasks.")
]


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorkerOptions:
    """Options that choose where a command computes: in this process, in worker processes or on a Ray cluster."""

    workers: WorkersOption = 1
    engine: Annotated[
        Literal["local", "ray"],
        typer.Option(help="Compute on this machine, or on a Ray cluster (extra `cluster`) that has the same paths."),
    ] = "local"
    address: Annotated[
        str | None, typer.Option(help="Address of the Ray cluster. Default: the cluster on this machine.")
    ] = None

    def pool(self) -> "WorkerPool | None":
        """Return the worker pool of these options; None means this process alone.

        Raises:
            InputError: `address` is given without Ray, or Ray is not installed.
        """
        from training.storage.workers import local_workers, ray_workers

        if self.engine == "ray":
            return ray_workers(self.workers, self.address)
        if self.address is not None:
            raise InputError(f"address is {self.address}; it is only used with --engine ray")
        return local_workers(self.workers) if self.workers > 1 else None


@dataclasses.dataclass(frozen=True, kw_only=True)
class RenderWorkers(WorkerOptions):
    """Options that choose where views are rendered; by default, in two processes."""

    workers: WorkersOption = 2
