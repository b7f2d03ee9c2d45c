"""The commands of docs/recordings.md run on the sample recording; the run's weights are random."""

import runpy
from pathlib import Path
from typing import Any

import pytest
from commands import Command, json_lines, run_thor2
from doc_pages import ROOT, thor2_commands
from small_runs import save_untrained_run

import thor2_jax as thor2
from thor2_jax.recordings.bags import Bag
from thor2_jax.recordings.topics import Topics
from training.rendering.sample_recording import FRAMES, write_sample_recording

COMMANDS = thor2_commands("docs/recordings.md")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the run and the recording of the page."""
    folder = tmp_path_factory.mktemp("recordings")
    save_untrained_run(folder / "run", ("apple", "mug"))
    write_sample_recording(folder / "table.mcap")
    (folder / "thor2_jax").symlink_to(ROOT / "thor2_jax")
    return folder


@pytest.fixture(autouse=True)
def inside(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(recorded)


def test_the_recording_shows_four_objects_apart() -> None:
    with Bag(Path("table.mcap"), Topics()) as bag:
        frames = [recorded.read() for recorded in bag.frames()]
    assert len(frames) == FRAMES
    for frame in frames[:3]:
        assert len(set(thor2.segment(frame).ravel().tolist()) - {0}) == 4


def test_a_recording_that_exists_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["sample_recording", "table.mcap"])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(str(ROOT / "training/rendering/sample_recording.py"), run_name="__main__")
    assert "table.mcap, which exists" in capsys.readouterr().err


@pytest.mark.slow
def test_recordings_are_recognized(printed: Command) -> None:
    for words, count in zip(COMMANDS[:2], (FRAMES, 2), strict=True):
        assert not Path("answers.mcap").exists()
        lines = json_lines(printed(*words))
        assert len(lines) == count and all(len(line["instances"]) >= 4 for line in lines)
    assert Path("answers.mcap").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 3])
def test_recordings_and_folders_are_watched(number: int, messages: list[dict[str, Any]]) -> None:
    assert run_thor2(*COMMANDS[number], "--port", "0") == 0
    live = [one for one in messages if one["state"] == "live"]
    assert live and all(one["objects"] and not one["error"] for one in live)
