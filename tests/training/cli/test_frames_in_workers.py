"""Frames that worker processes recognize and evaluate: equal answers, workers that die, Ray nodes that die."""

import dataclasses
import json
import pickle
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_thor2
from image_files import small_frame, write_frame_files
from processes import wait_until
from recording_files import table_frame
from rendered_objects import write_meshes

from thor2_jax.errors import InputError
from thor2_jax.gallery.store import GALLERY_DIRECTORY, load_gallery
from training.evaluation.job import answer_frames, answer_frames_in_pool, load_runs
from training.frame_recognition import RecognizerArguments, recognize_frames
from training.readers.frames import FrameFolder, find_frames, segmented_source

N_FRAMES = 9


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    for number in range(N_FRAMES):
        write_frame_files(folder / f"{number:03d}", small_frame(number), {1: "mug", 4: "bowl"})
    return folder


def test_folders_may_hold_links_to_frames(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    for name, target in (("000", "000"), ("002", "002"), ("a/b", "001"), ("a/c", tmp_path), ("all", ".")):
        (tmp_path / name).symlink_to(folder / target, target_is_directory=True)
    assert [one.name for one in find_frames([tmp_path])] == ["000", "002", "a/b", *(f"all/00{k}" for k in "345678")]


@pytest.mark.slow
def test_workers_segment_and_recognize_as_one_process_does(model: Path, tmp_path: Path) -> None:
    arguments = RecognizerArguments(model)
    for number in range(2):
        write_frame_files(tmp_path / f"{number}", table_frame(3 * number))
    sources = [segmented_source(source, arguments.segment) for source in find_frames([tmp_path])]
    expected = list(recognize_frames(arguments.load().recognize, sources))
    answers = [pickle.loads(pickle.dumps(arguments.answer))(source) for source in pickle.loads(pickle.dumps(sources))]
    assert [answer.as_json() for answer in answers] == [answer.as_json() for answer in expected]
    for one, other in zip(answers, expected, strict=True):
        assert one.frame is not None and other.frame is not None
        np.testing.assert_array_equal(one.frame.labels, other.frame.labels)
        sent = vars(pickle.loads(pickle.dumps(one.frame)))
        assert vars(one.frame).keys() > sent.keys() == {field.name for field in dataclasses.fields(one.frame)}


def test_answers_before_an_unreadable_frame_are_kept(model: Path, folder: Path, tmp_path: Path) -> None:
    arguments, damaged = ((model,), None), Path(shutil.copytree(folder, tmp_path / "frames"))
    expected = answer_frames(load_runs(*arguments), FrameFolder(folder))
    (damaged / "006" / "depth.png").write_bytes(b"damaged")
    frames, answers = FrameFolder(damaged), []

    def pool(answer: Callable[[FrameFolder], Any], parts: Iterable[FrameFolder]) -> Iterator[Any]:
        for part in parts:
            assert len(part) == 1  # workers get no other frames
            yield answer(part)

    with pytest.raises(InputError, match="depth"):
        for answer in answer_frames_in_pool(arguments, frames, pool, range(len(frames))):
            answers.append(answer)
    assert [answer.frame for answer in answers] == [f"{number:03d}" for number in range(6)]
    for one, other in zip(answers, expected, strict=False):
        for instance, again in zip(one.instances, other.instances, strict=True):
            np.testing.assert_array_equal(instance.probabilities, again.probabilities)


def results(model: Path, folder: Path, out: Path, *options: object) -> tuple[dict[str, Any], dict[str, Any]]:
    """Recognize and evaluate the frames, and return the answers and the report without the times."""
    assert run_thor2("recognize", "--model", model, folder, "--out", out / "answers", *options) == 0
    assert run_thor2("evaluate", "frames", folder, "--model", model, "--out", out / "report", *options) == 0
    answers = {path.parent.name: json.loads(path.read_text()) for path in out.glob("answers/*/recognition.json")}
    assert len(answers) == N_FRAMES
    report = json.loads((out / "report" / "report.json").read_text())
    return answers, {name: value for name, value in report.items() if name != "speed"}


@pytest.fixture(scope="module")
def expected(model: Path, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The results of one process."""
    return results(model, folder, tmp_path_factory.mktemp("expected"))


@pytest.mark.slow
def test_two_workers_have_the_results_of_one_process(model: Path, folder: Path, tmp_path: Path, expected: Any) -> None:
    assert results(model, folder, tmp_path, "--workers", 2) == expected


@pytest.mark.slow
@pytest.mark.filterwarnings(r"ignore:os\.fork\(\) was called:RuntimeWarning")  # Ray's forks execute another program.
def test_two_ray_nodes_enroll_and_recognize_and_one_is_killed(
    model: Path, folder: Path, tmp_path: Path, expected: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray", reason="the extra [cluster] is not installed")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    from ray.cluster_utils import Cluster

    meshes = write_meshes(tmp_path / "meshes", ("mug_white", "soup_can_red"))

    def enrolled(out: Path, *options: object) -> dict[str, bytes]:
        assert run_thor2("enroll", "--mesh", meshes, "--model", out, *options) == 0
        objects = load_gallery(out / GALLERY_DIRECTORY).objects
        return {name: views.embeddings.tobytes() for name, views in objects.items()}

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        node = cluster.add_node(num_cpus=1)
        on_nodes = "--workers", 2, "--engine", "ray", "--address", cluster.address
        assert enrolled(tmp_path / "on-nodes", *on_nodes) == enrolled(tmp_path / "here", "--workers", 1)

        def lose_node() -> None:
            wait_until(lambda: (tmp_path / "answers" / "000").exists())
            cluster.remove_node(node, allow_graceful=False)

        with ThreadPoolExecutor(1) as thread:
            lost = thread.submit(lose_node)
            assert results(model, folder, tmp_path, *on_nodes) == expected
        lost.result()
    finally:
        cluster.shutdown()
