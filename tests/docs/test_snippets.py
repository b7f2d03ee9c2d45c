"""Every Python block of the pages is executed, with the names that its page has explained before.

Services, cameras and other packages are replaced by objects of the same interface: calls of a block must exist and
take these arguments.
"""

import doctest
import importlib
import json
import re
import sys
import types
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, create_autospec

import numpy as np
import pytest
from commands import run_thor2
from doc_pages import PAGES, ROOT, thor2_commands
from image_files import SAMPLES, patches, tilted, write_frame_files
from recording_files import table_frame
from small_clouds import random_clouds
from small_runs import save_untrained_run, untrained_run

import thor2_jax as thor2
from thor2_jax import recognizer as recognizer_module
from thor2_jax.client import Client
from thor2_jax.frames.frames import backproject
from thor2_jax.recordings import realsense
from thor2_jax.tracking.tracker import Tracker

BLOCKS = {
    **dict.fromkeys(["README.md", "docs/explain.md", "docs/index.md", "docs/objects.md", "docs/recordings.md"], 1),
    **{"docs/cameras.md": 2, "docs/segmentation.md": 3, "docs/service.md": 2, "docs/library.md": 10},
    "docs/tutorials/first-table.md": 1,
}
"""Page -> number of its Python blocks; each one is executed by a test."""

LIBRARY = "docs/library.md"
FRAME = tilted(np.where(patches() == 7, 2, patches()))
"""A frame with the labels of the examples, 2 and 3."""

((XYZ, RGB),) = random_clouds(0, [400])


def blocks_of(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def run_blocks(page: str, *numbers: int, **names: Any) -> dict[str, Any]:
    """Execute Python blocks of a page, in which `names` are defined, and return all names."""
    for number in numbers:
        exec(compile(blocks_of(page)[number], page, "exec"), names)
    return names


def test_every_python_block_is_executed() -> None:
    assert {page: len(blocks_of(page)) for page in PAGES if blocks_of(page)} == BLOCKS


@pytest.mark.slow
def test_examples_in_docstrings_give_what_they_show() -> None:
    files = [path for package in ("colornet", "thor2_jax", "training") for path in (ROOT / package).rglob("*.py")]
    modules = [str(path.relative_to(ROOT))[:-3].replace("/", ".") for path in files if ">>> " in path.read_text()]
    results = {name: doctest.testmod(importlib.import_module(name)) for name in modules}
    assert len(results) > 10 and not any(result.failed for result in results.values())


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to a folder with an untrained run, also where the demo writes its own."""
    monkeypatch.chdir(tmp_path)
    save_untrained_run(Path("run"), ("mug", "bowl"))
    Path("demo-report").symlink_to(".")
    return tmp_path


@pytest.mark.slow
def test_recognition(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The blocks of README and of tracks, objects and the recognizer's docstring."""
    folder = write_frame_files(run / "frame", FRAME)
    for source, target in {"color.png": "c.png", "depth.png": "d.png", "mask.png": "l.png"}.items():
        (folder / source).rename(target)
    (folder / "intrinsics.json").rename("k.json")
    names = run_blocks("README.md", 0)
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["2", "3", "5", "200"]
    run_blocks("docs/cameras.md", 0, recognizer=names["recognizer"], frames=[names["frame"]] * 2)
    assert [line.split()[-1] for line in capsys.readouterr().out.splitlines()] == [*"11012202"]
    run_blocks("docs/objects.md", 0, frame=FRAME, thor2=thor2)
    assert (run / "run" / "gallery").is_dir()
    names = {"Recognizer": thor2.Recognizer, "read_frame": thor2.read_frame}
    for example in doctest.DocTestParser().get_examples(str(recognizer_module.__doc__)):
        exec(compile(example.source, "thor2_jax.recognizer", "exec"), names)


@pytest.mark.slow
def test_landing_page_and_first_tutorial(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_blocks("docs/index.md", 0)
    assert len(capsys.readouterr().out.splitlines()) == 5
    page = "docs/tutorials/first-table.md"
    (words,) = [words for words in thor2_commands(page) if words[0] == "recognize"]
    assert run_thor2(*(word.replace("$samples", str(SAMPLES)) for word in words)) == 0
    answers = json.loads(Path("answer/recognition.json").read_text())
    names = run_blocks(page, 0)["names"]
    assert len(names) == 5 and str(min(names)) in json.dumps(answers)
    assert Path("answer/overlay.png").is_file()


@pytest.mark.slow
def test_explanation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("thor2_jax.capacity.MIN_BATCH_POINTS", 512)
    recognizer = thor2.Recognizer(untrained_run(("bowl", "mug")))
    names = run_blocks("docs/explain.md", 0, recognizer=recognizer, frame=FRAME)
    assert {names["explanation"].name, names["explanation"].runner_up} == {"bowl", "mug"}
    assert names["picture"].name == "network"


def test_descriptors_and_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    names = run_blocks(LIBRARY, 0, 7, xyz=XYZ, rgb=RGB)
    result = names["descriptors"]
    assert result.tops.shape == (1, 7168) and result.tops2.shape == (1, 11942) and result.overflow.shape == (1,)
    assert all(axes.collections for axes in names["figure"].axes)
    names["plt"].close(names["figure"])


@pytest.mark.slow
def test_gradients_of_colours() -> None:
    names = run_blocks(LIBRARY, 0, 8, xyz=XYZ, rgb=RGB)
    gradient, colors = names["jax"].grad(names["largest"]), names["clouds"].colors
    assert np.abs(gradient(colors, names["soft"])).max() > 0.01
    assert not np.any(gradient(colors, names["config"]))


@pytest.mark.slow
def test_scikit_learn() -> None:
    cubes, bricks = random_clouds(0, [400] * 4, (0.05, 0.05, 0.05)), random_clouds(1, [400] * 4)
    clouds = [cloud for pair in zip(cubes, bricks, strict=True) for cloud in pair]
    names = run_blocks(LIBRARY, 1, 2, clouds=clouds, labels=["cube", "brick"] * 4)
    assert names["search"].predict(clouds[:2]).tolist() == ["cube", "brick"]
    assert names["frame"].shape == (8, 7168)


@pytest.mark.slow
def test_persistence() -> None:
    names = run_blocks(LIBRARY, 3, 4, 5, 6)
    assert names["images"].shape == (2, 16, 16) and len(names["pairs"]) == int(names["diagrams"].mask[0].sum()) > 0
    shallow, noisy, smooth = names["shallow"], names["noisy"], names["smooth"]
    assert shallow(smooth) < 0.2 * shallow(noisy)
    assert float(smooth.min()) == pytest.approx(float(noisy.min()), abs=0.01)


@pytest.mark.slow
def test_export(run: Path) -> None:
    run_blocks(LIBRARY, 9)
    assert (run / "recognizer.export").stat().st_size > 10_000


def test_next_view(monkeypatch: pytest.MonkeyPatch) -> None:
    from training import view_table

    monkeypatch.setattr(view_table, "view_table", create_autospec(view_table.view_table))
    tracker = create_autospec(Tracker, instance=True)
    tracker.next_view.return_value = types.SimpleNamespace(index=1, expected=[0.2, 0.1])
    given: Any = {"recognizer": MagicMock(), "answer": MagicMock(), "meshes": {}, "reachable": [np.eye(4)] * 2}
    names = run_blocks("docs/cameras.md", 1, tracker=tracker, **given)
    assert tracker.next_view.call_args.args[1:] == (given["reachable"], names["table"])


def test_segmented_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thor2, "read_frame", create_autospec(thor2.read_frame, return_value=table_frame()))
    recognizer = create_autospec(thor2.Recognizer, instance=True)
    run_blocks("docs/segmentation.md", 0, recognizer=recognizer)
    assert recognizer.recognize.call_args.args[0].instances == (1, 2)


def test_wrapped_segmenters(monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks run with stand-ins of segment-anything and UOIS, which need PyTorch and weights."""
    frame = table_frame()
    mask = np.zeros(frame.depth.shape, bool)
    mask[:10, :10] = True
    package: Any = types.ModuleType("segment_anything")
    generator = types.SimpleNamespace(generate=lambda color: [{"area": mask.sum(), "segmentation": mask}])
    package.SamAutomaticMaskGenerator = lambda model: generator
    package.sam_model_registry = {"vit_b": lambda checkpoint: checkpoint}
    monkeypatch.setitem(sys.modules, "segment_anything", package)
    monkeypatch.setenv("SAM_CHECKPOINT", "weights")
    np.testing.assert_array_equal(run_blocks("docs/segmentation.md", 1)["segment"](frame), mask)

    network = types.SimpleNamespace(run_on_batch=lambda color, points: points[..., 2] > 0)
    names = run_blocks("docs/segmentation.md", 2, network=lambda: network, backproject=backproject, np=np)
    assert names["segment"](frame).shape == frame.depth.shape


def test_camera(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    camera, recognizer = create_autospec(realsense.RealSenseCamera), create_autospec(thor2.Recognizer)
    recorded = types.SimpleNamespace(name="1.0", read=table_frame)
    camera.return_value.__enter__.return_value.frames.return_value = [recorded]
    recognizer.load.return_value.recognize.return_value = [thor2.Recognition(1, "mug", 0.9)]
    monkeypatch.setattr(realsense, "RealSenseCamera", camera)
    monkeypatch.setattr(thor2, "Recognizer", recognizer)
    run_blocks("docs/recordings.md", 0)
    assert capsys.readouterr().out == "1.0 1 mug 0.9\n"


def test_client(monkeypatch: pytest.MonkeyPatch) -> None:
    client = create_autospec(Client)
    client.return_value.recognize_frame.return_value = [], np.zeros((2, 2), np.int32)
    monkeypatch.setattr("thor2_jax.client.Client", client)
    run_blocks("docs/service.md", 0, client=client.return_value)
    assert client.return_value.enroll.call_args.kwargs["instance"] == 3
    run_blocks("docs/service.md", 1)
    client.return_value.undo.assert_called_once_with(client.return_value.forget.return_value)
