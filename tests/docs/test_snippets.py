"""Every Python block of the pages is executed by a test, and every command is run by one or has a reason.

The blocks of pages with a test file of their own are only counted here. Services, cameras and other packages are
replaced by objects of the same interface: what a block calls must exist and take these arguments.
"""

import re
import sys
import types
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, create_autospec

import numpy as np
import pytest
from doc_pages import PAGES, ROOT, python_blocks, shell_commands
from helpers import SMALL_CONFIG, untrained_run, write_frame
from recording_files import table_frame

import thor2_jax as thor2
from thor2_jax.client import Client
from thor2_jax.frames.frames import backproject
from thor2_jax.model.run_directory import save_run
from thor2_jax.recordings import realsense
from thor2_jax.tracking.tracker import Tracker

BLOCKS = {
    "README.md": 1,
    "docs/cameras.md": 2,
    "docs/explain.md": 1,  # test_explanations.py
    "docs/index.md": 1,  # test_tutorials.py
    "docs/library.md": 10,  # test_library.py
    "docs/objects.md": 1,  # test_library.py
    "docs/recordings.md": 1,
    "docs/segmentation.md": 3,
    "docs/service.md": 2,
    "docs/tutorials/first-table.md": 1,  # test_tutorials.py
}
"""Page -> number of its Python blocks; each one is executed by a test."""

RUN_BY = {
    "adapt": "training/cli/test_adapt.py",
    "demo": "training/cli/test_cli.py",
    "doctor": "training/diagnosis/test_diagnosis.py",
    "enroll": "training/cli/test_enroll.py",
    "evaluate": "training/cli/test_cli.py",
    "explain": "training/cli/test_explain.py",
    "fetch": "training/objects/test_fetch_ycb.py",  # from a local server
    "forget": "training/cli/test_enroll.py",
    "objects": "training/cli/test_enroll.py",
    "recognize": "training/cli/test_cli.py",
    "render": "training/cli/test_cli.py",
    "serve": "thor2_jax/service/test_serve_command.py",
    "train": "training/cli/test_cli.py",
    "watch": "training/cli/test_watch.py",  # bags and folders; a camera only without one
}
"""Command -> test file that runs it. All options of the pages are parsed in test_commands.py."""

NOT_RUN = {
    "pip": "installs packages: .ci/run runs the README's line and the extras `test` and `docs`",
    "python3": "makes an environment, in the same line of .ci/run",
    "pytest": "the tests",
    "curl": "needs a running service: tests/thor2_jax/service sends the same requests",
    "python": "benchmarks, of hours: tests/benchmarks runs their parts; the ROS 2 node: tests/examples",
    "source": "the environment of ROS 2",
    "sudo": "installs messages of ROS 2",
    "samples=$(python": "names a directory: the next command is run by test_tutorials.py",
}
"""First word of other commands -> why they are not run as they stand."""


def blocks_of(page: str) -> list[str]:
    return python_blocks((ROOT / page).read_text(encoding="utf-8"))


def run_block(page: str, number: int = 0, **names: Any) -> dict[str, Any]:
    """Execute a Python block of a page, in which `names` are defined, and return all names."""
    exec(compile(blocks_of(page)[number], page, "exec"), names)
    return names


def test_every_python_block_is_executed() -> None:
    assert {page: len(blocks_of(page)) for page in PAGES if blocks_of(page)} == BLOCKS


def test_every_command_is_run_or_has_a_reason() -> None:
    first = set()
    for page in PAGES:
        for words in shell_commands(page):
            if re.match(r"THOR2_\w+=", words[0]):
                words = words[words.index(next(word for word in words if word.endswith("thor2"))) :]
            name = re.sub(r"[\w.-]+/bin/", "", words[0])
            first.add(words[1] if name == "thor2" else name)
    assert first == {*RUN_BY, *NOT_RUN}
    for command, path in RUN_BY.items():
        assert f'"{command}"' in (ROOT / "tests" / path).read_text(encoding="utf-8"), command


@pytest.mark.slow
def test_readme_and_tracks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    save_run(untrained_run(("ball", "brick"), config=SMALL_CONFIG), "run")
    folder = write_frame(tmp_path / "frame", {3: "brick"})
    for source, target in {"color": "c", "depth": "d", "mask": "l"}.items():
        (folder / f"{source}.png").rename(f"{target}.png")
    (folder / "intrinsics.json").rename("k.json")
    names = run_block("README.md")
    assert capsys.readouterr().out.startswith("3 ")
    run_block("docs/cameras.md", recognizer=names["recognizer"], frames=[names["frame"]] * 2)
    assert [line.split()[-1] for line in capsys.readouterr().out.splitlines()] == ["1", "2"]


def test_next_view(monkeypatch: pytest.MonkeyPatch) -> None:
    from training import view_table

    monkeypatch.setattr(view_table, "view_table", create_autospec(view_table.view_table))
    tracker = create_autospec(Tracker, instance=True)
    tracker.next_view.return_value = types.SimpleNamespace(index=1, expected=[0.2, 0.1])
    reachable = [np.eye(4)] * 2
    names = run_block(
        "docs/cameras.md",
        1,
        tracker=tracker,
        answer=MagicMock(),
        recognizer=MagicMock(),
        meshes={},
        reachable=reachable,
    )
    assert tracker.next_view.call_args.args[1:] == (reachable, names["table"])


def test_segmented_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = table_frame()
    monkeypatch.setattr(thor2, "read_frame", create_autospec(thor2.read_frame, return_value=frame))
    monkeypatch.setattr(thor2, "segmented", create_autospec(thor2.segmented, return_value=frame))
    recognizer = create_autospec(thor2.Recognizer, instance=True)
    names = run_block("docs/segmentation.md", recognizer=recognizer)
    recognizer.recognize.assert_called_once_with(frame)
    assert names["answers"] is recognizer.recognize.return_value


def test_wrapped_segmenters(monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks run with stand-ins of segment-anything and UOIS, which need PyTorch and weights."""
    frame = table_frame()
    mask = np.zeros(frame.depth.shape, bool)
    mask[:10, :10] = True
    package = types.ModuleType("segment_anything")
    generator = types.SimpleNamespace(generate=lambda color: [{"area": mask.sum(), "segmentation": mask}])
    package.SamAutomaticMaskGenerator = lambda model: generator  # type: ignore[attr-defined]
    package.sam_model_registry = {"vit_b": lambda checkpoint: checkpoint}  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "segment_anything", package)
    monkeypatch.setenv("SAM_CHECKPOINT", "weights")
    labels = run_block("docs/segmentation.md", 1)["segment"](frame)
    np.testing.assert_array_equal(labels, mask)

    network = types.SimpleNamespace(run_on_batch=lambda color, points: points[..., 2] > 0)
    names = run_block("docs/segmentation.md", 2, network=lambda: network, backproject=backproject, np=np)
    assert names["segment"](frame).shape == frame.depth.shape


def test_camera(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    recorded = types.SimpleNamespace(name="1.0", read=table_frame)
    camera = create_autospec(realsense.RealSenseCamera)
    camera.return_value.__enter__.return_value.frames.return_value = [recorded]
    monkeypatch.setattr(realsense, "RealSenseCamera", camera)
    recognizer = create_autospec(thor2.Recognizer)
    answer = types.SimpleNamespace(label=1, name="mug", confidence=0.9)
    recognizer.load.return_value.recognize.return_value = [answer]
    monkeypatch.setattr(thor2, "Recognizer", recognizer)
    monkeypatch.setattr(thor2, "segmented", lambda frame: frame)
    run_block("docs/recordings.md")
    assert capsys.readouterr().out == "1.0 1 mug 0.9\n"


def test_client(monkeypatch: pytest.MonkeyPatch) -> None:
    client = create_autospec(Client, instance=True)
    client.recognize_frame.return_value = [], np.zeros((2, 2), np.int32)
    run_block("docs/service.md", client=client)
    assert client.enroll.call_args.kwargs["instance"] == 3

    made = create_autospec(Client)
    monkeypatch.setattr("thor2_jax.client.Client", made)
    run_block("docs/service.md", 1)
    made.return_value.undo.assert_called_once_with(made.return_value.forget.return_value)
