"""Galleries on disk: atomic changes, concurrent writers, and damaged files."""

import dataclasses
import functools
import hashlib
import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import safetensors.numpy
from processes import finish_programs, start_program
from refusals import assert_refused
from small_clouds import random_clouds
from written_files import files_of, files_of_the_user, killed

from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.gallery import store
from thor2_jax.gallery.compact_clouds import CompactClouds
from thor2_jax.gallery.gallery import Gallery, GalleryObject
from thor2_jax.gallery.store import GalleryError, check_index, gallery_stamp, load_gallery, update_gallery
from training.objects.builtin_objects import builtin_objects
from training.objects.surfaces import surfaces_of

FINGERPRINT = "f" * 64


def enrolled(seed: int, n_views: int = 2) -> GalleryObject:
    embeddings = np.random.default_rng(seed).normal(size=(2 * n_views, 16))
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    views = [PreparedInstance(1, *cloud, np.zeros(50, bool)) for cloud in random_clouds(seed, [50] * n_views)]
    return GalleryObject(embeddings.astype(np.float16), CompactClouds.of(views), "frames", "2026-01-02")


def add(name: str, seed: int, **options: bool) -> Callable[[Gallery], Gallery]:
    return lambda gallery: gallery.with_object(name, enrolled(seed), **options)


def undo(directory: Path, generation: int) -> Callable[[Gallery], Gallery]:
    return functools.partial(store.previous_gallery, directory, generation)


def object_files(gallery: Gallery) -> dict[str, str | None]:
    return {name: views.file for name, views in gallery.objects.items()}


def assert_unusable(match: str, directory: Path, fingerprint: str = FINGERPRINT) -> None:
    """Assert that a gallery can neither be loaded nor changed."""
    before = files_of(directory)
    with pytest.raises(GalleryError, match=match):
        load_gallery(directory, fingerprint)
    with pytest.raises(GalleryError, match=match):
        update_gallery(directory, add("new", 5), fingerprint)
    assert files_of(directory) == before


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    path = tmp_path / "my run" / "gallery"
    for seed, name in enumerate(("mug", "bowl")):
        update_gallery(path, add(name, seed), FINGERPRINT)
    return path


def test_surfaces_are_stored_with_their_object(directory: Path) -> None:
    meshes = builtin_objects()
    can, box = (surfaces_of([meshes[name]]).arrays for name in ("soup_can_red", "yellow_box"))
    for name, seed, surface in (("mug", 2, can), ("bowl", 3, can), ("mug", 4, None), ("bowl", 5, box)):
        views = dataclasses.replace(enrolled(seed), surface=surface)
        update_gallery(directory, lambda g, name=name, views=views: g.with_object(name, views, extend=True))
    loaded = load_gallery(directory, FINGERPRINT)
    assert list(loaded.surfaces) == [0, 1] and json.loads((directory / "index.json").read_text())["format"] == 2
    for surface, expected in zip(loaded.surfaces.values(), (can, box), strict=True):
        np.testing.assert_equal(surface.arrays, expected)
    update_gallery(directory, add("mug", 6, replace=True), FINGERPRINT)
    assert list(load_gallery(directory, FINGERPRINT).surfaces) == [1]


def test_what_is_loaded_is_what_was_stored(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other writers replace the index that was read: two of them files of objects, too, and a third one no file."""
    load_objects, failures = store._load_objects, [FileNotFoundError] * 2

    def load(path: Path, index: dict[str, object], known: Gallery | None) -> Gallery:
        os.utime(path / "index.json", (len(failures),) * 2)
        if failures:
            raise failures.pop()
        return load_objects(path, index, known)

    monkeypatch.setattr(store, "_load_objects", load)
    stored = load_gallery(directory, FINGERPRINT)
    assert stored.stamp != gallery_stamp(directory)
    assert stored.names == ("mug", "bowl") and stored.generation == 2
    for seed, views in enumerate(stored.objects.values()):
        expected = enrolled(seed)
        np.testing.assert_array_equal(views.embeddings, expected.embeddings)
        np.testing.assert_equal(vars(views.clouds), vars(expected.clouds))
        assert (views.source, views.date) == ("frames", "2026-01-02")
    (first, _) = json.loads((directory / "index.json").read_text())["objects"]
    assert {**first, "file": ""} == {"name": "mug", "file": "", "views": 2, "source": "frames", "date": "2026-01-02"}


def test_a_file_is_no_gallery(tmp_path: Path) -> None:
    for name, gallery in (("gallery", tmp_path / "gallery"), ("objects", tmp_path)):
        (tmp_path / name).write_text("mine")
        with pytest.raises(GalleryError, match=f"{name} is not a directory"):
            check_index(gallery)


def test_forgetting_restores_the_gallery_and_removes_the_file(directory: Path) -> None:
    before, stamp = files_of(directory), gallery_stamp(directory)
    update_gallery(directory, add("new", 5), FINGERPRINT)
    assert gallery_stamp(directory) != stamp
    for folder in (directory, directory / "objects"):
        killed(folder)
    update_gallery(directory, lambda gallery: gallery.without("new"), FINGERPRINT)
    assert update_gallery(directory, lambda gallery: gallery, FINGERPRINT).hidden == ()
    after = files_of(directory)
    assert after.keys() == before.keys()
    assert all(after[name] == before[name] for name in before if not name.endswith(".json"))


def test_undo_restores_the_gallery_and_its_files(directory: Path) -> None:
    before = load_gallery(directory)
    changed = update_gallery(directory, add("mug", 5, replace=True), FINGERPRINT)
    undone = update_gallery(directory, undo(directory, changed.generation), FINGERPRINT, changed)
    again = load_gallery(directory)
    assert undone.generation == again.generation == changed.generation + 1
    assert object_files(undone) == object_files(again) == object_files(before)
    assert undone.stamp == gallery_stamp(directory)
    np.testing.assert_array_equal(again.objects["mug"].embeddings, enrolled(0).embeddings)
    update_gallery(directory, undo(directory, undone.generation))  # restores the change
    assert object_files(load_gallery(directory)) == object_files(changed)


def test_undo_of_the_first_change_empties_the_gallery(tmp_path: Path) -> None:
    changed = update_gallery(tmp_path, add("mug", 0), FINGERPRINT)
    assert update_gallery(tmp_path, undo(tmp_path, changed.generation), FINGERPRINT).names == ()
    assert update_gallery(tmp_path, add("mug", 0), FINGERPRINT).names == ("mug",)


ENTRY = {"name": "a", "file": 64 * "0", "source": "", "date": ""}
UNDO_FAULTS: dict[str, Callable[[Path], object]] = {
    "changed since": lambda path: update_gallery(path, add("new", 5), FINGERPRINT),
    "no former index": lambda path: (path / "previous.json").unlink(),
    "damaged former index": lambda path: (path / "previous.json").write_text("{"),
    "older former index": lambda path: edit(path / "previous.json", generation=0),
    "embedded again since": lambda path: edit(path / "previous.json", embedding="0" * 64),
    "missing files": lambda path: edit(path / "previous.json", objects=[ENTRY]),
}


@pytest.mark.parametrize("fault", UNDO_FAULTS)
def test_undo_refuses_in_one_line_and_changes_nothing(fault: str, directory: Path) -> None:
    UNDO_FAULTS[fault](directory)
    before = files_of(directory)
    assert_refused("generation is 2", update_gallery, directory, undo(directory, 2), FINGERPRINT)
    assert files_of(directory) == before


def test_a_known_state_is_neither_read_again_nor_restored(directory: Path) -> None:
    stored = load_gallery(directory)
    changed = update_gallery(directory, add("new", 5), FINGERPRINT, stored)
    again = load_gallery(directory, FINGERPRINT, changed)
    assert again.names == ("mug", "bowl", "new")
    assert [v.clouds for v in again.objects.values()] == [v.clouds for v in changed.objects.values()]
    assert update_gallery(directory, add("box", 6), FINGERPRINT, stored).names == ("mug", "bowl", "new", "box")


def test_a_removed_file_of_a_known_object_is_written_again(directory: Path) -> None:
    stored = load_gallery(directory)
    before = files_of(directory / "objects")
    shutil.rmtree(directory / "objects")
    update_gallery(directory, lambda gallery: gallery, FINGERPRINT, stored)
    assert files_of(directory / "objects") == before and load_gallery(directory).names == stored.names


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
@pytest.mark.parametrize("failing", ["_object_content", "write_text", "_write_durably", "os.fsync"])
def test_a_failed_change_leaves_the_gallery_as_it_was(
    failing: str, error: type[BaseException], directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = files_of(directory)
    monkeypatch.setattr(f"thor2_jax.gallery.store.{failing}", mock.Mock(side_effect=error))
    with pytest.raises(error):
        update_gallery(directory, lambda gallery: add("new", 5)(add("mug", 0, replace=True)(gallery)), FINGERPRINT)
    assert files_of(directory) == before


def test_a_change_that_is_interrupted_at_its_end_is_complete(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_text = store.write_text
    monkeypatch.setattr(store, "write_text", lambda *given: [write_text(*given), signal.raise_signal(signal.SIGINT)])
    with pytest.raises(KeyboardInterrupt):
        update_gallery(directory, add("new", 5), FINGERPRINT)
    assert load_gallery(directory, FINGERPRINT).names == ("mug", "bowl", "new")


def test_a_gallery_of_another_embedding_is_refused(directory: Path) -> None:
    assert_unusable("embedding ffffffff.*00000000", directory, "0" * 64)


def test_files_and_links_of_the_user_stay_and_hinder_nothing(directory: Path, tmp_path: Path) -> None:
    (link,) = (directory / "objects").glob(f"{load_gallery(directory).objects['mug'].file}.*")
    link.rename(tmp_path / link.name)
    link.symlink_to(tmp_path / link.name)
    content_addressed = hashlib.sha256(b"a user's").hexdigest()
    names = [f"objects/{name}" for name in ("scan.ply", ".DS_Store", f"{content_addressed}.safetensors", "a/b.txt")]
    names += ["previous.json", ".index.backup12.json", ".vimrc.original", "notes.txt"]
    with files_of_the_user(*(directory / name for name in names)):
        for seed in (5, 6):
            update_gallery(directory, add("mug", seed, replace=True), FINGERPRINT)
    assert link.is_symlink() and (tmp_path / link.name).is_file()
    # Two objects, that of the change before, the user's file and the link.
    assert len(list((directory / "objects").glob("*.safetensors"))) == 2 + 1 + 1 + 1


def test_nothing_behind_a_symbolic_link_is_removed(directory: Path, tmp_path: Path) -> None:
    (directory / "objects").rename(tmp_path / "shared")
    (directory / "objects").symlink_to(tmp_path / "shared")
    before = files_of(tmp_path / "shared")
    for seed in (5, 6):
        update_gallery(directory, add("mug", seed, replace=True), FINGERPRINT)
    assert before.items() <= files_of(tmp_path / "shared").items()


def test_a_lost_index_is_refused_and_rebuilt(directory: Path) -> None:
    update_gallery(directory, add("mug", 5, replace=True), FINGERPRINT)
    expected = load_gallery(directory)
    for names in (("index.json",), ("index.json", "previous.json")):
        for name in names:
            (directory / name).unlink(missing_ok=True)
        assert_unusable(f"{directory}.*thor2 objects --reembed .* '{directory}'", directory)
        rebuilt = update_gallery(directory, functools.partial(dataclasses.replace, embedding=FINGERPRINT))
        assert rebuilt.generation == {1: expected.generation + 1, 2: 1}[len(names)]
        if len(names) == 1:  # Without the former index, the two files of the mug are equally old.
            assert object_files(rebuilt) == object_files(expected)
        for name, views in load_gallery(directory, FINGERPRINT).objects.items():
            other = expected.objects[name]
            assert (len(views.clouds), views.source, views.date) == (len(other.clouds), other.source, other.date)


def test_galleries_of_older_versions_are_read_and_rebuilt(directory: Path) -> None:
    index = json.loads((directory / "index.json").read_text())
    for entry, name in zip(index["objects"], ("mug ", "unknown"), strict=True):
        path = directory / "objects" / f"{entry['file']}.safetensors"
        content = safetensors.numpy.save(safetensors.numpy.load_file(path))  # without a name, as of earlier versions
        entry |= {"name": name, "file": hashlib.sha256(content).hexdigest()}
        path.unlink()
        path.with_name(f"{entry['file']}.safetensors").write_bytes(content)
        del entry["source"], entry["date"]
    for name in ("index.json", "previous.json"):
        (directory / name).write_text(json.dumps(index))
    assert load_gallery(directory, FINGERPRINT).names == ("mug ", "unknown")
    changed = update_gallery(directory, add("mug", 5, extend=True), FINGERPRINT)
    assert {name: len(views.clouds) for name, views in changed.objects.items()} == {"mug ": 4, "unknown": 2}
    assert changed.without("unknown").names == ("mug ",)
    for name in ("index.json", "previous.json"):
        (directory / name).unlink()
    names = update_gallery(directory, lambda gallery: gallery).names
    assert "mug " in names and sum(name.startswith("object-") for name in names) == 2


DAMAGES: dict[str, Callable[[Path], object]] = {
    "cut index": lambda path: (path / "index.json").write_text('{"format": 1'),
    "a list": lambda path: (path / "index.json").write_text("[]"),
    "other format": lambda path: edit(path / "index.json", format=3),
    "no objects": lambda path: edit(path / "index.json", objects=[{}]),
    "an object twice": lambda path: edit(path / "index.json", objects=[ENTRY, ENTRY]),
    "a text as number": lambda path: edit(path / "index.json", generation="2"),
    "a folder as file": lambda path: [file.unlink() or file.mkdir() for file in (path / "objects").iterdir()],
    "a folder as index": lambda path: (path / "index.json").unlink() or (path / "index.json").mkdir(),
    "other path": lambda path: edit(path / "index.json", objects=[ENTRY | {"file": "../../x"}]),
    "hidden surrogate": lambda path: edit(path / "index.json", hidden=["\ud800"]),
    "source surrogate": lambda path: edit(path / "index.json", objects=[ENTRY | {"source": "\ud800"}]),
    "missing file": lambda path: next((path / "objects").iterdir()).unlink(),
    "cut file": lambda path: os.truncate(next((path / "objects").iterdir()), 200),
    "file of another object": lambda path: shutil.copyfile(*(path / "objects").iterdir()),
}


def edit(path: Path, **changes: object) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_refused_in_one_line(damage: str, directory: Path) -> None:
    DAMAGES[damage](directory)
    assert_unusable(f"^gallery: .*{directory}", directory)
    if damage in ("missing file", "cut file"):  # The advice keeps the other object.
        (directory / "index.json").unlink()
        assert len(update_gallery(directory, functools.partial(dataclasses.replace, embedding=FINGERPRINT)).names) == 1


PROGRAM = """
import json, os, signal, sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from test_store import FINGERPRINT, add
from thor2_jax.gallery import store

def write(directory, names, step, after):
    if step:
        original = getattr(store, step)
        def killed(*arguments):
            if step == "_remove_orphans" or after:
                original(*arguments)
            os.kill(os.getpid(), signal.SIGKILL)
        setattr(store, step, killed)
    for name in names:
        store.update_gallery(Path(directory), add(name, len(name)), FINGERPRINT)

writers = []
for writer in json.loads(sys.argv[2]):
    writers.append(os.fork())
    if not writers[-1]:
        write(*writer)
        os._exit(0)
print(json.dumps([os.waitstatus_to_exitcode(os.waitpid(writer, 0)[1]) for writer in writers]))
"""


def write_at_once(*writers: tuple[Path, list[str], str, bool]) -> list[int]:
    """Enrol the names in each directory, each in its own process, and return their exit codes.

    A process with the name of a function of the store is killed before that step, or after it.
    """
    (out,) = finish_programs(start_program(PROGRAM, Path(__file__).parent, json.dumps(writers, default=str)))
    return json.loads(out)


STEPS = [("_write_durably", True), ("write_text", False), ("write_text", True)]


@pytest.mark.parametrize("is_first", [False, True])
def test_a_killed_writer_leaves_the_gallery_before_or_after(is_first: bool, directory: Path, tmp_path: Path) -> None:
    """A first change also writes an index, of the empty gallery, before that of the change."""
    steps = [("_write_durably", False) if is_first else ("_remove_orphans", True), *STEPS]
    paths = [tmp_path / str(k) for k in range(len(steps))]
    for path in [] if is_first else paths:
        shutil.copytree(directory, path)
    exits = write_at_once(*((path, ["new"], *step) for path, step in zip(paths, steps, strict=True)))
    assert exits == [-signal.SIGKILL] * len(steps)
    for path, step in zip(paths, steps, strict=True):
        names = () if is_first else ("mug", "bowl", *(["new"] if step == ("write_text", True) else []))
        assert load_gallery(path, FINGERPRINT).names == names, step
        assert update_gallery(path, add("box", 1), FINGERPRINT).names == (*names, "box"), step
        assert len(list((path / "objects").iterdir())) == len(names) + 1, step


def test_two_writers_at_once_both_succeed(directory: Path) -> None:
    names = [[f"a{k}" for k in range(12)], [f"b{k}" for k in range(12)]]
    assert write_at_once(*((directory, each, "", False) for each in names)) == [0, 0]
    assert set(load_gallery(directory).names) == {"mug", "bowl", *names[0], *names[1]}
