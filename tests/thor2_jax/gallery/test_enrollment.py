"""Enrolling, forgetting and answering with galleries; the weights are random, since accuracy is not checked."""

import dataclasses
import functools
import json
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from image_files import frame_of_squares
from processes import HANG
from refusals import assert_refused
from small_runs import small_embedding, untrained_run
from written_files import files_of

import thor2_jax as thor2
from thor2_jax.frames.prepared_instance import PreparedInstance, instance_view
from thor2_jax.gallery import store
from thor2_jax.gallery.compact_clouds import CompactClouds
from thor2_jax.gallery.enrollment import ObjectGallery, views_to_embed
from thor2_jax.gallery.gallery import Gallery
from thor2_jax.model.fusion import Calibration
from thor2_jax.model.inference import Inference, answers
from thor2_jax.model.model import Model
from thor2_jax.model.run_directory import EMBEDDING_FILE, TrainedRun, load_run, save_run
from thor2_jax.surfaces.surfaces import Surfaces
from training.objects.builtin_objects import builtin_objects

embedding = functools.cache(small_embedding)
run = functools.cache(lambda: untrained_run(("a", "b", "c"), ("tops", "tops2")))

RED, BLUE = (10, 10, (220, 30, 30)), (60, 100, (30, 40, 220))
BRICK, BOOK = frame_of_squares({1: RED}), frame_of_squares({1: BLUE})
CLUTTER = frame_of_squares({1: RED, 2: BLUE, 3: (70, 20, (90, 200, 60))})


def taught(run: TrainedRun, **options: object) -> thor2.Recognizer:
    recognizer = thor2.Recognizer(run, embedding=embedding(), **options)  # type: ignore[arg-type]
    recognizer.enroll("brick", [BRICK, frame_of_squares({1: (11, 10, RED[2])})])
    recognizer.enroll("book", [BOOK])
    return recognizer


def test_enrolled_objects_are_recognized_without_training() -> None:
    recognizer = taught(untrained_run((), ()))
    assert recognizer.classes == ("brick", "book") and recognizer.model.answers_by() == "gallery"
    answers = recognizer.recognize(frame_of_squares({1: (20, 15, (200, 40, 50)), 2: (65, 90, (50, 60, 200))}))
    assert [answer.name for answer in answers] == ["brick", "book"]
    for answer in answers:
        assert answer.classifier == "gallery" and list(answer.top) == ["gallery"] and answer.confidence is not None
        assert answer.top["gallery"][0] == (answer.name, pytest.approx(answer.confidence))


def test_a_model_says_what_it_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    objects = ObjectGallery(tuple(builtin_objects()))
    assert objects.gallery.summary == "18 toy objects of the demo; none of yours"
    objects.forget("apple")
    assert objects.gallery.summary.startswith("17 toy objects")
    objects = taught(run()).objects
    assert objects.gallery.summary == "5 objects: a, b, c, brick, book"
    packaged = ObjectGallery(())
    assert packaged.gallery.summary == "no object yet" and not packaged.weak_rejection
    packaged.add({"brick": objects.gallery.objects["brick"]})
    assert packaged.gallery.references is packaged.embedding.references is not None
    alone = taught(untrained_run((), ())).objects
    assert alone.weak_rejection.startswith("enrolled objects with fewer than 10 views: 2 of 2 (")
    monkeypatch.setattr("thor2_jax.gallery.enrollment.FEW", 2)
    assert ": 1 of 2 (" in alone.weak_rejection
    alone.forget("book")
    assert "without reference views: 1;" in alone.weak_rejection
    monkeypatch.setattr("thor2_jax.gallery.enrollment.FEW", 1)
    assert not alone.weak_rejection
    assert_refused("on disk", alone.undo, 0)
    assert ObjectGallery(tuple("abcdefg")).gallery.summary.endswith("e, ..., g")


def test_both_answers_by_the_union_of_classes() -> None:
    recognizer = taught(run())
    assert recognizer.model.answers_by() == "both" and recognizer.classes == ("a", "b", "c", "brick", "book")
    for answer in recognizer.recognize(CLUTTER):
        assert list(answer.top) == ["tops", "tops2", "gallery"] and 0 <= answer.confidence <= 1  # type: ignore[operator]
    by_classifiers = recognizer.recognize(CLUTTER, answer_by="classifiers")
    expected = thor2.Recognizer(run()).recognize(CLUTTER)
    assert [(a.name, a.confidence) for a in by_classifiers] == [(a.name, a.confidence) for a in expected]


def test_the_record_and_the_argument_choose_what_answers() -> None:
    stored = taught(dataclasses.replace(run(), record={"answer_by": "gallery"}))
    assert (stored.model.answers_by(), stored.model.answers_by("both")) == ("gallery", "both")
    assert taught(run(), answer_by="classifiers").model.answers_by() == "classifiers"
    assert_refused("answer_by is 'all'", thor2.Recognizer, run(), answer_by="all")


CALIBRATION = dataclasses.asdict(Calibration(0.0, 1.0, 0.0, 1.0, unknown_below=0.625))


def test_the_default_thresholds_of_each_source() -> None:
    """A trained class has the run's threshold, an object that of its views; brick has two, and book one.

    The scores .3118 and .255 have the odds (.3118 / .2)^3 and (.255 / .2)^3, hence .791 and .675. A class with a view
    has .789 = (.625 + m) / (1 + m), where m = (1 - .625) .675 / (1 - .675).
    """
    calibrated, plain = taught(dataclasses.replace(run(), record={"calibration": CALIBRATION})), taught(run())
    for recognizer in (calibrated, plain):
        recognizer.enroll("b", [BRICK], extend=True)
    calibrated.enroll("c", [BRICK], replace=True)
    assert calibrated.classes == ("a", "b", "brick", "book", "c")
    assert calibrated.thresholds().round(4).tolist() == [0.625, 0.7892, 0.791, 0.675, 0.675]
    assert calibrated.thresholds("gallery")[1:].tolist() == [0.675, 0.791, 0.675, 0.675]
    assert plain.thresholds().tolist() == [0, 0, 0, 0.791, 0.675]
    explicit = taught(run(), unknown_below=0.25)
    assert explicit.thresholds().tolist() == explicit.thresholds("gallery").tolist() == [0.25] * 5
    assert thor2.Recognizer(run()).model.thresholds().tolist() == [0, 0, 0]


NAMED = {0.67: [None, None], 0.68: [None, "book"], 0.79: [None, "book"], 0.8: ["brick", "book"]}
"""Score -> the name of an instance that has it for the brick, and of one that has it for the book."""


@pytest.mark.parametrize("unknown_below", [None, 0.0])
def test_a_gallery_alone_rejects_unknown_objects(unknown_below: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Values as given: the brick has two views and is named from .791, the book has one and is named from .675."""
    instance, inference = instance_view(CLUTTER, 1, 2.5), Inference(np.zeros(1), {}, scores=np.zeros((1, 2)))
    recognizer = taught(untrained_run((), ()), unknown_below=unknown_below)
    for score, names in NAMED.items():
        for column, name in enumerate(["brick", "book"] if unknown_below == 0 else names):
            values = np.eye(2, dtype=np.float32)[[column]] * score
            monkeypatch.setattr(Model, "combined", lambda *_, values=values: values)
            (answer,) = answers(recognizer.model, [instance], inference)
            assert answer.name == name and (answer.reason is None) == (name is not None)
            assert answer.reason is None or answer.reason.startswith("unknown: ")


def test_a_refused_name_leaves_no_directory(tmp_path: Path) -> None:
    objects = ObjectGallery(("a", "b"), embedding())
    objects.open(tmp_path / "gallery")
    assert_refused("mug", objects.forget, "mug")
    assert not (tmp_path / "gallery").exists()


def test_a_relative_gallery_stays_where_it_was_opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    objects = ObjectGallery(("a",), embedding())
    objects.open(Path("gallery"))
    monkeypatch.chdir("other")
    objects.forget("a")
    assert (tmp_path / "gallery" / "index.json").is_file()


def test_a_forgotten_class_is_never_answered() -> None:
    recognizer = thor2.Recognizer(dataclasses.replace(run(), embedding=embedding()))
    first = {answer.name for answer in recognizer.recognize(CLUTTER)}
    for name in first:
        recognizer.forget(name)  # type: ignore[arg-type]
    left = set("abc") - first
    assert set(recognizer.classes) == left
    for answer in recognizer.recognize(CLUTTER):
        assert answer.name in left or (answer.name is None and not left)
        assert all(name in left for top in answer.top.values() for name, _ in top)
    assert_refused("name", recognizer.forget, next(iter(first)))


def test_threads_do_not_lose_changes_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    recognizer, with_object = taught(run()), Gallery.with_object
    objects = recognizer.objects

    def slowly(gallery: Gallery, *given: Any, **options: Any) -> Gallery:
        time.sleep(0.02)
        return with_object(gallery, *given, **options)

    monkeypatch.setattr(Gallery, "with_object", slowly)
    with ThreadPoolExecutor(4) as threads:
        for name in "defg":
            threads.submit(objects.add, {name: objects.gallery.objects["brick"]})
    assert set(objects.gallery.names) == {"brick", "book", *"defg"}


def test_a_change_waits_for_other_threads_only_so_long(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    objects = ObjectGallery((), embedding())
    objects.open(tmp_path / "new" / "gallery")
    objects.lock_seconds = 0.1
    with ThreadPoolExecutor(1) as threads:
        monkeypatch.setattr(store, "previous_gallery", lambda *_: threads.submit(objects.undo, 1).result(HANG))
        assert_refused("another process", objects.undo, 1)
    assert files_of(tmp_path) == {}


def test_unusable_views_are_refused_and_nothing_changes() -> None:
    recognizer = taught(run())
    before = recognizer.gallery
    assert_refused(r"frames\[1\].*3 instances", recognizer.enroll, "new", [BRICK, CLUTTER])
    assert_refused("instance is 9", recognizer.enroll, "new", [(CLUTTER, 9)])
    assert_refused("instance is 9", recognizer.enroll, "new", [[CLUTTER, 9]])
    assert_refused("cannot be used", recognizer.enroll, "new", [frame_of_squares({1: RED}, 3)])
    assert_refused("views is empty", recognizer.enroll, "new", [])
    recognizer.enroll("brick", [(CLUTTER, 1), BRICK], extend=True)  # it has both views already
    assert recognizer.gallery is before


def test_a_view_that_is_given_twice_counts_once() -> None:
    """This includes a view that comes from another gallery."""
    recognizer, other = taught(run()), taught(run())
    recognizer.enroll("new", [BRICK, (CLUTTER, 1), BRICK])
    recognizer.enroll("new", [BRICK, BOOK, BOOK], extend=True)
    other.enroll("new", [BRICK, (CLUTTER, 3)])
    for added in (recognizer, other):
        recognizer.objects.add({"new": added.gallery.objects["new"]}, extend=True)
    expected = CompactClouds.of([instance_view(CLUTTER, label, 2.5) for label in (1, 2, 3)])
    jax.tree.map(np.testing.assert_array_equal, vars(recognizer.gallery.objects["new"].clouds), vars(expected))


def test_views_of_another_gallery_are_not_rounded_again() -> None:
    points = np.random.default_rng(0).random((4, 50, 3), np.float32) / 10
    views = [PreparedInstance(0, each, np.zeros((50, 3), np.uint8), np.zeros(50, bool)) for each in points]
    objects, other = taught(run()).objects, taught(run()).objects
    objects.enroll("new", views[:1], "frames")
    other.enroll("new", views, "frames")
    objects.add({"new": other.gallery.objects["new"]}, extend=True)
    expected = vars(CompactClouds.of(views))
    jax.tree.map(np.testing.assert_array_equal, vars(objects.gallery.objects["new"].clouds), expected)


def test_a_first_surface_comes_with_views_that_are_stored() -> None:
    objects, views = taught(untrained_run((), ())).objects, [instance_view(CLUTTER, 1, 2.5)]
    surface = Surfaces.empty().arrays
    for number, (given, count) in enumerate(((None, 1), (None, 1), (surface, 2), (surface, 2))):
        objects.enroll("mesh", views, "mesh", given, extend=number > 0)
        enrolled = objects.gallery.objects["mesh"]
        assert enrolled.surface is given and len(enrolled.clouds) == count


def test_surfaces_of_objects_are_unknown_to_classifiers_alone() -> None:
    for answer_by in ("both", "gallery", "classifiers"):
        recognizer = taught(run(), answer_by=answer_by)
        recognizer.objects.enroll("mesh", [instance_view(CLUTTER, 1, 2.5)], "mesh", Surfaces.empty().arrays)
        assert (recognizer.model.surface_of("mesh") is None) == (answer_by == "classifiers")
        assert recognizer.model.surface_of("brick") is recognizer.model.surface_of("a") is None


def test_views_get_augmented_copies() -> None:
    recognizer = taught(untrained_run((), ()))
    views = [instance_view(CLUTTER, label, 2.5) for label in (1, 2)]
    two, ten = CompactClouds.of(views), CompactClouds.of(views * 5)
    embedded = views_to_embed(two, "frames")
    assert len({each.points.tobytes() for each in embedded}) == 2 + 8 and len(views_to_embed(ten, "frames")) == 10
    assert len(views_to_embed(ten, "mesh")) == len(views_to_embed(ten, "mesh and frames")) == 10 + 10
    for copy, again in zip(embedded, views_to_embed(two, "frames"), strict=True):
        np.testing.assert_array_equal(copy.points, again.points)
        assert len(copy.points) == len(copy.colors) == len(copy.boundary) >= 30
    assert (views_to_embed(two, "mesh")[2].colors != embedded[2].colors).any()  # a larger colour cast
    for source, count in (("mesh", 8), ("frames", 20)):
        recognizer.objects.enroll(source, views, source)
        assert len(recognizer.gallery.objects[source].embeddings) == count


def test_a_run_directory_keeps_its_gallery(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also if another writer forgets an object as soon as it is enrolled."""
    path = tmp_path / "run"
    save_run(dataclasses.replace(untrained_run((), ()), embedding=embedding()), path)
    assert load_run(path).classes == ()
    first, second = thor2.Recognizer.load(path), thor2.Recognizer.load(path)
    assert first.recognize(CLUTTER)[0].name is None
    first.enroll("brick", [(CLUTTER, 1)])
    assert second.classes == () and second.objects.refresh() and not second.objects.refresh()
    second.enroll("book", [(CLUTTER, 2)])
    assert first.objects.refresh() and first.classes == second.classes == ("brick", "book")
    assert first.recognize(CLUTTER) == second.recognize(CLUTTER) == thor2.Recognizer.load(path).recognize(CLUTTER)
    elsewhere = thor2.Recognizer.load(path, gallery=tmp_path / "elsewhere")
    elsewhere.enroll("pen", [(CLUTTER, 3)])
    assert first.objects.refresh() is False and (tmp_path / "elsewhere" / "index.json").is_file()
    update = store.update_gallery

    def overtaken(directory: Path, *given: Any) -> Gallery:
        changed = update(directory, *given)
        update(directory, lambda gallery: gallery.without("pen"))
        return changed

    monkeypatch.setattr(store, "update_gallery", overtaken)
    first.enroll("pen", [(CLUTTER, 3)])
    assert first.classes == ("brick", "book")


def test_an_object_forgotten_elsewhere_is_enrolled_again(tmp_path: Path) -> None:
    save_run(dataclasses.replace(untrained_run((), ()), embedding=embedding()), tmp_path)
    first, second = thor2.Recognizer.load(tmp_path), thor2.Recognizer.load(tmp_path)
    for extend in (False, False, True):
        first.enroll("brick", [BRICK], extend=extend)
        assert thor2.Recognizer.load(tmp_path).classes == ("brick",)
        second.forget("brick")


def test_another_embedding_embeds_the_views_again(tmp_path: Path) -> None:
    path, other = tmp_path / "run", small_embedding(1)
    save_run(untrained_run((), ()), path)
    embedding().save(path / EMBEDDING_FILE)
    before = thor2.Recognizer.load(path)
    before.enroll("brick", [(CLUTTER, 1)])
    index = path / "gallery" / "index.json"
    index.write_text(index.read_text().replace(before.gallery.objects["brick"].date, "2026-01-02"))
    other.save(path / EMBEDDING_FILE)
    assert_refused("gallery.*reembed", thor2.Recognizer.load, path)
    meanwhile = functools.partial(before.enroll, "book", [(CLUTTER, 2)], extend=True)  # needs the lock when it is new
    ObjectGallery((), other).open(path / "gallery", reembed=True, report=lambda *_: meanwhile())
    expected = thor2.Recognizer(dataclasses.replace(untrained_run((), ()), embedding=other))
    for label, name in enumerate(("brick", "book"), 1):
        expected.enroll(name, [(CLUTTER, label)])
        embeddings = thor2.Recognizer.load(path).gallery.objects[name].embeddings
        np.testing.assert_array_equal(embeddings, expected.gallery.objects[name].embeddings)
    assert json.loads(index.read_text())["embedding"] == other.fingerprint
    assert thor2.Recognizer.load(path).gallery.objects["brick"].date == "2026-01-02"


def test_combined_values_of_classes_and_objects() -> None:
    gallery = Gallery("", dict.fromkeys(("x", "b")), ("c",), ("a", "b", "c"))  # type: ignore[arg-type]
    assert gallery.answered_names == ("a", "b", "x")
    p, s = np.array([[0.5, 0.4, 0.1]]), np.array([[0.25, 0.9]])
    np.testing.assert_allclose(gallery.of_classifiers(p), [[0.5, 0.4, 0]])
    np.testing.assert_allclose(gallery.of_gallery(s), [[0, 0.9, 0.25]])
    # The best class leaves 0.5; odds of 1.95 and 91.1. The best share, that of b, gets the probability of being known.
    x, b = 0.5 * (0.25 / 0.2) ** 3, 0.5 * 4.5**3
    known = (0.5 + b) / (1 + b)
    np.testing.assert_allclose(gallery.combine(p, s), known * np.array([[0.5, 0.4 + b, x]]) / (0.4 + b))
    np.testing.assert_allclose(gallery.combine(None, s), 2 * np.array([[0, b, x]]) / (1 + 2 * b))
    x = 0.5 * 0.8**3  # below the best class, which keeps its confidence
    np.testing.assert_allclose(gallery.combine(p, np.array([[0.16, 0]])), [[0.5, 0.4, x]])
    nothing = gallery.combine(None, np.zeros((1, 2)))
    assert nothing == pytest.approx(0) and gallery.answered_names[nothing.argmax()] in gallery.objects
    same = Gallery("", trained=("a", "b"))
    assert same.combine(p[:, :2], np.zeros((1, 0))) == pytest.approx(p[:, :2])
