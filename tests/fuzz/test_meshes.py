"""Damaged meshes: GLB, OBJ with its material and texture, PLY in text and binary."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from rendered_objects import QUAD, colored, textured_quad
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from thor2_jax.frames.frames import encode_image
from thor2_jax.testing import damaged
from training.objects.meshes import load_mesh

from .conftest import other_content

IMAGE = Image.fromarray(np.random.default_rng(0).integers(0, 256, (6, 5, 3), dtype=np.uint8))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("meshes")
    painted = colored(QUAD, np.arange(16, dtype=np.uint8).reshape(4, 4))
    textured_quad(PBRMaterial(baseColorTexture=IMAGE)).export(path / "textured.glb")
    painted.export(path / "painted.glb")
    textured_quad(SimpleMaterial(image=IMAGE)).export(path / "quad.obj")
    for name, encoding in (("binary", "binary"), ("text", "ascii")):
        (path / f"{name}.ply").write_bytes(trimesh.exchange.ply.export_ply(painted, encoding=encoding))
    assert all(load_mesh(path / name) for name in NAMES)
    return path


NAMES = ("textured.glb", "painted.glb", "quad.obj", "binary.ply", "text.ply")


def check(path: Path, attempt: Any) -> None:
    """Read a mesh, which is refused or can be rendered."""
    mesh = attempt(lambda: load_mesh(path))
    if mesh is None:
        return
    assert np.isfinite(mesh.vertices).all() and 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)
    face = np.arange(len(mesh.faces))
    colors = mesh.colors_at(face, np.full((len(face), 2), 0.3))
    assert colors.shape == (len(face), 3) and colors.dtype == np.uint8


@pytest.mark.parametrize("name", [*NAMES, "material.mtl", "material_0.png"])
@given(data=st.data())
def test_damaged_files(name: str, data: st.DataObject, folder: Path, attempt: Any) -> None:
    """A damaged material or texture is read with the OBJ file that refers to it."""
    with other_content(folder / name, data.draw(damaged((folder / name).read_bytes()))):
        check(folder / (name if name in NAMES else "quad.obj"), attempt)


def write_glb(path: Path, table: Any, binary: bytes) -> Path:
    """Write a GLB file with valid lengths of its chunks; the table is JSON, or bytes that may be damaged."""
    text = table if isinstance(table, bytes) else json.dumps(table).encode()
    parts = [(b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", binary + b"\0" * (-len(binary) % 4))]
    body = b"".join(struct.pack("<I", len(content)) + kind + content for kind, content in parts)
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path


def parts_of(path: Path) -> tuple[bytes, bytes]:
    content = path.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    return content[20 : 20 + length], content[28 + length :]


@pytest.mark.parametrize("name", ["textured.glb", "painted.glb"])
@given(data=st.data(), table_first=st.booleans())
def test_glb_with_valid_lengths(name: str, data: st.DataObject, table_first: bool, folder: Path, attempt: Any) -> None:
    parts = list(parts_of(folder / name))
    parts[not table_first] = data.draw(damaged(parts[not table_first], 2))
    check(write_glb(folder / "damaged.glb", *parts), attempt)


def numbers_in(table: Any) -> list[tuple[Any, Any]]:
    """Return the objects and lists of a JSON value that hold integers, each with the key of one."""
    items = list(table.items() if isinstance(table, dict) else enumerate(table) if isinstance(table, list) else ())
    inner = [place for _, value in items for place in numbers_in(value)]
    return [(table, key) for key, value in items if type(value) is int] + inner


@pytest.mark.parametrize("name", ["textured.glb", "painted.glb"])
@pytest.mark.parametrize("value", [-1, 0, 3, 2**31 - 1, 10**12])
def test_every_number_of_a_glb_table(name: str, value: int, folder: Path, attempt: Any) -> None:
    """Replaces counts, offsets, types and indices of nodes; some values would fill memory or form a cycle."""
    text, binary = parts_of(folder / name)
    table = json.loads(text)
    for place, key in numbers_in(table):
        before, place[key] = place[key], value
        check(write_glb(folder / "damaged.glb", table, binary), attempt)
        place[key] = before


@pytest.mark.slow
def test_a_texture_that_would_fill_memory(folder: Path, attempt: Any) -> None:
    text, binary = parts_of(folder / "textured.glb")
    table, image = json.loads(text), encode_image(np.zeros((13_000, 13_000, 3), np.uint8))
    view = table["bufferViews"][table["images"][0]["bufferView"]]
    binary += b"\0" * (-len(binary) % 4)
    view["byteOffset"], view["byteLength"] = len(binary), len(image)
    table["buffers"][0]["byteLength"] = len(binary + image)
    path = write_glb(folder / "bomb.glb", table, binary + image)
    assert attempt(lambda: load_mesh(path)) is None
