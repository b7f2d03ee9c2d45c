"""`thor2 recognize` with several frames, other formats and other outputs; the run's weights are random."""

import dataclasses
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import Command, Recognize, Texts, frame_options, json_lines, run_thor2
from image_files import frame_of_squares, small_frame, write_frame_files
from PIL import Image
from recording_files import table_frame
from small_runs import untrained_run
from written_files import files_of

from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.model.recognition import Recognition
from thor2_jax.model.run_directory import save_run
from training.cli import recognize as recognize_command
from training.readers.frames import FrameFiles


def test_output_for_one_frame(model: Path, recognize: Recognize, tmp_path: Path, printed: Command) -> None:
    """A frame of background has no table."""
    folder = write_frame_files(tmp_path / "one", small_frame())
    (answer,) = recognize(*frame_options(folder), "--json", "--out", tmp_path / "out")
    assert [one["label"] for one in answer["instances"]] == [1, 4]
    assert all(one["name"] in ("bowl", "mug", "plate") for one in answer["instances"])
    assert answer["instances"] == json.loads((tmp_path / "out" / "recognition.json").read_text())
    table = printed("recognize", "--model", model, *frame_options(folder), "--unknown-below", 1)
    assert table.count("unrecognized") == 2
    Image.fromarray(np.zeros_like(small_frame().labels)).save(folder / "mask.png")
    background = printed("recognize", "--model", model, folder)
    assert "no instances" in background and "confidence" not in background


def test_one_failing_frame_loses_no_other(model: Path, tmp_path: Path, texts: Texts) -> None:
    for number in range(1, 7):
        write_frame_files(tmp_path / "frames" / f"00000{number}", small_frame(number))
    (tmp_path / "frames" / "000002" / "depth.png").write_bytes(b"damaged")
    (tmp_path / "frames" / "000003" / "intrinsics.json").unlink()
    (tmp_path / "frames" / "000005" / "color.png").unlink()
    (tmp_path / "frames" / "000006" / "mask.png").unlink()
    coco_file = tmp_path / "new" / "a" / "coco.json"
    outputs = ("--out", tmp_path / "out", "--coco", coco_file)
    command = ("recognize", "--model", model, tmp_path / "frames", "--json", *outputs)
    for _ in range(2):  # it may be repeated
        out, err = texts(*command, status=2)
        answers = {line["frame"]: line for line in json_lines(out)}
        assert list(answers) == [f"00000{number}" for number in range(1, 7)]
        for number, word in ((2, "depth"), (3, "intrinsics.json"), (5, "color.png"), (6, "--segment")):
            assert word in answers[f"00000{number}"]["error"]
        assert all([one["label"] for one in answers[n]["instances"]] == [1, 4] for n in ("000001", "000004"))
        assert "4 of 6 frames" in err and "000002, 000003, 000005, 000006" in err
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["000001", "000004"]
    assert [entry["image_id"] for entry in json.loads(coco_file.read_text())] == [1, 1, 4, 4]


def test_several_folders_and_tables(model: Path, tmp_path: Path, texts: Texts) -> None:
    one = write_frame_files(tmp_path / "one", small_frame())
    two = write_frame_files(tmp_path / "more" / "deep" / "two", small_frame(1))
    shutil.move(two / "mask.png", two / "labels.png")
    coco_file, names_file = tmp_path / "out" / "coco.json", tmp_path / "names.json"
    names_file.write_text(json.dumps({"14": "mug", "21": "bowl", "5": "plate"}))
    tables = ("--coco", coco_file, "--bop", tmp_path / "bop.csv", "--names", names_file)
    outputs = (*tables, "--out", tmp_path / "out")
    command = ("recognize", "--model", model, one, tmp_path / "more", *outputs)
    out, err = texts(*command)
    assert "instances whose name" not in err
    assert f"written to {tmp_path / 'out'}, {tables[1]}, {tables[3]}; see why" in out
    assert out.index("one:") < out.index("deep/two:") and out.count("confidence") == 2
    with Image.open(tmp_path / "out" / "deep" / "two" / "overlay.png") as overlay:
        assert overlay.size == (120, 90)
    results = [tmp_path / "out" / name / "recognition.json" for name in ("one", "deep/two")]
    names = [one["name"] for path in results for one in json.loads(path.read_text())]
    coco = json.loads(coco_file.read_text())
    lines = (tmp_path / "bop.csv").read_text().splitlines()[1:]
    expected = [{"mug": 14, "bowl": 21, "plate": 5}[name] for name in names]
    assert [entry["category_id"] for entry in coco] == [int(line.split(",")[2]) for line in lines] == expected
    names_file.write_text(json.dumps({"14": "another"}))
    assert f"has no number in {names_file}: {len(names)}" in texts(*command)[1]


def test_a_narrow_terminal_cuts_no_name(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recognize_command.console, "_width", 80)
    unknown = Recognition(2, reason="unknown: a confidence of 0.448, below 0.573", confidence=0.448)
    recognize_command._print_table("f", [Recognition(1, "021_bleach_cleanser", 0.954, "embedding"), unknown])
    out = capfd.readouterr().out
    assert "021_bleach_cleanser" in out and "unrecognized" in out and "0.954" in out and "…" not in out
    assert max(map(len, out.splitlines())) == 80


def test_invalid_arguments(model: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    os.mkfifo("pipe")
    files = " ".join(map(str, frame_options(write_frame_files(Path("frames/one"), small_frame()))))
    write_frame_files(Path("frames/two"), small_frame(1))
    Path("frames/names.json").write_text("{}")
    save_run(untrained_run((), ()), Path("gallery-only"))
    Path("poses").write_text("[")
    unit, double = np.eye(4).tolist(), (2 * np.eye(4)).tolist()
    for name, poses in {"few": [unit], "other": {"one": unit}, "scaled": [unit, double]}.items():
        Path(f"{name}.json").write_text(json.dumps(poses))
    no_files = ("empty", "frames/one/color.png/results", "pipe")
    for arguments, expected in (
        ("", "give either"),
        ("frames --color frames/one/color.png", "give either"),
        ("empty", "has no color.png"),
        ("frames --names frames/names.json", "it belongs to --coco"),
        ("frames --coco empty/c.json --names frames/one/intrinsics.json", "expected an obj_id"),
        *((f"frames --coco {path}", f"coco: {path} is not a file") for path in no_files),
        *((f"frames --bop {path}", f"bop: {path} is not a file") for path in no_files),
        ("frames --coco x --bop x", "coco and --bop are x"),
        ("frames --out frames", "expected a new or empty directory"),
        ("frames --depth-scale 1e-300", "error: --depth-scale is 1e-300"),
        ("frames --segment sam --out out", "error: --segment is 'sam'; expected one of table, model"),
        ("frames --track --workers 2", "workers is 2"),
        ("frames --out out --track --poses poses", "error: --poses: poses is invalid"),
        ("frames --out out --track --poses few.json", "few.json is 1; expected 2"),
        ("frames --out out --track --poses other.json", "no pose of frame two"),
        ("frames --out out --track --poses scaled.json", "frame two is not a rigid motion"),
        ("frames --out out --poses few.json", "--track"),
        ("frames --out-bag a.mcap", "--out-bag is a.mcap; it belongs to --bag"),
        ("FILES --segment table --out out", "error: --labels is "),
        ("FILES --out out --color absent.png", "absent.png"),
        ("FILES --out out --labels frames/names.json", "names.json"),
        ("FILES --out out --model absent", "absent"),
        ("FILES --out out --model empty", "run.json"),
        ("FILES --out out --answer-by gallery", "--answer-by is gallery"),
        ("FILES --out out --answer-by classifiers --model gallery-only", "--answer-by is classifiers"),
    ):
        command = arguments.replace("FILES", files).split()
        assert expected in refused("recognize", "--model", model, *command), arguments
        assert not Path("out").exists() and Path("pipe").is_fifo()


def test_no_file_of_the_user_is_replaced(model: Path, tmp_path: Path, refused: Command) -> None:
    write_frame_files(tmp_path / "f", small_frame())
    for name, content, option in (
        ("f/recognition.json", '{"a": "user\'s"}', "--out"),
        ("f/overlay.png", "a user's", "--out"),
        ("instances.json", '[{"image_id": 1, "category_id": 2}]', "--coco"),
        ("poses.csv", "scene_id,im_id,obj_id,score,R,t,time\n1,1,1,.5,0 1 0 1 0 0 0 0 -1,0 0 9,1\n", "--bop"),
    ):
        (tmp_path / name).write_text(content)
        before, given = files_of(tmp_path), tmp_path if option == "--out" else tmp_path / name
        assert Path(name).name in refused("recognize", "--model", model, tmp_path, option, given)
        assert files_of(tmp_path) == before
        (tmp_path / name).unlink()


@pytest.mark.parametrize("segmenter", ["table", pytest.param("model", marks=pytest.mark.slow)])
def test_segmented_frames(model: Path, recognize: Recognize, tmp_path: Path, refused: Command, segmenter: str) -> None:
    folder = write_frame_files(tmp_path / "frames" / "a", table_frame())
    files = frame_options(folder)
    del files[files.index("--labels") : files.index("--labels") + 2]
    write_frame_files(tmp_path / "labelled" / "a", dataclasses.replace(table_frame(), labels=np.full((240, 320), 9)))
    for given in (files, [tmp_path / "frames"], [tmp_path / "labelled"]):  # labels of a folder are replaced
        (answer,) = recognize(*given, "--segment", segmenter, "--json")
        assert [one["label"] for one in answer["instances"]] == [1, 2]
    assert "--segment" in refused("recognize", "--model", model, *files)


def test_a_wrong_unit_of_depth(model: Path, tmp_path: Path, refused: Command) -> None:
    """Without usable depth, the segmenter finds nothing: that is an error if it is so in all frames."""
    frame = table_frame()
    write_frame_files(tmp_path / "a", frame)
    command = ("recognize", "--model", model, tmp_path / "a", "--segment", "table", "--out", tmp_path / "out")
    error = refused(*command, "--depth-scale", 1, "--coco", tmp_path / "coco.json", at_once=False)
    assert "depth_scale" in error and "It is 1 units" in error
    assert json.loads((tmp_path / "coco.json").read_text()) == []
    write_frame_files(tmp_path / "b", dataclasses.replace(frame, depth=frame.depth * 0))
    assert run_thor2("recognize", "--model", model, tmp_path / "a", tmp_path / "b", "--segment", "table") == 0


def test_track_gives_an_object_one_name(model: Path, recognize: Recognize, tmp_path: Path, printed: Command) -> None:
    frames = [write_frame_files(tmp_path / "video" / f"{number}", small_frame(number)) for number in range(3)]
    poses = tmp_path / "poses.json"
    poses.write_text(json.dumps({frame.name: np.eye(4).tolist() for frame in frames}))
    command = (tmp_path / "video", "--track", "--poses", poses)
    answers = recognize(*command, "--json", "--out", tmp_path / "out")
    assert [answer["frame"] for answer in answers] == ["0", "1", "2"]
    assert [[one["track"] for one in answer["instances"]] for answer in answers] == [[1, 2]] * 3
    for index in range(2):
        assert len({(a["instances"][index]["name"], a["instances"][index]["confidence"]) for a in answers}) == 1
        assert [a["instances"][index]["frames"] for a in answers] == [3, 3, 3]
    assert (tmp_path / "out" / "2" / "overlay.png").is_file()
    assert "track" in printed("recognize", "--model", model, *command)


def test_bad_frames_end_no_sequence(model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, texts: Texts) -> None:
    """One is damaged, one lacks labels, one is removed after it has been read, and one has another size."""
    frames = [write_frame_files(tmp_path / "video" / f"{number}", small_frame(number)) for number in range(5)]
    (frames[1] / "depth.png").write_bytes(b"damaged")
    (frames[2] / "mask.png").unlink()
    write_frame_files(tmp_path / "video" / "5", frame_of_squares({1: (10, 10, 0)}, shape=(90, 100)))

    read = FrameFiles.read

    def read_and_remove(files: FrameFiles, depth_scale: float | None) -> RGBDFrame:
        frame = read(files, depth_scale)
        if files.color.parent == frames[4]:
            (frames[3] / "depth.png").unlink(missing_ok=True)
        return frame

    monkeypatch.setattr(FrameFiles, "read", read_and_remove)
    out, err = texts("recognize", "--model", model, tmp_path / "video", "--track", "--json", status=2)
    answers = json_lines(out)
    assert [[one["frames"] for one in answers[n]["instances"]] for n in (0, 4)] == [[3, 3]] * 2
    for number, reason in ((1, "depth"), (2, "labels"), (3, "No such file"), (5, "100 x 90 pixels")):
        assert reason in answers[number]["error"] and "instances" not in answers[number]
    assert "4 of 6 frames" in err
