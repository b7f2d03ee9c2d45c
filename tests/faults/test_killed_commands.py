"""Commands that are killed while they write: files under their final names are complete, and commands resume."""

import signal
from pathlib import Path

import numpy as np
import pytest
from commands import STEPS, Command, frame_options, run_thor2
from image_files import small_frame, write_frame_files
from processes import run_python
from small_runs import save_untrained_run
from written_files import files_of

from thor2_jax.model.run_directory import load_run
from training.baselines.baseline import StoredBaseline, baseline_file
from training.train_run import read_metrics

pytestmark = pytest.mark.slow

KILLED = """
import fnmatch, os, signal, sys
when, place = sys.argv.pop(1).split()
out = sys.argv[sys.argv.index("--out" if "--out" in sys.argv else "--model") + 1]

def killing(function):
    def called(*arguments, **options):
        here = fnmatch.fnmatch(os.path.relpath(arguments[-1], out), place)
        if here and when == "before":
            os.kill(os.getpid(), signal.SIGKILL)
        function(*arguments, **options)
        if here and when == "after":
            os.kill(os.getpid(), signal.SIGKILL)
    return called

os.replace, os.rename = killing(os.replace), killing(os.rename)
from training.cli import main
from training.views import mesh_views
mesh_views.MESH_VIEWS = 4
main()
"""


def kill(place: str, *command: object) -> None:
    """Run a command and kill it before or after it renames a file or directory to its place in --out or --model."""
    done = run_python("-c", KILLED, place, *command)
    assert done.returncode == -signal.SIGKILL, done.stderr[-3000:]


def files(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files but temporary ones, whose names begin with a dot."""
    return {name: content for name, content in files_of(folder).items() if "/." not in f"/{name}"}


def finish(*command: object) -> dict[str, bytes]:
    """Run a command, which must succeed, and return the files of its last argument."""
    assert run_thor2(*command) == 0
    return files(Path(str(command[-1])))


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Directory of a frame of a brick and a box."""
    folder = tmp_path_factory.mktemp("frames")
    write_frame_files(folder / "one", small_frame(), {1: "brick", 4: "box"})
    return folder


def test_train(meshes: Path, frames: Path, refused: Command, tmp_path: Path) -> None:
    options = (*STEPS, "--paper", "--batch-size", 16, "--classifiers", "ce", "--baselines", "forest", "--epochs", 2)
    command, whole, out = ("train", "--meshes", meshes, *options, "--out"), tmp_path / "whole", tmp_path / "run"
    expected = finish(*command, whole)
    kept, compared = "checkpoints/fold-0/ce/1.safetensors", ("curves.png", "network.npz", "run.json", "weights/")
    for place in (kept, "curves.png", "run.json", "baselines/forest.safetensors", ".thor2-*/views"):
        kill(f"{'after' if place == kept else 'before'} {place}", *command, out)
        written = files(out)
        assert all(written[name] == expected[name] for name in written if name.startswith(compared))
        assert [row["epoch"] for row in read_metrics(out / "metrics.jsonl")] in ([], [1], [1, 2])
        if "run.json" in written:
            assert load_run(out).classes == ("box", "brick")
        else:
            assert f"{out} is not a run directory" in refused("evaluate", "frames", frames, "--model", out)
        if "checkpoints/begun.json" in written:
            assert f"{out} was written with epochs 2, not 3" in refused(*command, out, "--epochs", 3, at_once=False)
    written = finish(*command, out)
    assert not list(out.glob(".*")) and not (out / "views").exists()
    assert written.keys() == expected.keys()
    different = {name for name in written if written[name] != expected[name]}  # these two hold measured times
    assert different <= {"metrics.jsonl", "baselines/forest.safetensors"}
    first, second = (StoredBaseline.read(baseline_file(folder, "forest"), ("box", "brick")) for folder in (out, whole))
    assert all(np.array_equal(second.arrays[name], array) for name, array in first.arrays.items())


def test_recognize(frames: Path, tmp_path: Path) -> None:
    model = save_untrained_run(tmp_path / "run", ("box", "brick"), ("tops", "tops2"))
    command, out = ("recognize", "--model", model, *frame_options(frames / "one"), "--out"), tmp_path / "out"
    kill("before recognition.json", *command, out)
    assert files(out) == {}  # recognition.json is written first: it marks the results as those of the command
    assert finish(*command, out) == finish(*command, tmp_path / "whole")


def test_enroll(meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("training.views.mesh_views.MESH_VIEWS", 4)
    command = "enroll", "brick", "--mesh", meshes / "brick.ply", "--model", tmp_path / "run"
    for place in ("before ../.thor2-*/run/gallery/index.json", "before ."):
        kill(place, *command)
        (left,) = tmp_path.iterdir()  # what the process before has left is removed
        assert left.name.startswith(".thor2-")
    assert run_thor2(*command) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
