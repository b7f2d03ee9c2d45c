"""Downloads of YCB meshes from a local server: resumed, damaged, missing and hostile archives, and no network."""

import io
import shutil
import tarfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from commands import Command
from processes import free_port
from refusals import assert_refused

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import encode_image
from training.objects.fetch_ycb import fetch_ycb
from training.objects.meshes import find_meshes

NAME = "003_cracker_box"
OBJ = b"mtllib textured.mtl\nusemtl m\nv 0 0 0\nv .1 0 0\nv 0 .1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"


def archive(files: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as content:
        for name, data in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            content.addfile(member, io.BytesIO(data))
    return stream.getvalue()


def mesh_files(folder: str = f"{NAME}/google_16k/") -> dict[str, bytes]:
    texture = encode_image(np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8))
    files = {"textured.mtl": b"newmtl m\nmap_Kd texture_map.png\n", "texture_map.png": texture, "textured.obj": OBJ}
    return {folder + name: data for name, data in files.items()}


class Handler(BaseHTTPRequestHandler):
    """Sends files, and keeps the values of Range that it was asked for."""

    server: Any

    def log_message(self, *arguments: object) -> None:
        pass

    def do_GET(self) -> None:
        requested, data = self.headers.get("Range"), self.server.files.get(self.path)
        self.server.requests.append(requested)
        is_part = requested is not None and self.server.ranges
        start = int(requested.removeprefix("bytes=").rstrip("-")) if requested and is_part else 0
        if data is None or start >= len(data):
            self.send_error(404 if data is None else 416)
            return
        self.send_response(206 if is_part else 200)
        self.send_header("Content-Length", str(len(data) - start))
        self.end_headers()
        self.wfile.write(data[start : self.server.break_after])


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.setenv("no_proxy", "*")
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        server: Any = http
        server.files, server.requests = {f"/google/{NAME}_google_16k.tgz": archive(mesh_files())}, []
        server.break_after, server.ranges, server.url = None, True, f"http://127.0.0.1:{http.server_port}/google"
        thread = Thread(target=http.serve_forever, args=(0.01,))
        thread.start()
        yield server
        http.shutdown()
        thread.join()


def test_mesh_is_where_training_finds_it(server: Any, tmp_path: Path) -> None:
    seen: list[tuple[str, int, int, str]] = []
    meshes = fetch_ycb([NAME], tmp_path, url=server.url, progress=lambda *values: seen.append(values))
    assert meshes == find_meshes(tmp_path) == {NAME: tmp_path / NAME / "textured.obj"}
    assert {path.name: path.read_bytes() for path in (tmp_path / NAME).iterdir()} == mesh_files("")
    assert seen[-1][0] == NAME and seen[-1][1] == seen[-1][2] == len(archive(mesh_files())) // 1000
    fetch_ycb([NAME], tmp_path, url=server.url)
    assert server.requests == [None]
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lock", NAME]


@pytest.mark.parametrize("ranges", [True, False])
def test_broken_download_resumes(server: Any, tmp_path: Path, ranges: bool) -> None:
    server.break_after, server.ranges = 5000, ranges
    assert_refused("resumes", fetch_ycb, [NAME], tmp_path, url=server.url)
    assert not (tmp_path / NAME).exists()
    server.break_after = None
    fetch_ycb([NAME], tmp_path, url=server.url)
    assert server.requests == [None, "bytes=5000-"]
    assert (tmp_path / NAME / "textured.obj").read_bytes() == OBJ


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_an_interrupted_extraction_keeps_the_archive(error: Any, server: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("training.objects.fetch_ycb.load_mesh", Mock(side_effect=error))
    with pytest.raises(error):
        fetch_ycb([NAME], tmp_path, url=server.url)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f".{NAME}.tgz", ".lock"]


def test_a_full_disk_names_the_archive(server: Any, tmp_path: Path) -> None:
    (tmp_path / f".{NAME}.tgz").symlink_to("/dev/full")
    with pytest.raises(OSError, match=str(tmp_path / f".{NAME}.tgz")):
        fetch_ycb([NAME], tmp_path, url=server.url)


DAMAGED = {
    "half": archive(mesh_files())[:5000],
    "without the end": archive(mesh_files())[:-4],
    "other checksum": archive(mesh_files())[:-8] + bytes(8),
    "a page": b"<html>a page</html>",
    "no mesh": archive({f"{NAME}/google_16k/nontextured.ply": b"ply"}),
    "two meshes": archive(mesh_files() | mesh_files("google_16k/")),
    "damaged mesh": archive(mesh_files() | {f"{NAME}/google_16k/textured.obj": b"v nonsense"}),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_archives_leave_nothing(server: Any, tmp_path: Path, damage: str) -> None:
    server.files = {f"/google/{NAME}_google_16k.tgz": DAMAGED[damage]}
    with pytest.raises(InputError, match=NAME) as error:
        fetch_ycb([NAME], tmp_path, url=server.url)
    assert ".thor2" not in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


@pytest.mark.parametrize("size", [5000, 20_000])
def test_archives_that_would_fill_the_disk(server: Any, tmp_path: Path, size: int, monkeypatch: Any) -> None:
    """The archive has 12 kB, and its files 25 kB."""
    monkeypatch.setattr("training.objects.fetch_ycb.MAX_BYTES", size)
    server.files = {f"/google/{NAME}_google_16k.tgz": archive(mesh_files() | {f"{NAME}/zeros": bytes(13_000)})}
    assert_refused(f"{NAME}.*more than {size:,} bytes", fetch_ycb, [NAME], tmp_path, url=server.url)
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


def test_files_of_the_user_stay(server: Any, tmp_path: Path) -> None:
    (tmp_path / ".extracting-mine").mkdir()
    fetch_ycb([NAME], tmp_path, url=server.url)
    shutil.rmtree(tmp_path / NAME)
    (tmp_path / f".{NAME}.tgz").write_text("a user's")
    assert_refused(f"{NAME}.tgz", fetch_ycb, [NAME], tmp_path, url=server.url)
    assert (tmp_path / f".{NAME}.tgz").read_text() == "a user's" and (tmp_path / ".extracting-mine").is_dir()
    (tmp_path / f".{NAME}.tgz").unlink()
    (tmp_path / NAME).mkdir()
    assert_refused("exists without", fetch_ycb, [NAME], tmp_path, url=server.url)
    (tmp_path / "file").touch()
    for directory in (tmp_path / "file", tmp_path / "file" / "meshes"):
        assert_refused(f"out: {directory} is not a directory", fetch_ycb, [NAME], directory, url=server.url)


def test_archive_writes_only_into_its_folder(server: Any, tmp_path: Path) -> None:
    names = ("../../google_16k/evil.txt", "/google_16k/absolute.txt", "evil.txt", "google_16k/..")
    server.files = {f"/google/{NAME}_google_16k.tgz": archive(mesh_files() | dict.fromkeys(names, b"1"))}
    fetch_ycb([NAME], tmp_path / "meshes", url=server.url)
    written = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.txt")}
    assert written <= {f"meshes/{NAME}/evil.txt", f"meshes/{NAME}/absolute.txt"}
    assert [path.name for path in tmp_path.iterdir()] == ["meshes"]


def test_unknown_objects_and_unreadable_addresses(server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for names in ([], ["cracker box"], ["../003_cracker_box"], ["004_sugar_box"]):
        assert_refused("objects", fetch_ycb, names, tmp_path, url=server.url)
    for url in ("ftp://a", "a", "http://", "http://[::1", "http://a:b", "http://a b", "http://a..b", "http://\u2100"):
        assert_refused("expected", fetch_ycb, [NAME], tmp_path, url=url)
    assert_refused("network", fetch_ycb, [NAME], tmp_path / "new", url=f"http://127.0.0.1:{free_port()}")
    assert not (tmp_path / "new").exists()
    monkeypatch.setenv("no_proxy", "")
    for proxy in ("socks5://127.0.0.1:1", "ftp://127.0.0.1:1"):
        monkeypatch.setenv("all_proxy", proxy)
        assert_refused("url: .*proxy", fetch_ycb, [NAME], tmp_path, url=server.url)


def test_command_shows_the_licence_of_a_complete_archive(server: Any, tmp_path: Path, printed: Command) -> None:
    """A complete archive, which an earlier command has downloaded, is not sent again."""
    (tmp_path / f".{NAME}.tgz").write_bytes(server.files[f"/google/{NAME}_google_16k.tgz"])
    out = printed("fetch", "ycb", "--objects", NAME, "--out", tmp_path, "--url", server.url, "--quiet")
    assert "CC BY 4.0" in out and (tmp_path / NAME / "textured.obj").read_bytes() == OBJ
