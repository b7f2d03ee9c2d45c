"""Meshes and tables of names: files written by trimesh, known colours, and invalid files."""

import functools
import json
import logging
import operator
import os
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import trimesh
from PIL import Image
from refusals import assert_refused
from rendered_objects import QUAD, QUAD_FACES, QUAD_UV, colored, textured_quad, write_box
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from training.objects.mesh import TexturedMesh
from training.objects.meshes import find_meshes, load_mesh, read_mesh, read_names, scaled_meshes
from training.rendering.camera import RayCaster

# Rows from the top: red, green / blue, white.
CHECKERS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
TEXTURE = {"baseColorTexture": Image.fromarray(CHECKERS)}
PBR = PBRMaterial(**TEXTURE)
SIMPLE = SimpleMaterial(image=Image.fromarray(CHECKERS))


def quadrant_colors(mesh: TexturedMesh) -> list[list[int]]:
    """Return the colours at the centres of the quad's quarters: (x, y) low-low, high-low, high-high, low-high."""
    eye = np.array([0.05, 0.05, 1])
    points = np.array([[0.025, 0.025, 0], [0.075, 0.025, 0], [0.075, 0.075, 0], [0.025, 0.075, 0]])
    return RayCaster([mesh]).cast(eye, points - eye).color.tolist()


QUADRANTS = [[0, 0, 255], [255, 255, 255], [0, 255, 0], [255, 0, 0]]
FACTOR = np.array([128, 255, 51, 255], np.uint8)
SCALED = np.rint(np.array(QUADRANTS) * FACTOR[:3] / 255).tolist()
CORNERS = np.array([[0, 0, 0], [200, 0, 0], [200, 100, 0], [0, 100, 0]], np.uint8)
BETWEEN = [[50, 25, 0], [150, 25, 0], [150, 75, 0], [50, 75, 0]]
WITHOUT_GREEN = [[red, 0, 0] for red, _, _ in BETWEEN]


def colored_material(material: PBRMaterial) -> trimesh.Trimesh:
    """Return a quad with vertex colours and a material without a texture, as Blender exports it."""
    quad = textured_quad(material)
    quad.visual.vertex_attributes["color"] = np.insert(CORNERS, 3, 255, axis=1)
    return quad


QUADS: dict[str, tuple[Any, str, Any]] = {
    "texture of a GLB": (textured_quad(PBR), "glb", QUADRANTS),
    "texture of an OBJ": (textured_quad(SIMPLE), "obj", QUADRANTS),
    "factor": (textured_quad(PBRMaterial(baseColorFactor=FACTOR)), "glb", [[128, 255, 51]] * 4),
    "texture and factor": (textured_quad(PBRMaterial(**TEXTURE, baseColorFactor=FACTOR)), "glb", SCALED),
    "vertices of a GLB": (colored(QUAD, CORNERS), "glb", BETWEEN),
    "vertices of a PLY": (colored(QUAD, CORNERS), "ply", BETWEEN),
    "vertices with a material": (colored_material(PBRMaterial()), "glb", BETWEEN),
    "vertices and factor": (colored_material(PBRMaterial(baseColorFactor=[255, 0, 255, 255])), "glb", WITHOUT_GREEN),
}


@pytest.mark.parametrize("name", QUADS)
def test_colours_are_those_of_the_file(tmp_path: Path, name: str) -> None:
    quad, suffix, expected = QUADS[name]
    quad.export(tmp_path / f"quad.{suffix}")
    mesh = load_mesh(tmp_path / f"quad.{suffix}")
    assert mesh.faces.shape == (2, 3) and mesh.vertices.dtype == np.float64 and mesh.faces.dtype == np.int32
    assert quadrant_colors(mesh) == expected
    np.testing.assert_allclose(mesh.centre, [0.05, 0.05, 0])


def test_colours_of_faces_and_of_parts(tmp_path: Path) -> None:
    colors = [[10, 20, 30], [40, 50, 60]]
    trimesh.Trimesh(QUAD, QUAD_FACES, face_colors=colors, process=False).export(tmp_path / "quad.ply")
    assert quadrant_colors(load_mesh(tmp_path / "quad.ply"))[1::2] == colors
    textured = [textured_quad(PBRMaterial(baseColorTexture=Image.new("RGB", (2, 2), tuple(c)))) for c in colors]
    for parts in (textured, [colored(QUAD, [color] * 4) for color in colors]):
        scene = trimesh.Scene()
        for index, part in enumerate(parts):
            scene.add_geometry(part, transform=trimesh.transformations.translation_matrix([0, 0, index * 0.2]))
        scene.export(tmp_path / "two.glb")
        mesh = load_mesh(tmp_path / "two.glb")
        of_face = (mesh.vertices[mesh.faces[:, 0], 2] > 0.1).astype(int)
        assert sorted(of_face) == [0, 0, 1, 1]
        np.testing.assert_array_equal(mesh.colors_at(np.arange(4), np.full((4, 2), 0.3)), np.array(colors)[of_face])


def test_texture_repeats_outside_the_unit_square() -> None:
    uv = np.array([[[-0.25, 1.75], [2.25, 0.25], [0.75, -0.75]]], np.float32)
    mesh = TexturedMesh(QUAD, np.array([[0, 1, 2]], np.int32), uv, (CHECKERS,), np.zeros(1, np.int32))
    corners = mesh.colors_at(np.zeros(3, int), np.array([[0, 0], [1, 0], [0, 1.0]]))
    assert corners.tolist() == [[0, 255, 0], [0, 0, 255], [255, 255, 255]]
    assert mesh.colors_at(np.zeros(0, int), np.zeros((0, 2))).shape == (0, 3)


ASCII_PLY = trimesh.exchange.ply.export_ply(colored(QUAD), encoding="ascii")


def check_refused(path: Path, message: str) -> None:
    assert_refused(f"{path.name}.*{message}", load_mesh, path)


def test_inconsistent_meshes_are_refused(tmp_path: Path) -> None:
    for name in ("missing.glb", "missing"):
        check_refused(tmp_path / name, "no such file")
    for name, message in (("mesh.stl", ".glb, .obj, .ply"), ("mesh.glb", "not a GLB file")):
        (tmp_path / name).touch()
        check_refused(tmp_path / name, message)
    mixed = trimesh.Scene([colored(QUAD), textured_quad(PBR)])
    for mesh, message in ((mixed, "some parts .* vertex colours"), (colored_material(PBR), "a texture and vertex")):
        mesh.export(tmp_path / "mixed.glb")
        check_refused(tmp_path / "mixed.glb", message)
    for mesh, message in (
        (trimesh.Trimesh(QUAD, QUAD_FACES, process=False), "no texture"),
        (trimesh.PointCloud(QUAD, np.full((4, 4), 9, np.uint8)), "no faces"),
        (colored(QUAD * 1000), "longest side 100 .*millimetres"),
        (colored(QUAD * 1e-4), "longest side 1e-05;.*--mesh-scale 1000$"),
        (colored(QUAD + [[np.nan], [0], [0], [0]]), "1 vertices are not finite"),
        (colored(QUAD + [[np.inf], [0], [0], [0]]), "1 vertices are not finite"),
    ):
        mesh.export(tmp_path / "mesh.ply")
        check_refused(tmp_path / "mesh.ply", message)
    (tmp_path / "far.ply").write_bytes(ASCII_PLY.replace(b"3 0 1 2", b"3 0 1 -1"))
    check_refused(tmp_path / "far.ply", "invalid vertex indices")


def test_obj_without_its_material_or_texture(tmp_path: Path) -> None:
    textured_quad(SIMPLE).export(tmp_path / "quad.obj")
    (picture,) = tmp_path.glob("*.png")
    (material,) = tmp_path.glob("*.mtl")
    picture.unlink()
    check_refused(tmp_path / "quad.obj", f"'{picture.name}' is missing")
    os.mkfifo(picture)  # reading it would never end
    check_refused(tmp_path / "quad.obj", "is missing or unreadable")
    material.write_text("".join(line for line in material.read_text().splitlines(True) if "Kd" not in line))
    check_refused(tmp_path / "quad.obj", "map_Kd or Kd")
    material.unlink()
    check_refused(tmp_path / "quad.obj", f"'{material.name}' is missing")


def test_a_ply_without_its_texture_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "quad.ply").write_bytes(ASCII_PLY.replace(b"1.0\n", b"1.0\ncomment TextureFile absent.png\n", 1))
    # pytest's own handlers keep the logging module from printing.
    with mock.patch.object(logging.getLogger(), "handlers", []):
        check_refused(tmp_path / "quad.ply", "'absent.png' is missing")
    assert capfd.readouterr().err == ""


def test_vertices_without_faces_are_dropped(tmp_path: Path) -> None:
    colors = np.full((5, 4), 100, np.uint8)
    for stray in ([[0.5, 0.0, 0.0]], [[np.nan, 0.0, 0.0]]):
        mesh = trimesh.Trimesh([*stray, *QUAD], QUAD_FACES + 1, vertex_colors=colors, process=False)
        mesh.export(tmp_path / "quad.ply")
        np.testing.assert_allclose(load_mesh(tmp_path / "quad.ply").centre, [0.05, 0.05, 0])


EXTENSIONS = (
    *("KHR_texture_transform", "KHR_draco_mesh_compression", "EXT_meshopt_compression"),
    "KHR_materials_pbrSpecularGlossiness",
)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        *((("extensionsUsed",), [name], f"it uses {name}") for name in EXTENSIONS),
        (("accessors", 2, "componentType"), 5123, "integers"),
        (("accessors", 1, "sparse"), {}, "sparse accessors"),
        (("meshes", 0, "primitives", 0, "mode"), 6, "triangle fans"),
        (("materials", 0, "pbrMetallicRoughness", "baseColorTexture", "texCoord"), 1, "second set"),
        (("materials", 0), {"emissiveTexture": {"index": 0}}, "emissive"),
    ],
)
def test_unsupported_parts_of_gltf(tmp_path: Path, path: tuple[Any, ...], value: Any, message: str) -> None:
    """The buffer has no content, as in the files of gltfpack."""

    def change(tree: dict[str, Any]) -> None:
        functools.reduce(operator.getitem, path[:-1], tree)[path[-1]] = value
        for view in tree["bufferViews"]:
            view["buffer"] = 1

    textured_quad(PBR).export(tmp_path / "quad.glb", tree_postprocessor=change)
    check_refused(tmp_path / "quad.glb", message)


def test_textures_that_cannot_be_used(tmp_path: Path) -> None:
    textured_quad(SIMPLE).export(tmp_path / "quad.obj")
    (picture,) = tmp_path.glob("*.png")
    Image.fromarray(np.full((2, 2), 9000, np.uint16)).save(picture)
    check_refused(tmp_path / "quad.obj", "mode I;16; expected 8 bits")
    textured_quad(PBR).export(tmp_path / "quad.glb")
    content = (tmp_path / "quad.glb").read_bytes()
    (tmp_path / "quad.glb").write_bytes(content.replace(b"TEXCOORD_0", b"TEXCOORD_1"))
    check_refused(tmp_path / "quad.glb", "no texture coordinates")
    (tmp_path / "quad.glb").write_bytes(content.replace(b"\x89PNG", b"\0PNG"))
    check_refused(tmp_path / "quad.glb", "its texture is damaged")


def test_colours_and_indices_that_trimesh_misreads(tmp_path: Path) -> None:
    rows = "".join(f"v {x} {y} {z} {x * 2000} 0 0\n" for x, y, z in QUAD)
    for text in (rows + "f 1 2 3 4\n", "v 0 0 0 1 1 1\nf -1 -1 -1\nv 0 0 1 1 1 1\n"):
        (tmp_path / "quad.obj").write_text(text)
        check_refused(tmp_path / "quad.obj", "0 to 1")
    textures = b"1.0\ncomment TextureFile a\ncomment TextureFile b\n"
    faces = trimesh.Trimesh(QUAD, QUAD_FACES, face_colors=CORNERS[:2]).export(file_type="ply", encoding="ascii")
    changes = [(b"uchar red", b"ushort red"), (b"uchar red", b"float red"), (b"1.0\n", textures)]
    of_faces = (faces, changes[1]), (faces, (b"3 0 1 2", b"4 0 1 2 3"))
    large = ASCII_PLY.replace(b"99 99 99", b"999 99 99"), (b"uchar red", b"int red")
    for ply, change in (*((ASCII_PLY, change) for change in changes), *of_faces, large):
        (tmp_path / "quad.ply").write_bytes(ply.replace(*change, 1))
        check_refused(tmp_path / "quad.ply", "colours cannot be read")


def test_mirrored_parts_stay_the_right_way_out(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    for scale in ((1, 1, 1), (-1, 1, 1), (-1, -1, 2)):
        scene.add_geometry(textured_quad(PBR), transform=np.diag([*scale, 1.0]))
    scene.export(tmp_path / "scene.glb")
    mesh = load_mesh(tmp_path / "scene.glb")
    expected = trimesh.load_scene(tmp_path / "scene.glb", process=False).to_mesh()
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], expected.triangles)
    np.testing.assert_array_equal(mesh.uv, expected.visual.uv[expected.faces].astype(np.float32))


def test_texture_coordinates_that_are_too_far(tmp_path: Path) -> None:
    path = tmp_path / "quad.glb"
    textured_quad(PBR, QUAD_UV * [1, 2.0**23]).export(path)
    assert load_mesh(path).colors_at(np.arange(2), np.full((2, 2), 0.3)).shape == (2, 3)
    for far in (1e30, np.nan):
        textured_quad(PBR, QUAD_UV * [1, far]).export(path)
        check_refused(path, "texture coordinates are not finite, or beyond")


def put(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_finding_meshes(tmp_path: Path) -> None:
    put(tmp_path, *"mug.glb notes.txt can/can.ply can/can.png box/textured.obj box/other.glb none/a.txt".split())
    expected = {"box": "box/textured.obj", "can": "can/can.ply", "mug": "mug.glb"}
    assert list(find_meshes(tmp_path).items()) == [(name, tmp_path / path) for name, path in expected.items()]
    put(tmp_path, "two/a.ply", "two/b.ply")
    assert_refused("2 mesh files .*keep one", find_meshes, tmp_path)
    by_class = find_meshes(tmp_path, {"soup": "can", "cup": "mug", "again": "mug"})
    assert [(name, path.stem) for name, path in by_class.items()] == [("again", "mug"), ("cup", "mug"), ("soup", "can")]


def test_names_of_meshes_are_normal(tmp_path: Path) -> None:
    (tmp_path / "cafe\u0301.ply").touch()
    assert list(find_meshes(tmp_path)) == ["caf\u00e9"]
    assert list(find_meshes(tmp_path, {" cup": "cafe\u0301"})) == ["cup"]
    (tmp_path / "caf\u00e9.glb").touch()
    assert_refused("is there twice", find_meshes, tmp_path)
    assert_refused("name is '..', which is reserved", find_meshes, tmp_path, {"..": "cafe\u0301"})


def test_missing_meshes_are_refused(tmp_path: Path) -> None:
    assert_refused("nowhere: no such folder", find_meshes, tmp_path / "nowhere")
    assert_refused("no .glb, .obj, .ply file", find_meshes, tmp_path)
    put(tmp_path, "mug.glb", "mug.obj")
    assert_refused("no mesh for bowl, dish", find_meshes, tmp_path, {"a": "dish", "b": "bowl"})
    assert_refused("'mug' is there twice", find_meshes, tmp_path)


def test_names_files(tmp_path: Path) -> None:
    (tmp_path / "names.json").write_text(json.dumps({"mug": "025_mug"}))
    (tmp_path / "names.yaml").write_text("mug: 025_mug\n")
    assert read_names(tmp_path / "names.json") == read_names(tmp_path / "names.yaml") == {"mug": "025_mug"}
    for content, message in (
        ("{}", "it is empty"),
        ('{"mug": 25}', "both strings, not 'mug': 25"),
        ("25: mug", "both strings, not 25: 'mug'"),
        ("mug: ''", "both strings"),
    ):
        (tmp_path / "names.yaml").write_text(content)
        assert_refused(f"names file {tmp_path / 'names.yaml'}.*{message}", read_names, tmp_path / "names.yaml")
    assert_refused("absent.json is missing", read_names, tmp_path / "absent.json")


def test_meshes_in_other_units(tmp_path: Path) -> None:
    box, large = (write_box(tmp_path / f"{side:g}.glb", (side, side / 2, side / 4)) for side in (0.2, 200))
    expected, scaled = load_mesh(box), load_mesh(large, 0.001)
    np.testing.assert_allclose(scaled.vertices, expected.vertices, atol=1e-6)
    np.testing.assert_array_equal(scaled.corner_colors, expected.corner_colors)
    assert read_mesh(large).longest_side == pytest.approx(200)
    assert_refused(f"{large}: longest side 200.*--mesh-scale 0.001$", load_mesh, large)
    assert scaled_meshes({"box": box}, 1.0) == {"box": box}
    doubled = scaled_meshes({"box": box}, 2.0)["box"]
    assert isinstance(doubled, TexturedMesh)
    np.testing.assert_allclose(doubled.vertices, 2 * expected.vertices)
    for scale in (0.0, -1.0, np.nan, np.inf):
        assert_refused("^mesh_scale is ", load_mesh, box, scale)
