"""Helpers of several test files: untrained runs, small clouds and images, the command line, programs, HTML pages."""

import contextlib
import dataclasses
import errno
import functools
import io
import json
import os
import resource
import socket
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import pytest
from flax import nnx
from numpy.typing import NDArray
from PIL import Image
from processes import HANG

import colornet
import thor2_jax as thor2
from thor2_jax.descriptor.looks import LookDescriptors
from thor2_jax.errors import InputError
from thor2_jax.gallery.embedding import Embedding
from thor2_jax.gallery.gallery import Gallery
from thor2_jax.model.classifier import FEATURES, RunClassifiers
from thor2_jax.model.inference import infer
from thor2_jax.model.model import Model
from thor2_jax.model.run_directory import TrainedRun, input_size
from thor2_jax.networks import MLP, EmbeddingSizes
from thor2_jax.types import Cloud
from training.objects.builtin_objects import builtin_objects
from training.rendering.scenes import compose_scene
from training.rendering.view_sphere import Camera, RenderedView

Command = Callable[..., str]
"""Type of the fixtures `printed` and `refused`, which run the command line."""

Recognize = Callable[..., list[dict[str, Any]]]
"""Type of the fixture `recognize`, which recognizes frames on the command line."""

SMALL_CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=2, n_strips=5, image_size=8)
"""A descriptor that compiles quickly."""


def slow(*values: Any) -> list[Any]:
    """Return values of a test's parameter that only the slow tier takes."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def untrained_run(
    classes: Sequence[str],
    features: Sequence[str] = FEATURES,
    config: thor2.DescriptorConfig = SMALL_CONFIG,
    record: dict[str, object] | None = None,
    seed: int = 0,
) -> TrainedRun:
    """Return a run whose classifiers have random weights, other ones for each feature."""
    network = colornet.load_default()
    classifiers = {
        name: random_classifier(input_size(name, config, network.n_regions), len(classes), seed + k)
        for k, name in enumerate(features)
    }
    return TrainedRun(config, network, tuple(classes), classifiers, record or {})


@functools.cache
def _drawn(n_inputs: int, n_classes: int, seed: int) -> MLP:
    return MLP(n_inputs, n_classes, rngs=nnx.Rngs(seed))


def random_classifier(n_inputs: int, n_classes: int, seed: int) -> MLP:
    """Return a classifier with random weights."""
    classifier: MLP = nnx.clone(_drawn(n_inputs, n_classes, seed))
    return classifier


def small_embedding(seed: int = 0) -> Embedding:
    """Return an embedding with random weights, which compiles quickly."""
    return Embedding.create(SMALL_CONFIG, sizes=EmbeddingSizes(4, (16,), 8, 4), seed=seed)


def untrained_embedding_run(
    classes: Sequence[str],
    features: Sequence[str] = (),
    config: thor2.DescriptorConfig = SMALL_CONFIG,
    record: dict[str, object] | None = None,
) -> TrainedRun:
    """Return a run whose embedding, two networks with random weights, recognizes the classes; by default, it alone."""
    run = untrained_run(classes, features, config, record)
    sizes = EmbeddingSizes(cell=4, hidden=(8,), learned=4, color=2)
    first = Embedding.create(config, run.network, sizes, classes=run.classes, distractors=2)
    return dataclasses.replace(run, embedding=dataclasses.replace(first, further=(first.create_further(1),)))


class ToyDescriptors(NamedTuple):
    """Stands in for the descriptors of a frame; `content` is what the toy recognizer reads."""

    content: Any
    overflow: int = 0


class UntaughtRecognizer:
    """Base of toy recognizers, whose `probabilities` maps the content of `ToyDescriptors`; no object is enrolled."""

    unknown_below: float | None = None

    def __init__(self, classes: Sequence[str], features: Sequence[str] = ("tops",)) -> None:
        network = SimpleNamespace(fingerprint="")
        classifiers = dict.fromkeys(features)
        self.run: Any = SimpleNamespace(
            classes=tuple(classes), classifiers=classifiers, config=None, network=network, record={}
        )

    @property
    def model(self) -> Model:
        classifiers = {
            name: lambda oriented, name=name: self.probabilities(oriented.content)[name]
            for name in self.run.classifiers
        }
        return Model(self.run, RunClassifiers(classifiers), Gallery("", trained=self.run.classes), self.unknown_below)

    def describe(self, frame: thor2.RGBDFrame) -> Any:
        instances = [
            SimpleNamespace(label=label, reason=self.reason(label, frame), occluded=False) for label in frame.instances
        ]
        usable = [instance for instance in instances if instance.reason is None]
        return SimpleNamespace(instances=instances, usable=usable, oriented=ToyDescriptors(usable))

    def reason(self, label: int, frame: thor2.RGBDFrame) -> str | None:
        """Return why an instance cannot be used."""
        return None

    def probabilities(self, content: Any) -> dict[str, np.ndarray]:
        raise NotImplementedError


class NamesInOrder(UntaughtRecognizer):
    """Predicts the first class for the first usable instance of a frame and the second for all others."""

    def __init__(self, classes: Sequence[str] = ("mug", "bowl")) -> None:
        super().__init__(classes)

    def probabilities(self, usable: Sequence[Any]) -> dict[str, np.ndarray]:
        return {"tops": np.array([[0.9, 0.1] if k == 0 else [0.2, 0.8] for k in range(len(usable))]).reshape(-1, 2)}


def aligned_cloud(
    seed: int, n: int, size: tuple[float, float, float] = (0.76, 0.4, 0.68)
) -> tuple[np.ndarray, np.ndarray]:
    """Return random points in the first octant, none within 1e-5 of a border of slices or strips, and colours."""
    rng = np.random.default_rng(seed)
    points = (rng.random((n, 3)) * size).astype(np.float32)
    for axis, width in ((0, 0.025), (2, 0.1)):
        border = np.round(points[:, axis] / width) * width
        points[np.abs(points[:, axis] - border) < 1e-5, axis] += np.float32(1e-3)
    return points, rng.integers(0, 256, (n, 3), dtype=np.uint8)


DEGENERATE = {
    "nothing": np.zeros((0, 3)),
    "one point": np.array([[0.1, 0.2, 0.9]]),
    "two points": np.array([[0.1, 0.2, 0.9], [0.2, 0.2, 0.8]]),
    "all equal": np.full((101, 3), 0.7),
    "line": np.linspace(0, 0.2, 101)[:, None] * [1.0, 2.0, -1.0] + 0.5,
    "plane": np.random.default_rng(0).random((101, 2)) @ [[0.1, 0, 0.1], [0, 0.1, 0]] + 0.5,
    "cube": np.stack(np.meshgrid(*[[-0.1, 0.0, 0.1]] * 3), axis=-1).reshape(-1, 3),
}
"""Points of clouds whose frame is ambiguous."""


def random_clouds(
    seed: int, sizes: Iterable[int], extent: Sequence[float] = (0.2, 0.1, 0.05), color: object = None
) -> list[Cloud]:
    """Return boxes of random points, half a metre before the camera, in random colours or all in one colour."""
    rng = np.random.default_rng(seed)
    return [
        (
            (rng.random((n, 3)) * extent + [0, 0, 0.5]).astype(np.float32),
            rng.integers(0, 256, (n, 3), np.uint8) if color is None else np.full((n, 3), color, np.uint8),
        )
        for n in sizes
    ]


def brick_and_stick(views: int, seed: int = 0) -> dict[str, list[Cloud]]:
    """Return views of two objects that differ in shape and colour."""
    return {
        "red brick": random_clouds(seed, [200] * views, (0.1, 0.05, 0.03), 0),
        "stick": random_clouds(seed + 1, [200] * views, (0.2, 0.01, 0.01), 255),
    }


def as_8_bit(colors: np.ndarray) -> np.ndarray:
    """Round colours in [0, 1], float32, to the nearest of 256 levels, halves up."""
    return np.floor(colors * np.float32(255) + np.float32(0.5)).astype(np.uint8)


def encode_image(pixels: np.ndarray, kind: str = "PNG", **options: object) -> bytes:
    """Return an image file's bytes."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, kind, **options)
    return stream.getvalue()


def png_file(chunks: Sequence[tuple[bytes, bytes, int]]) -> bytes:
    """Return a PNG file of chunks (kind, content, checksum), which may be invalid."""
    packed = (struct.pack(">I", len(content)) + kind + content + struct.pack(">I", c) for kind, content, c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def with_checksums(*chunks: tuple[bytes, bytes]) -> list[tuple[bytes, bytes, int]]:
    """Return PNG chunks (kind, content) with their correct checksums."""
    return [(kind, content, zlib.crc32(kind + content)) for kind, content in chunks]


def deep_png(height: int, width: int) -> bytes:
    """Return a PNG of 16 bits per channel, which Pillow cannot write: an RGB image of zeros."""
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    rows = zlib.compress(bytes(1 + 6 * width) * height)
    return png_file(with_checksums((b"IHDR", header), (b"IDAT", rows), (b"IEND", b"")))


def run_thor2(*arguments: object) -> int:
    """Run the command line in this process and return its exit status."""
    from training import cli

    with mock.patch.object(sys, "argv", ["thor2", *map(str, arguments)]):
        try:
            cli.main()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


@contextlib.contextmanager
def input_error(*words: object, match: str | None = None) -> Iterator[None]:
    """Expect an InputError whose message matches a pattern and contains some words."""
    with pytest.raises(InputError, match=match) as caught:
        yield
    assert [word for word in words if str(word) not in str(caught.value)] == [], caught.value


def assert_refused(match: str, call: Callable[..., object], /, *arguments: Any, **options: Any) -> None:
    """Assert that a call raises an InputError whose message matches a pattern."""
    with pytest.raises(InputError, match=match):
        call(*arguments, **options)


class Pickled:
    """Ends the process that unpickles it, with an exception that readers do not catch."""

    def __reduce__(self) -> tuple[Any, ...]:
        return sys.exit, ("an object was unpickled",)


class Interrupted(BaseException):
    """Like KeyboardInterrupt, not an Exception."""


def stop_when(stage: str, step: int) -> Callable[[str, int, int, str], None]:
    """Return a display of progress that interrupts a training at a step of a stage."""

    def progress(now: str, done: int, total: int, note: str) -> None:
        if (now, done) == (stage, step):
            raise Interrupted

    return progress


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files of a folder but locks, by relative paths."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def full_disk(*_: Any, **__: Any) -> None:
    """Fail as a function that writes does on a full disk."""
    raise OSError(errno.ENOSPC, "No space left on device", "/tmp/secret")


@contextlib.contextmanager
def small_disk(size: int) -> Iterator[None]:
    """Limit the size of the files that this process writes, in bytes: a larger one is an OSError."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def json_lines(text: str) -> list[dict[str, Any]]:
    """Return the values of a JSON Lines text."""
    return [json.loads(line) for line in text.splitlines()]


def free_port() -> int:
    """Return a TCP port that no process listens on."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return int(free.getsockname()[1])


def start_program(code: str, *arguments: object, devices: int = 1) -> subprocess.Popen[str]:
    """Start a Python program on the CPU, which JAX divides into some devices."""
    environment = os.environ | {
        "PYTHONPATH": str(Path(__file__).parents[1]),
        "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}",
        "JAX_PLATFORMS": "cpu",
    }
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish_programs(*processes: subprocess.Popen[str]) -> list[str]:
    """Wait for programs, assert that none failed, and return what each wrote to standard output."""
    outputs = []
    try:
        for process in processes:
            out, err = process.communicate(timeout=HANG)
            assert process.returncode == 0, err[-3000:]
            outputs.append(out)
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    return outputs


class ParsedPage(HTMLParser):
    """An HTML page: its texts, attributes of its pictures, its tags, and tags that are open at the end."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.text: list[str] = []
        self.pictures: list[dict[str, str | None]] = []
        self.tags: set[str] = set()
        self.open: list[str] = []
        self.feed(content)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag == "img":
            self.pictures.append(dict(attrs))
        elif tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def full_image(view: RenderedView, camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Return the uncropped image of a view: color [H, W, 3] uint8 and depth [H, W] uint16; `camera` rendered it."""
    rows, columns = (slice(c, c + n) for c, n in zip(view.corner, view.depth.shape, strict=True))
    color = np.zeros((camera.height, camera.width, 3), np.uint8)
    depth = np.zeros((camera.height, camera.width), np.uint16)
    color[rows, columns], depth[rows, columns] = view.color, view.depth
    return color, depth


def assert_same_answers(
    answers: Iterable[thor2.Recognition], expected: Iterable[thor2.Recognition], tolerance: float
) -> None:
    """Assert that answers are equal, up to a tolerance of the confidences."""
    for one, other in zip(answers, expected, strict=True):
        assert (one.label, one.name, one.classifier) == (other.label, other.name, other.classifier)
        assert (one.reason, one.points_used) == (other.reason, other.points_used)
        assert one.confidence == pytest.approx(other.confidence, abs=tolerance) and one.top.keys() == other.top.keys()


def write_frame_files(folder: Path, frame: thor2.RGBDFrame, names: Mapping[int, str] | None = None) -> Path:
    """Write a frame as `FrameFolder` reads it: its mask if it has labels, and labels.json if names are given."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "color.png").write_bytes(encode_image(frame.color))
    (folder / "depth.png").write_bytes(encode_image(frame.depth.astype(np.uint16)))
    if frame.labels is not None:
        (folder / "mask.png").write_bytes(encode_image(frame.labels.astype(np.uint8)))
    k = frame.intrinsics
    (folder / "intrinsics.json").write_text(json.dumps({"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy}))
    if names is not None:
        (folder / "labels.json").write_text(json.dumps({"labels": {str(label): name for label, name in names.items()}}))
    return folder


def write_scene(folder: Path, names: Sequence[str], seed: int) -> Path:
    """Write a labelled frame of built-in objects on a table."""
    objects = builtin_objects()
    scene = compose_scene({name: objects[name] for name in names}, np.random.default_rng(seed), n_objects=len(names))
    return write_frame_files(folder, scene.frame, scene.truth)


def small_frame(seed: int = 0) -> thor2.RGBDFrame:
    """Return a frame of 120 x 90 pixels with the instances 1 and 4, in random colours."""
    rng = np.random.default_rng(seed)
    labels = np.zeros((90, 120), np.uint8)
    labels[10:50, 10:50], labels[30:80, 60:110] = 1, 4
    depth = np.full(labels.shape, 900, np.uint16)
    depth[labels > 0] = 700 + rng.integers(0, 30, (labels > 0).sum())
    color = rng.integers(0, 256, (90, 120, 3), dtype=np.uint8)
    return thor2.RGBDFrame(color, depth, labels, thor2.Intrinsics(120.0, 120.0, 60.0, 45.0))


def patches() -> NDArray[np.uint8]:
    """Return label images of three usable instances and one that is too small."""
    labels = np.zeros((240, 320), np.uint8)
    labels[20:100, 20:90] = 3
    labels[200:203, 10:13] = 5
    labels[20:60, 150:250] = 7
    labels[120:220, 100:150] = 200
    return labels


def tilted(labels: np.ndarray, seed: int = 0, nearest: int = 600) -> thor2.RGBDFrame:
    """Return a frame of a tilted plane with random colours; depth grows to the right."""
    depth = np.broadcast_to(nearest + np.arange(320) // 2, (240, 320)).astype(np.uint16)
    color = np.random.default_rng(seed).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    return thor2.RGBDFrame(color, depth, labels, thor2.Intrinsics(600.0, 600.0, 159.5, 119.5))


FRAME_COLORS = {"brick": (220, 30, 30), "book": (30, 40, 220), "leaf": (60, 200, 60)}


def write_frame(directory: Path, objects: dict[int, str], seed: int = 0) -> Path:
    """Write a labelled frame with a rectangle for each object; each name has its colour and size."""
    rng = np.random.default_rng(seed)
    color = rng.integers(100, 120, (240, 320, 3), np.uint8)
    mask = np.zeros((240, 320), np.uint8)
    for place, (label, name) in enumerate(objects.items()):
        window = slice(30, 140 if name == "brick" else 90), slice(20 + 100 * place, 100 + 100 * place)
        mask[window] = label
        color[window] = np.clip(np.array(FRAME_COLORS[name]) + rng.integers(-9, 10, (*mask[window].shape, 3)), 0, 255)
    return write_frame_files(directory, dataclasses.replace(tilted(mask), color=color), objects)


def frame_options(folder: Path, **changes: object) -> list[object]:
    """Return the options of `thor2 recognize` that name the files of a frame, with some changed."""
    files = {
        "color": folder / "color.png",
        "depth": folder / "depth.png",
        "labels": folder / "mask.png",
        "intrinsics": folder / "intrinsics.json",
    }
    return [part for name, value in {**files, **changes}.items() for part in (f"--{name}", value)]


def class_probabilities(
    recognizer: thor2.Recognizer, oriented: LookDescriptors, classifiers: Sequence[str] | None = None
) -> dict[str, NDArray[np.float32]]:
    """Return classifier -> class probabilities [B, C], of all classifiers or of those named."""
    names = tuple(recognizer.model.classifiers) if classifiers is None else classifiers
    computed = infer(recognizer.model, oriented, classifiers=names).probabilities
    return {name: np.asarray(values) for name, values in computed.items()}


def write_box(path: Path, sides: Sequence[float], color: Sequence[int] = (200, 100, 50)) -> Path:
    """Write a mesh of a box of one colour."""
    import trimesh

    box = trimesh.creation.box(sides)
    box.visual.vertex_colors = [[*color, 255]] * len(box.vertices)
    path.parent.mkdir(parents=True, exist_ok=True)
    box.export(path)
    return path


def write_meshes(directory: Path, names: Sequence[str]) -> Path:
    """Write built-in objects to PLY files with vertex colours."""
    import trimesh

    directory.mkdir(exist_ok=True)
    objects = builtin_objects()
    for name in names:
        mesh = objects[name]
        colors = mesh.colors_at(np.arange(len(mesh.faces)), np.full((len(mesh.faces), 2), 1 / 3, np.float32))
        corners = mesh.vertices[mesh.faces].reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        plain = trimesh.Trimesh(corners, faces, vertex_colors=np.repeat(colors, 3, axis=0), process=False)
        plain.export(directory / f"{name}.ply")
    return directory
