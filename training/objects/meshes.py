"""Mesh files: find them in a directory and read GLB, OBJ and PLY."""

import dataclasses
import io
import json
import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thor2_jax.errors import InputError, reason_of, with_context
from thor2_jax.files import read_file, read_table
from thor2_jax.frames.frames import check_size
from thor2_jax.printable import check_name
from training.objects.mesh import TexturedMesh

if TYPE_CHECKING:  # takes 0.2 s to import, so it is imported where meshes are read
    import trimesh

__all__ = ["MAX_SIDE", "MIN_SIDE", "find_meshes", "find_object_meshes", "load_mesh", "read_mesh", "scaled_meshes"]

# Without a handler, Python prints trimesh's log of a damaged file on standard error, also with a traceback.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

MESH_SUFFIXES = (".glb", ".obj", ".ply")

MAX_SIDE = 2.0
MIN_SIDE = 0.001
"""Range of an object's longest side, metres; refuses scans in millimetres and keeps the camera outside the object."""

UNSUPPORTED_EXTENSIONS = {
    "EXT_meshopt_compression",
    "KHR_draco_mesh_compression",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_mesh_quantization",
    "KHR_texture_basisu",
    "KHR_texture_transform",
}
"""Extensions of glTF that trimesh ignores, so that it fails, or reads other vertices or colours."""

MISREAD_TEXT = {
    ".obj": rb"(?m)^v(?=(?:[ \t]+\S+){6})(?:[ \t]+\S+){3,5}[ \t]+(?:[2-9]|\d\d+)(?:\.\d*)?\s"
    rb"|\A(?>(?s:.*?)^f[^\n]*[ \t/]-)(?s:.*)\nv",
    ".ply": rb"TextureFile(?s:.*)TextureFile|property\s+(?:ushort|uint16)\s+red",
}
"""Vertex colours above 1 in an OBJ, and vertices after faces with relative indices; several textures or colours of 16
bits in the header of a PLY: trimesh misreads them. The first megabytes of a file are searched."""

FLOAT, UNSIGNED_SHORT, TRIANGLE_FAN = 5126, 5123, 6
"""Types of numbers and a mode of primitives in glTF."""

NEARLY_WHITE = 0.98
"""Vertex colours from this value on do not change a texture noticeably."""

MAX_TEXTURE_COORDINATE = 2**23
"""Largest texture coordinate: beyond it, float32 cannot represent fractions."""


def _part(geometry: "trimesh.Trimesh", transform: NDArray[np.float64]) -> TexturedMesh:
    """Convert one geometry of a file, transformed by a homogeneous matrix [4, 4].

    Raises:
        InputError: the geometry has no colour, faces with invalid vertex indices, or a texture that cannot be used.
        ValueError: the geometry is inconsistent.
    """
    from trimesh.transformations import transform_points

    vertices = np.reshape(np.asarray(geometry.vertices, np.float64), (len(geometry.vertices), 3))
    vertices = transform_points(vertices, transform)
    faces = np.reshape(np.asarray(geometry.faces, np.int32), (-1, 3))
    if np.linalg.det(transform[:3, :3]) < 0:  # keep the faces of a mirrored part oriented outwards
        faces = np.fliplr(faces).copy()
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("faces with invalid vertex indices; repair the mesh")
    visual: Any = geometry.visual
    if visual.kind in ("vertex", "face"):
        ply = geometry.metadata.get("_ply_raw")
        stored = [] if ply is None else [ply[visual.kind]["data"][name] for name in ("red", "green", "blue")]
        if any(each.max() > (1 if each.dtype.kind == "f" else 255) for each in stored):
            raise InputError("its colours cannot be read; expected floats from 0 to 1, or integers from 0 to 255")
        colors = visual.vertex_colors[faces] if visual.kind == "vertex" else visual.face_colors[:, None].repeat(3, 1)
        if len(colors) != len(faces):
            raise InputError("its colours cannot be read, which are of polygons; triangulate the mesh")
        return TexturedMesh(vertices, faces, corner_colors=np.asarray(colors, np.uint8)[..., :3])
    if visual.kind != "texture":
        raise InputError("no texture and no vertex colours; export the mesh with its colours")
    uv, texture = _texture(visual, faces)
    colors = visual.vertex_attributes.get("color", geometry.vertex_attributes.get("color"))
    if colors is not None:
        colors = colors[faces][..., :3] / (1 if colors.dtype.kind == "f" else np.iinfo(colors.dtype).max)
        corners = np.rint((colors * texture[0, 0]).clip(0, 255)).astype(np.uint8)
        if texture.size == 3 and (corners != texture[0, 0]).any():  # a plain colour multiplies the vertex colours
            return TexturedMesh(vertices, faces, corner_colors=corners)
        if "color" in visual.vertex_attributes.data and (colors < NEARLY_WHITE).any():  # only those of a GLB multiply
            raise InputError("a texture and vertex colours, which multiply it; bake them into one kind")
    return TexturedMesh(vertices, faces, uv, (texture,), np.zeros(len(faces), np.int32))


def _texture(visual: Any, faces: NDArray[np.int32]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return texture coordinates [F, 3, 2] and the texture [h, w, 3], one pixel for the plain colour of a material.

    Raises:
        InputError: the texture cannot be used.
    """
    from trimesh.visual.material import PBRMaterial, SimpleMaterial, empty_material

    material = visual.material
    if isinstance(material, PBRMaterial):
        image, factor = material.baseColorTexture, material.baseColorFactor
    elif isinstance(material, SimpleMaterial):
        image, factor = material.image, None if material.image is not None else material.diffuse
        if "kd" not in material.kwargs and (image is None or np.array_equal(image, empty_material().image)):
            raise InputError("no material with a texture or a colour (map_Kd or Kd); export the mesh with them")
    else:
        raise InputError(f"unsupported material {type(material).__name__}")
    factor = np.full(3, 255, np.uint8) if factor is None else np.asarray(factor, np.uint8)[:3]
    if image is None:
        return np.zeros((len(faces), 3, 2), np.float32), factor.reshape(1, 1, 3)
    check_size(image.width, image.height)  # before it is decoded
    if visual.uv is None:
        raise InputError("a texture, but no texture coordinates; export the mesh with them")
    if image.mode.startswith(("I", "F")):  # Pillow would convert it to white
        raise InputError(f"a texture with pixels of mode {image.mode}; expected 8 bits per channel; convert it")
    uv = np.reshape(np.asarray(visual.uv, np.float32)[faces], (len(faces), 3, 2))
    texture = np.asarray(image.convert("RGB"))
    if (factor < 255).any():
        texture = np.rint(texture * (factor / 255.0)).astype(np.uint8)
    return uv, texture


def _check_glb(path: Path) -> None:
    """Raise InputError if a GLB uses parts of glTF that are not supported, or holds a damaged base texture."""
    content = read_file(path)
    if not content.startswith(b"glTF"):
        raise InputError("it is not a GLB file; export or copy it again")
    end = 20 + int.from_bytes(content[12:16], "little")
    header = json.loads(content[20:end])
    unsupported = UNSUPPORTED_EXTENSIONS.intersection(header.get("extensionsUsed", ()))
    for primitive in (each for mesh in header.get("meshes", ()) for each in mesh["primitives"]):
        accessors = {name: header["accessors"][number] for name, number in primitive["attributes"].items()}
        types = {name: accessor["componentType"] for name, accessor in accessors.items()}
        if any("sparse" in accessor for accessor in accessors.values()):
            unsupported.add("sparse accessors")
        if primitive.get("mode") == TRIANGLE_FAN:
            unsupported.add("triangle fans")
        if types.get("TEXCOORD_0", FLOAT) != FLOAT:
            unsupported.add("texture coordinates that are integers")
        if types.get("COLOR_0") == UNSIGNED_SHORT and "material" not in primitive:
            unsupported.add("vertex colours of 16 bits without a material")
    if unsupported:
        raise InputError(f"it uses {', '.join(sorted(unsupported))}; export it without, with pbrMetallicRoughness")
    for material in header.get("materials", ()):
        base = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
        if base.get("texCoord"):
            raise InputError("its texture uses a second set of texture coordinates; export the mesh with one set")
        if "emissiveTexture" in material and not base:
            raise InputError("its only texture is emissive; export it as the base colour")
        source = header["textures"][base["index"]].get("source") if base else None
        image = {} if source is None else header["images"][source]
        if "bufferView" in image:  # trimesh loads the mesh without a damaged image, as white
            view = header["bufferViews"][image["bufferView"]]
            start = end + 8 + view.get("byteOffset", 0)
            try:
                Image.open(io.BytesIO(content[start : start + view["byteLength"]])).close()
            except OSError:
                raise InputError("its texture is damaged; export the mesh again") from None


def load_mesh(path: str | Path | TexturedMesh, scale: float = 1.0) -> TexturedMesh:
    """Read a GLB, OBJ or PLY file with a texture, vertex colours, face colours or plain material colours.

    Stored colours are interpreted as sRGB. A base colour factor multiplies its texture, or is the colour without one.

    Args:
        path: the file; a mesh is returned as it is.
        scale: factor from the unit of the file to metres; 0.001 for millimetres.

    Raises:
        InputError: the file is missing, unreadable or of another format; it has no faces or no colours; its vertices or
            texture coordinates are not finite or too large; its size in metres is not that of an object; or `scale` is
            not a positive number.
    """
    if isinstance(path, TexturedMesh):
        return path
    mesh = read_mesh(Path(path), scale)
    longest = mesh.longest_side
    if not MIN_SIDE <= longest <= MAX_SIDE:
        unit, factor = (" (is it in millimetres?)", 0.001) if longest > MAX_SIDE else ("", 1000)
        raise InputError(
            f"mesh {path}: longest side {longest:g}{unit}; expected {MIN_SIDE:g} to {MAX_SIDE:g} metres; scale the "
            f"mesh, for instance by --mesh-scale {scale * factor:g}"
        )
    return mesh


def scaled_meshes(meshes: Mapping[str, Path | TexturedMesh], scale: float) -> dict[str, Path | TexturedMesh]:
    """Return object name -> mesh, or -> scaled mesh of a file if `scale` is not 1; raise InputError as `load_mesh`."""
    return {name: mesh if scale == 1 else load_mesh(mesh, scale) for name, mesh in meshes.items()}


def read_mesh(path: Path, scale: float = 1.0) -> TexturedMesh:
    """Return the mesh of a file, multiplied by `scale`, of any size; raise InputError as `load_mesh`."""
    if not 0 < scale < np.inf:
        raise InputError(f"mesh_scale is {scale:g}; expected a positive number, such as 0.001 for millimetres")
    if not path.is_file():
        raise InputError(f"mesh {path}: no such file")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"mesh {path}: the extension must be one of {', '.join(MESH_SUFFIXES)}; convert the mesh")
    try:
        mesh = _read(path)
        return mesh if scale == 1 else mesh.transformed(np.diag([scale, scale, scale, 1.0]))
    except InputError as error:
        raise InputError(f"mesh {path}: {error}") from error
    # For a damaged file, trimesh and the texture decoders raise exceptions of any type.
    except Exception as error:
        raise InputError(f"mesh {path}: cannot be read ({reason_of(error)}); export or copy it again") from error


def _read(path: Path) -> TexturedMesh:
    """Return the mesh of a file; raise any exception for a damaged one."""
    import trimesh

    missing: list[str] = []

    class Files(trimesh.resolvers.FilePathResolver):
        """Resolver that records missing files and pipes, since trimesh loads a mesh without its texture as grey."""

        def get(self, name: str) -> bytes:
            try:
                return read_file(Path(self.parent) / name.strip())
            except (OSError, ValueError):
                missing.append(name)
                raise

    if path.suffix.lower() == ".glb":
        _check_glb(path)  # before trimesh fails with another message
    elif re.search(MISREAD_TEXT[path.suffix.lower()], read_file(path)[: 2**24].partition(b"end_header")[0]):
        expected = "expected positive ones, and one texture or 8-bit colours (0 to 1 in an OBJ)"
        raise InputError(f"its indices or colours cannot be read; {expected}; export the mesh again")
    # Processing would silently drop vertices that are not finite.
    scene = trimesh.load_scene(path, resolver=Files(str(path)), process=False)
    if missing:
        raise InputError(f"its file {missing[0]!r} is missing or unreadable")
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            parts.append(_part(geometry, transform))
    if not parts:
        raise InputError("no faces; expected triangles, not points alone")
    mesh = TexturedMesh.merged(parts)
    # The bounds of an object are those of its faces.
    used, faces = np.unique(mesh.faces, return_inverse=True)
    mesh = dataclasses.replace(mesh, vertices=mesh.vertices[used], faces=faces.reshape(-1, 3).astype(np.int32))
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{(~np.isfinite(mesh.vertices)).any(axis=1).sum()} vertices are not finite")
    if mesh.uv is not None and not (np.abs(mesh.uv) <= MAX_TEXTURE_COORDINATE).all():
        raise InputError(f"texture coordinates are not finite, or beyond {MAX_TEXTURE_COORDINATE}")
    return mesh


def _mesh_in(folder: Path) -> Path | None:
    """Return the mesh file of a folder: `textured.*`, else the only GLB, else the only mesh file; None without any.

    Raises:
        InputError: there are several mesh files, and none takes precedence.
    """
    files = sorted(file for file in folder.iterdir() if file.is_file() and file.suffix.lower() in MESH_SUFFIXES)
    files = [file for file in files if file.stem.lower() == "textured"] or files
    files = [file for file in files if file.suffix.lower() == ".glb"] or files
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise InputError(f"mesh folder {folder}: {len(files)} mesh files ({names}); keep one")
    return files[0] if files else None


def find_meshes(folder: str | Path, names: Mapping[str, str] | Path | None = None) -> dict[str, Path]:
    """Find mesh files: object name -> file, sorted by name.

    Args:
        folder: folder with `<scan>.glb` (or .obj, .ply) files, `<scan>/` subfolders with one mesh file each, or
            both.
        names: object name -> scan (a subfolder's name or a file's stem), or a file with this table, see
            `read_names`. By default every scan is an object under its own name.

    Raises:
        InputError: the folder is missing or has no mesh, a scan exists twice or is ambiguous, or `names` is damaged
            or has an unknown scan; also as `check_name`.
        OSError: the file `names` cannot be opened.
    """
    folder, names = Path(folder), read_names(names) if isinstance(names, Path) else names
    if not folder.is_dir():
        raise InputError(f"mesh folder {folder}: no such folder")
    scans: dict[str, Path] = {}
    for entry in sorted(folder.iterdir()):
        name = entry.name if entry.is_dir() else entry.stem
        if names is not None and name not in names.values():  # scans that are not requested are not checked
            continue
        path = _mesh_in(entry) if entry.is_dir() else entry if entry.suffix.lower() in MESH_SUFFIXES else None
        if path is not None and scans.setdefault(name, path) != path:
            raise InputError(f"mesh folder {folder}: scan {name!r} is there twice ({scans[name].name}, {path.name})")
    if names is None and not scans:
        raise InputError(f"mesh folder {folder}: no {', '.join(MESH_SUFFIXES)} file in it or in its folders")
    if unknown := sorted(set((names or {}).values()) - set(scans)):
        raise InputError(f"mesh folder {folder}: no mesh for {', '.join(unknown)}")
    return _named(folder, scans if names is None else {name: scans[names[name]] for name in sorted(names)})


def _named(folder: Path, meshes: Mapping[str, Path]) -> dict[str, Path]:
    """Return the meshes under their names as normalized by `check_name`."""
    named: dict[str, Path] = {}
    for name, path in meshes.items():
        with with_context(f"mesh folder {folder}"):
            if named.setdefault(check_name(name), path) != path:
                raise InputError(f"object {name!r} is there twice; expected one mesh of each object")
    return named


def find_object_meshes(path: Path, name: str | None) -> dict[str, Path]:
    """Return object name -> mesh file.

    Args:
        path: a mesh file, the folder of one object, or a folder of objects as for `find_meshes`.
        name: name of the only object to find; None finds all objects of a folder, under their own names.

    Raises:
        InputError: there is no such mesh, or `name` is None for a file; also as `find_meshes`.
    """
    if not path.is_dir():
        if name is None:
            problem = "is one file, which needs a NAME" if path.exists() else "does not exist"
            raise InputError(f"mesh {path} {problem}")
        return {name: path}
    own = path.resolve().name
    is_object = name == own or any(file.stem.lower() == "textured" for file in path.iterdir())
    if is_object and (mesh := _mesh_in(path)) is not None:
        return _named(path.resolve().parent, {name or own: mesh})
    meshes = find_meshes(path)
    if name is None:
        return meshes
    if name not in meshes and len(meshes) > 1:
        raise InputError(f"mesh folder {path}: none of {', '.join(meshes)} is {name!r}; leave out NAME to enroll all")
    return {name: meshes.get(name) or next(iter(meshes.values()))}


def read_names(path: str | Path) -> dict[str, str]:
    """Read a table of object name -> scan from a file, JSON if its name ends with .json and YAML otherwise.

    Raises:
        InputError: the file is missing, damaged, empty, or not a flat table of strings.
        OSError: the file cannot be opened.
    """
    with with_context(f"names file {path}"):
        table = read_table(Path(path))
        if not table:
            raise InputError("it is empty; expected a table of object name: scan")
        for name, scan in table.items():
            if not (isinstance(name, str) and name and isinstance(scan, str) and scan):
                raise InputError(f"expected a name and a scan, both strings, not {name!r}: {scan!r}")
    return table
