"""Benchmark of `thor2 doctor`: fraction of damaged set-ups diagnosed correctly, and of sound frames without findings.

    python -m benchmarks.doctor --data ../shared/data --model run --out benchmarks/results/doctor.json

Each of 20 kinds of damage is applied to each of several sound frames. A diagnosis is right if one of the findings has
an expected code. Sound frames should have no findings.
"""

import argparse
import dataclasses
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from thor2_jax.capacity import BATCH_BUCKETS
from thor2_jax.files import write_text
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.recognizer import Recognizer
from training.diagnosis.setup import diagnose
from training.readers.frames import FrameFiles, find_frames

BASES = (
    "frames/ycbv_posecnn_demo/000001",
    "frames/ycbv_posecnn_demo/000005",
    "frames/ycbv_real_0000/000001",
    "frames/ycbv_real_0001/000001",
)
"""Frames to damage; their objects must be classes of the model."""


@dataclasses.dataclass
class SetUp:
    """The contents of the files of a frame, to which damage is applied.

    Attributes:
        color: [H, W, 3] uint8.
        depth: [H, W], integers in depth units or floats in metres.
        labels: [H, W] or [H, W, 3].
        intrinsics: values of the file.
        mesh_side: longest side of the mesh, in its unit.
    """

    color: np.ndarray
    depth: np.ndarray
    labels: np.ndarray
    intrinsics: dict[str, Any]
    mesh_side: float = 0.15

    @classmethod
    def of(cls, frame: RGBDFrame) -> "SetUp":
        """Return the files of a frame."""
        camera = frame.intrinsics
        values = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "depth_scale")}
        return cls(frame.color.copy(), frame.depth.copy(), frame.label_image.copy(), values)

    def write(self, folder: Path) -> tuple[FrameFiles, Path]:
        """Write the files; return them and the mesh."""
        Image.fromarray(self.color).save(folder / "color.png")
        depth = folder / ("depth.npy" if self.depth.dtype.kind == "f" else "depth.png")
        if depth.suffix == ".npy":
            np.save(depth, self.depth)
        else:
            Image.fromarray(self.depth).save(depth)
        Image.fromarray(self.labels).save(folder / "mask.png")
        (folder / "intrinsics.json").write_text(json.dumps(self.intrinsics))
        mesh = trimesh.creation.box([self.mesh_side, self.mesh_side / 2, self.mesh_side / 2])
        mesh.visual.vertex_colors = [9, 9, 9, 255]
        mesh.export(folder / "mesh.ply")
        files = FrameFiles(folder / "color.png", depth, folder / "mask.png", folder / "intrinsics.json")
        return files, folder / "mesh.ply"


def _scale_camera(setup: SetUp, factor: float) -> None:
    for name in ("fx", "fy", "cx", "cy"):
        setup.intrinsics[name] *= factor


def _set(**values: Any) -> Callable[[SetUp], None]:
    return lambda setup: setup.intrinsics.update(values)


def _change(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[SetUp], None]:
    return lambda setup: setattr(setup, name, np.ascontiguousarray(change(getattr(setup, name))))


def _scale_depth(factor: float) -> Callable[[SetUp], None]:
    return _change("depth", lambda depth: np.clip(np.rint(depth * factor), 0, 65535).astype(np.uint16))


def _moved(columns: int, rows: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda image: np.roll(image, (rows, columns), axis=(0, 1))


def _zoomed(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    def zoom(image: np.ndarray) -> np.ndarray:
        height, width = image.shape
        size = round(width / factor), round(height / factor)
        left, top = (width - size[0]) // 2, (height - size[1]) // 2
        cut = Image.fromarray(image[top : top + size[1], left : left + size[0]])
        return np.asarray(cut.resize((width, height), Image.Resampling.NEAREST))

    return zoom


def _interpolated(labels: np.ndarray) -> np.ndarray:
    """Return labels spread over 0 to 255, halved and enlarged with interpolation."""
    spread = Image.fromarray((labels * (200 // max(int(labels.max()), 1))).astype(np.uint8))
    size = spread.size
    return np.asarray(spread.resize((size[0] // 2, size[1] // 2)).resize(size, Image.Resampling.BICUBIC))


def _sparse(depth: np.ndarray) -> np.ndarray:
    return np.where(np.random.default_rng(0).random(depth.shape) < 0.12, depth, 0).astype(np.uint16)


def _lit(*factors: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda color: np.clip(np.rint(color * np.array(factors)), 0, 255).astype(np.uint8)


DAMAGES: dict[str, tuple[Callable[[SetUp], None], set[str]]] = {
    "depth in 0.1 mm, read as mm": (_scale_depth(10), {"depth-unit"}),
    "depth in 0.2 mm, read as mm": (_scale_depth(5), {"depth-unit"}),
    "depth_scale in metres per unit (0.001)": (_set(depth_scale=0.001), {"depth-unit"}),
    "depth in floats of mm": (_change("depth", lambda depth: depth.astype(np.float32)), {"depth-unit"}),
    "camera 5 m away": (
        lambda s: (_scale_depth(5)(s), s.intrinsics.update(fx=s.intrinsics["fx"] * 5, fy=s.intrinsics["fy"] * 5)),
        {"distance", "intrinsics-focal"},
    ),
    "little valid depth": (_change("depth", _sparse), {"depth-missing"}),
    "K of 1280 x 960": (lambda s: _scale_camera(s, 2.0), {"intrinsics-size"}),
    "K of 320 x 240": (lambda s: _scale_camera(s, 0.5), {"intrinsics-size"}),
    "cx and cy exchanged": (
        lambda s: s.intrinsics.update(cx=s.intrinsics["cy"], cy=s.intrinsics["cx"]),
        {"intrinsics-size"},
    ),
    "focal length in millimetres": (_set(fx=3.6, fy=3.6), {"intrinsics-focal"}),
    "size of the intrinsics is another": (_set(width=1280, height=720), {"intrinsics-size"}),
    "depth moved by 25 pixels": (_change("depth", _moved(25, 0)), {"registration"}),
    "depth of a wider lens": (_change("depth", _zoomed(1.15)), {"registration"}),
    "depth mirrored": (_change("depth", lambda d: d[:, ::-1]), {"registration"}),
    "BGR": (_change("color", lambda c: c[..., ::-1]), {"bgr"}),
    "a mask of the foreground": (
        _change("labels", lambda m: np.where(m > 0, 255, 0).astype(np.uint8)),
        {"labels-foreground"},
    ),
    "labels resized with interpolation": (_change("labels", _interpolated), {"labels-thin", "labels-many"}),
    "a photo in place of labels": (lambda s: setattr(s, "labels", s.color), {"unreadable-labels"}),
    "a mesh in millimetres": (lambda s: setattr(s, "mesh_side", 150.0), {"mesh-unit"}),
    "a strong colour cast": (_change("color", _lit(1.5, 1.0, 0.35)), {"color-cast", "color-light", "color-bright"}),
}


def run(data: Path, recognizer: Recognizer, bases: Sequence[str] = BASES) -> dict[str, Any]:
    """Diagnose all damaged set-ups."""
    codes: dict[str, list[list[str]]] = {name: [] for name in DAMAGES}
    for base in bases:
        (source,) = find_frames([data / base])
        for name, (damage, _) in DAMAGES.items():
            setup = SetUp.of(source.read())
            damage(setup)
            with tempfile.TemporaryDirectory() as folder:
                files, mesh = setup.write(Path(folder))
                diagnosis = diagnose(files, recognizer=recognizer, meshes={"object": mesh})
            codes[name].append([finding.code for finding in diagnosis.findings])
    right = {name: [bool(DAMAGES[name][1] & set(codes_of)) for codes_of in each] for name, each in codes.items()}
    return {
        "damaged": {name: {"right": sum(right[name]), "of": len(bases), "found": codes[name]} for name in DAMAGES},
        "right_by_frame": {base: sum(each[k] for each in right.values()) for k, base in enumerate(bases)},
    }


def sound(folder: Path, recognizer: Recognizer | None) -> dict[str, Any]:
    """Diagnose sound frames; return their number and the findings, which should be none."""
    sources, findings = find_frames([folder]), {}
    for source in sources:
        diagnosis = diagnose(source.files or source.read(), recognizer=recognizer)
        if diagnosis.findings:
            findings[source.name] = [finding.message for finding in diagnosis.findings]
    return {"frames": len(sources), "with_findings": findings}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder with frames and hots")
    parser.add_argument("--model", type=Path, required=True, help="run trained on the objects of frames")
    parser.add_argument("--sound", nargs="*", help="folders of sound frames in --data")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    recognizer = Recognizer.load(options.model, chunk=BATCH_BUCKETS[-1])
    report = run(options.data, recognizer)
    for folder in options.sound or []:
        knows = folder.startswith("frames/ycbv")
        report.setdefault("sound", {})[folder] = sound(options.data / folder, recognizer if knows else None)
    text = json.dumps(report, indent=1) + "\n"
    print(text)
    if options.out:
        write_text(options.out, text)


if __name__ == "__main__":
    main()
