"""Damaged meshes: GLB, OBJ with its material and texture, PLY in text and binary."""

import io
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
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from thor2_jax.testing import damaged
from training.objects.mesh import TexturedMesh
from training.objects.meshes import load_mesh, read_names

QUAD = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0.05]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
IMAGE = Image.fromarray(np.random.default_rng(0).integers(0, 256, (6, 5, 3), dtype=np.uint8))


def textured(material: Any) -> trimesh.Trimesh:
    visual = trimesh.visual.TextureVisuals(uv=UV, material=material)
    return trimesh.Trimesh(QUAD, FACES, visual=visual, process=False)


def painted() -> trimesh.Trimesh:
    return trimesh.Trimesh(QUAD, FACES, vertex_colors=np.arange(16).reshape(4, 4).astype(np.uint8), process=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("meshes")
    textured(PBRMaterial(baseColorTexture=IMAGE)).export(path / "textured.glb")
    painted().export(path / "painted.glb")
    textured(SimpleMaterial(image=IMAGE)).export(path / "quad.obj")
    (path / "binary.ply").write_bytes(trimesh.exchange.ply.export_ply(painted(), encoding="binary"))
    (path / "text.ply").write_bytes(trimesh.exchange.ply.export_ply(painted(), encoding="ascii"))
    assert all(load_mesh(path / name) for name in NAMES)
    return path


NAMES = ("textured.glb", "painted.glb", "quad.obj", "binary.ply", "text.ply")


def check(mesh: TexturedMesh | None) -> None:
    """Assert that a mesh that was read can be rendered: indices are in range and numbers are finite."""
    if mesh is None:
        return
    assert np.isfinite(mesh.vertices).all() and 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)
    face = np.arange(len(mesh.faces))
    colors = mesh.colors_at(face, np.full((len(face), 2), 0.3))
    assert colors.shape == (len(face), 3) and colors.dtype == np.uint8


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_meshes(name: str, data: st.DataObject, folder: Path, attempt: Any) -> None:
    path = folder / f"damaged{Path(name).suffix}"
    path.write_bytes(data.draw(damaged((folder / name).read_bytes())))
    check(attempt(lambda: load_mesh(path)))


def glb(table: bytes, binary: bytes) -> bytes:
    """Return a GLB file with valid lengths of its chunks."""
    parts = [(b"JSON", table + b" " * (-len(table) % 4)), (b"BIN\0", binary + b"\0" * (-len(binary) % 4))]
    body = b"".join(struct.pack("<I", len(content)) + kind + content for kind, content in parts)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def parts_of(content: bytes) -> tuple[bytes, bytes]:
    (length,) = struct.unpack("<I", content[12:16])
    return content[20 : 20 + length], content[28 + length :]


@pytest.mark.parametrize("name", ["textured.glb", "painted.glb"])
@given(data=st.data(), table_first=st.booleans())
def test_damaged_glb_with_valid_lengths(
    name: str, data: st.DataObject, table_first: bool, folder: Path, attempt: Any
) -> None:
    table, binary = parts_of((folder / name).read_bytes())
    if table_first:
        table = data.draw(damaged(table, 2))
    else:
        binary = data.draw(damaged(binary, 2))
    path = folder / "damaged.glb"
    path.write_bytes(glb(table, binary))
    check(attempt(lambda: load_mesh(path)))


def numbers_in(table: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = table.items() if isinstance(table, dict) else enumerate(table) if isinstance(table, list) else ()
    return [
        p for key, value in items for p in ([(*place, key)] if type(value) is int else numbers_in(value, (*place, key)))
    ]


@pytest.mark.parametrize("name", ["textured.glb", "painted.glb"])
@pytest.mark.parametrize("value", [-1, 0, 3, 2**31 - 1, 10**12])
def test_every_number_of_a_glb_table(name: str, value: int, folder: Path, attempt: Any) -> None:
    """Replaces counts, offsets, types and indices of nodes; some values would fill memory or form a cycle."""
    table, binary = parts_of((folder / name).read_bytes())
    path = folder / "damaged.glb"
    for place in numbers_in(json.loads(table)):
        changed = json.loads(table)
        inner = changed
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = value
        path.write_bytes(glb(json.dumps(changed).encode(), binary))
        check(attempt(lambda: load_mesh(path)))


def test_cyclic_nodes(folder: Path, attempt: Any) -> None:
    table, binary = parts_of((folder / "painted.glb").read_bytes())
    changed = json.loads(table)
    for k, node in enumerate(changed["nodes"]):
        node["children"] = [(k + 1) % len(changed["nodes"]), k]
    path = folder / "damaged.glb"
    path.write_bytes(glb(json.dumps(changed).encode(), binary))
    check(attempt(lambda: load_mesh(path)))


@pytest.mark.parametrize("name", ["quad.mtl", "texture"])
@given(data=st.data())
def test_damaged_material_and_texture_of_an_obj(
    name: str, data: st.DataObject, folder: Path, attempt: Any, tmp_path_factory: Any
) -> None:
    others = {p.name: p.read_bytes() for p in folder.iterdir() if p.suffix in (".mtl", ".png", ".jpeg", ".jpg")}
    (chosen,) = [n for n in others if n.endswith(".mtl") == name.endswith(".mtl")]
    place = tmp_path_factory.getbasetemp() / "obj"
    place.mkdir(exist_ok=True)
    for other, content in others.items():
        (place / other).write_bytes(data.draw(damaged(content)) if other == chosen else content)
    (place / "quad.obj").write_bytes((folder / "quad.obj").read_bytes())
    check(attempt(lambda: load_mesh(place / "quad.obj")))


@pytest.mark.slow
def test_a_texture_that_would_fill_memory(folder: Path, attempt: Any) -> None:
    stream = io.BytesIO()
    Image.new("RGB", (13_000, 13_000)).save(stream, "PNG")
    table, binary = parts_of((folder / "textured.glb").read_bytes())
    changed = json.loads(table)
    view = changed["bufferViews"][changed["images"][0]["bufferView"]]
    binary += b"\0" * (-len(binary) % 4)
    view["byteOffset"], view["byteLength"] = len(binary), len(stream.getvalue())
    binary += stream.getvalue()
    changed["buffers"][0]["byteLength"] = len(binary)
    path = folder / "bomb.glb"
    path.write_bytes(glb(json.dumps(changed).encode(), binary))
    assert attempt(lambda: load_mesh(path)) is None


@pytest.mark.parametrize("header", ["element vertex 1000000000000", "element face 1000000000000", "element vertex -4"])
@pytest.mark.parametrize("name", ["binary.ply", "text.ply"])
def test_ply_headers(header: str, name: str, folder: Path, attempt: Any) -> None:
    kind = header.rsplit(" ", 1)[0].encode()
    content = (folder / name).read_bytes()
    start = content.index(kind)
    path = folder / "header.ply"
    path.write_bytes(content[:start] + header.encode() + content[content.index(b"\n", start) :])
    check(attempt(lambda: load_mesh(path)))


@pytest.mark.parametrize("suffix", ["json", "yaml"])
@given(data=st.data())
def test_tables_of_names(suffix: str, data: st.DataObject, folder: Path, attempt: Any) -> None:
    content = b'{"mug": "025_mug", "bowl": "024_bowl"}' if suffix == "json" else b"mug: 025_mug\nbowl: 024_bowl\n"
    path = folder / f"names.{suffix}"
    path.write_bytes(data.draw(damaged(content)))
    names = attempt(lambda: read_names(path))
    assert names is None or all(type(a) is type(b) is str for a, b in names.items())
