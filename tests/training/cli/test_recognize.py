"""`thor2 recognize` with several frames, recordings, other formats and other outputs; the run's weights are random."""

import dataclasses
import io
import json
import os
import shutil
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from commands import Command, Recognize, Texts, frame_options, json_lines, run_thor2
from image_files import frame_of_squares, small_frame, write_frame, write_frame_files
from PIL import Image
from recording_files import COLOR, DEPTH, PERIOD, START, bag_writer, image, table_frame, write_images, write_recording
from rosbags.highlevel import AnyReader
from small_runs import save_untrained_run
from written_files import files_of

from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.model.recognition import Recognition
from thor2_jax.model.result_files import RESULT_FILES
from thor2_jax.segmentation import table
from training.cli import recognize as recognize_command
from training.readers.frames import FrameFiles

FRAMES = [table_frame(shift) for shift in (0, 3, 6)]


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


def test_a_frame_that_fails_has_no_earlier_answer(
    model: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, out = write_frame_files(tmp_path / "one", small_frame()), tmp_path / "out"
    command = ("recognize", "--model", model, *frame_options(folder), "--out", out)
    assert run_thor2(*command) == 0 and sorted(path.name for path in out.iterdir()) == sorted(RESULT_FILES)
    (folder / "depth.png").write_bytes(b"damaged")
    unlink = Path.unlink

    def interrupted(path: Path, missing_ok: bool = False) -> None:
        unlink(path, missing_ok)
        if path.parent == out:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", interrupted)
        assert run_thor2(*command) == 130 and len(list(out.iterdir())) == 1
    assert "depth.png" in refused(*command) and not list(out.iterdir())


def test_no_explanation_is_advised_if_every_frame_fails(model: Path, tmp_path: Path, texts: Texts) -> None:
    folder = write_frame_files(tmp_path / "frames" / "1", small_frame())
    (folder / "depth.png").write_bytes(b"damaged")
    out, err = texts("recognize", "--model", model, tmp_path / "frames", status=2)
    assert "explain" not in out + err and "1 of 1 frames" in err


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
    (tmp_path / "out" / "000002").mkdir(parents=True)
    (tmp_path / "out" / "000002" / "recognition.json").write_text("[]")  # answers of an earlier call
    (tmp_path / "out" / "000005").touch()  # a file of the user
    for _ in range(2):  # it may be repeated
        out, err = texts(*command, status=2)
        answers = {line["frame"]: line for line in json_lines(out)}
        assert list(answers) == [f"00000{number}" for number in range(1, 7)]
        for number, word in ((2, "depth"), (3, "intrinsics.json"), (5, "color.png"), (6, "--segment")):
            assert word in answers[f"00000{number}"]["error"]
        assert all([one["label"] for one in answers[n]["instances"]] == [1, 4] for n in ("000001", "000004"))
        assert "4 of 6 frames" in err and "000002, 000003, 000005, 000006" in err
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["000001", "000004", "000005"]
    assert [entry["image_id"] for entry in json.loads(coco_file.read_text())] == [1, 1, 4, 4]


def test_several_folders_and_tables(model: Path, tmp_path: Path, texts: Texts, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the command is interrupted, the tables have the frames so far."""
    one = write_frame_files(tmp_path / "one", small_frame())
    two = write_frame_files(tmp_path / "more" / "deep" / "two", small_frame(1))
    shutil.move(two / "mask.png", two / "labels.png")
    coco_file, names_file = tmp_path / "out" / "coco.json", tmp_path / "names.json"
    names_file.write_text(json.dumps({"14": "mug", "21": "bowl", "5": "plate"}))
    tables = ("--coco", coco_file, "--bop", tmp_path / "bop.csv", "--names", names_file)
    command = ("recognize", "--model", model, one, tmp_path / "more", *tables, "--out", tmp_path / "out")
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
    monkeypatch.setattr(recognize_command, "_print_table", mock.Mock(side_effect=[None, KeyboardInterrupt]))
    assert run_thor2(*command[:-6], "--coco", coco_file) == 130
    assert {entry["frame"] for entry in json.loads(coco_file.read_text())} == {"one"}


def test_a_narrow_terminal_cuts_no_name(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Names may look like markup, mathtext or terminal commands, and have any characters."""
    monkeypatch.setattr(recognize_command.console, "_width", 80)
    answers = [Recognition(n, reason="unknown: a confidence of 0.448, below 0.573", confidence=0.448) for n in (2, 5)]
    names = ("021_bleach_cleanser", "$\\frac{", "[red]mug[/x]", "茶碗\u202e\x1b[2J")
    recognize_command._print_table("f", answers + [Recognition(1, name, 0.954, "embedding") for name in names])
    out = capfd.readouterr().out
    assert all(text in out for text in (*names[:3], r"茶碗\u202e\x1b[2J", "unrecognized", "0.954")) and "…" not in out
    assert "\x1b" not in out and "\u202e" not in out
    assert "┃ confidence ┃ classifier ┃ occluded ┃ points ┃" in out and max(map(len, out.splitlines())) == 77
    assert "\n2, 5: unknown: a confidence of 0.448, below 0.573\n" in out
    recognize_command._print_table("f", [Recognition(1, "070-b_colored_wood_blocks", 0.954, "embedding")])
    assert "│070-b_colored_wood_blocks│" in capfd.readouterr().out


@pytest.mark.usefixtures("small_embedding")
def test_answers_by_the_gallery_count_its_objects(model: Path, tmp_path: Path, printed: Command) -> None:
    run, frame = shutil.copytree(model, tmp_path / "run"), write_frame(tmp_path / "a", {1: "leaf"})
    assert run_thor2("enroll", "--frames", frame, "--model", run) == 0
    command = ("recognize", frame, "--model", run, "--unknown-below", 1)
    assert "recognizes 1 object: leaf\n" in printed(*command, "--answer-by", "gallery")
    assert "recognizes 4 objects" in printed(*command)


def test_invalid_arguments(model: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    os.mkfifo("pipe")
    files = " ".join(map(str, frame_options(write_frame_files(Path("frames/one"), small_frame()))))
    write_frame_files(Path("frames/two"), small_frame(1))
    Path("frames/names.json").write_text("{}")
    write_recording(Path("in.mcap"), FRAMES[:1])
    save_untrained_run(Path("gallery-only"), (), ())
    Path("poses").write_text("[")
    unit, double = np.eye(4).tolist(), (2 * np.eye(4)).tolist()
    for name, poses in {"number": 7, "few": [unit], "other": {"one": unit}, "scaled": [unit, double]}.items():
        Path(f"{name}.json").write_text(json.dumps(poses))
    before = sorted(tmp_path.iterdir())
    no_files = ("empty", "frames/one/color.png/results", "pipe")
    for arguments, expected in (
        ("", "give either"),
        ("frames --color frames/one/color.png", "give either"),
        ("empty", "has no color.png"),
        ("frames --names frames/names.json", "it belongs to --coco"),
        ("frames --coco empty/c.json --names frames/one/intrinsics.json", "expected an integer"),
        *((f"frames --{to} {path}", f"{to}: {path} is not a file") for to in ("coco", "bop") for path in no_files),
        ("frames --out frames", "expected a new or empty directory"),
        ("frames --depth-scale 1e-300", "error: --depth-scale is 1e-300"),
        ("frames --segment sam --out out", "error: --segment is 'sam'; expected one of table, model"),
        ("frames --track --workers 2", "workers is 2"),
        ("frames --out out --track --poses poses", "error: --poses: poses is invalid"),
        ("frames --out out --track --poses number.json", "it holds a value of type int"),
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
        ("BAG --coco c.json", "coco is c.json and --bag is"),
        ("BAG --workers 2", "workers is 2 and --bag is"),
        ("BAG --out-bag a.bag", "expected an MCAP file"),
        ("BAG --out-bag .", "which exists"),
        ("BAG --out-bag x --out x", "--out is x and --out-bag is x"),
        ("BAG --out-bag x --out x/y", "--out is x/y and --out-bag is x"),
        ("BAG --out-bag in.mcap/a.mcap", "a.mcap is not a file that can be written (Not a directory)"),
        ("BAG --color-topic /x", "--color-topic is /x"),
        ("BAG --camera-topic /c --intrinsics k.json", "--camera-topic is /c and --intrinsics is k.json"),
        ("BAG --max-gap 1e300", "--max-gap is 1e+300"),
        ("BAG --every 99999999999999999999", "'--every'"),
        ("BAG --depth-scale 0", "error: --depth-scale is 0"),
        ("BAG --max-gap 0.001 --out-bag out", "expected at most 0.001 s"),
        ("BAG --rerun a.mcap", "the suffix .rrd"),
    ):
        command = arguments.replace("FILES", files).replace("BAG", "--bag in.mcap").split()
        assert expected in refused("recognize", "--model", model, *command), arguments
        assert sorted(tmp_path.iterdir()) == before and Path("pipe").is_fifo()


def test_no_file_of_the_user_is_replaced(model: Path, tmp_path: Path, refused: Command) -> None:
    write_frame_files(tmp_path / "f", small_frame())
    for name, content, option in (
        ("f/recognition.json", '{"a": "user\'s"}', "--out"),
        ("f/overlay.png", "a user's", "--out"),
        ("accents.csv", "\u00e9", "--bop"),
        ("instances.json", '[{"image_id": 1, "category_id": 2}]', "--coco"),
        ("poses.csv", "scene_id,im_id,obj_id,score,R,t,time\n1,1,1,.5,0 1 0 1 0 0 0 0 -1,0 0 9,1\n", "--bop"),
    ):
        (tmp_path / name).write_text(content, "latin-1")
        before, given = files_of(tmp_path), tmp_path if option == "--out" else tmp_path / name
        assert Path(name).name in refused("recognize", "--model", model, tmp_path, option, given)
        assert files_of(tmp_path) == before
        (tmp_path / name).unlink()


@pytest.mark.parametrize("segmenter", ["table", pytest.param("model", marks=pytest.mark.slow)])
def test_segmented_frames(model: Path, recognize: Recognize, tmp_path: Path, refused: Command, segmenter: str) -> None:
    files = frame_options(write_frame_files(tmp_path / "frames" / "a", table_frame()))
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
    frames = [write_frame_files(tmp_path / "video" / f"{number}", small_frame(number)) for number in range(2)]
    poses = tmp_path / "poses.json"
    poses.write_text(json.dumps({frame.name: np.eye(4).tolist() for frame in frames}))
    command = (tmp_path / "video", "--track", "--poses", poses)
    answers = recognize(*command, "--json", "--out", tmp_path / "out")
    assert [answer["frame"] for answer in answers] == ["0", "1"]
    assert [[one["track"] for one in answer["instances"]] for answer in answers] == [[1, 2]] * 2
    for index in range(2):
        assert len({(a["instances"][index]["name"], a["instances"][index]["confidence"]) for a in answers}) == 1
        assert [a["instances"][index]["frames"] for a in answers] == [2, 2]
    assert (tmp_path / "out" / "1" / "overlay.png").is_file()
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


def test_an_interrupted_sequence_keeps_its_answers(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [write_frame_files(tmp_path / "video" / f"{number}", small_frame(number)) for number in range(3)]
    read = FrameFiles.read

    def read_until_interrupt(files: FrameFiles, depth_scale: float | None) -> RGBDFrame:
        if files.color.parent == frames[2]:
            raise KeyboardInterrupt
        return read(files, depth_scale)

    monkeypatch.setattr(FrameFiles, "read", read_until_interrupt)
    command = ("recognize", "--model", model, tmp_path / "video", "--track")
    assert run_thor2(*command, "--json", "--coco", tmp_path / "coco.json") == 130
    assert [json.loads(line)["frame"] for line in capsys.readouterr().out.splitlines()] == ["0", "1"]
    assert {entry["frame"] for entry in json.loads((tmp_path / "coco.json").read_text())} == {"0", "1"}


def test_each_frame_of_a_sequence_is_segmented_once(
    recognize: Recognize, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    segmenter = mock.Mock(side_effect=table.segment_table)
    monkeypatch.setattr(table, "segment_table", segmenter)
    for number, frame in enumerate(FRAMES):
        write_frame_files(tmp_path / "video" / f"{number}", frame)
    answers = recognize(tmp_path / "video", "--track", "--segment", "table", "--json", "--out", tmp_path / "out")
    assert [len(answer["instances"]) for answer in answers] == [2] * len(FRAMES)
    assert (tmp_path / "out" / "2" / "overlay.png").is_file() and segmenter.call_count == len(FRAMES)


def messages_of(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return topic -> (time, message) of a recording, read with the definitions that it holds."""
    messages: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:
        for connection, time, content in reader.messages():
            messages.setdefault(connection.topic, []).append((time, reader.deserialize(content, connection.msgtype)))
    return messages


@pytest.mark.parametrize(
    ("name", "out"),
    [pytest.param("a.bag", "out.mcap", marks=pytest.mark.slow), ("folder", "out"), ("a.mcap", "new/out.mcap")],
)
def test_detections_are_read_back(recognize: Recognize, tmp_path: Path, name: str, out: str) -> None:
    """The objects of the folder are tracked."""
    is_tracked, path = name == "folder", write_recording(tmp_path / name, FRAMES, is_compressed=name == "a.mcap")
    lines = recognize("--bag", path, "--out-bag", tmp_path / out, *["--track"] * is_tracked)
    assert [line["frame"] for line in lines] == [f"1700000000.{k * PERIOD:09d}" for k in range(3)]
    messages = messages_of(tmp_path / out)
    assert set(messages) == {"/thor2/detections", "/thor2/overlay/compressed"}
    for k, (line, (time, array)) in enumerate(zip(lines, messages["/thor2/detections"], strict=True)):
        assert time == START + k * PERIOD == array.header.stamp.sec * 10**9 + array.header.stamp.nanosec
        assert array.header.frame_id == "camera_color_optical_frame"
        for one, detection in zip(line["instances"], array.detections, strict=True):
            (result,) = detection.results
            assert result.hypothesis.class_id == one["name"] and result.hypothesis.score == one["confidence"]
            position = result.pose.pose.position
            assert [position.x, position.y, position.z] == one["position"]
            box = detection.bbox
            corner = box.center.position.x - (box.size_x - 1) / 2, box.center.position.y - (box.size_y - 1) / 2
            assert [*corner, box.size_x, box.size_y] == one["box"]
        assert [detection.id for detection in array.detections] == ["1", "2"]
        expected = [[60 + 3 * k, 80, 50, 70], [180 + 3 * k, 80, 70, 70]]
        np.testing.assert_allclose([one["box"] for one in line["instances"]], expected, atol=2)
        assert line["instances"][0]["position"][2] == pytest.approx(0.8, abs=0.01)
        tracks = [(one.get("track"), one.get("frames")) for one in line["instances"]]
        assert tracks == ([(1, k + 1), (2, k + 1)] if is_tracked else [(None, None)] * 2)
    _, overlay = messages["/thor2/overlay/compressed"][0]
    assert Image.open(io.BytesIO(overlay.data.tobytes())).size == (320, 240)
    assert not [one for one in tmp_path.iterdir() if one.name.startswith(".")]


@pytest.mark.parametrize("segment", [(), pytest.param(("--segment", "model"), marks=pytest.mark.slow)])
def test_every_second_frame_and_pictures(recognize: Recognize, segment: tuple[str, ...], tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.mcap", FRAMES)
    lines = recognize("--bag", path, "--every", 2, "--out", tmp_path / "out", "--unknown-below", 1, *segment)
    assert [line["frame"] for line in lines] == ["1700000000.000000000", "1700000000.066666666"]
    assert all(one["name"] is None for line in lines for one in line["instances"])
    assert sorted(one.name for one in (tmp_path / "out").iterdir()) == [line["frame"] for line in lines]


def test_rerun_files_of_bags_and_folders(model: Path, tmp_path: Path, printed: Command) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (pip install rerun-sdk; 660 MB)")
    path = write_recording(tmp_path / "a.mcap", FRAMES)
    assert run_thor2("recognize", "--model", model, "--bag", path, "--rerun", tmp_path / "bag.rrd") == 0
    write_frame_files(tmp_path / "frames" / "0", FRAMES[0])
    command = ("recognize", "--model", model, tmp_path / "frames", "--segment", "table")
    assert f"written to {tmp_path / 'folder.rrd'}" in printed(*command, "--rerun", tmp_path / "folder.rrd")
    for name in ("bag.rrd", "folder.rrd"):
        assert (tmp_path / name).read_bytes().startswith(b"RRF2")


def test_what_was_done_before_the_end_is_kept(model: Path, tmp_path: Path, texts: Texts) -> None:
    path = write_recording(tmp_path / "a b.mcap", [table_frame(k) for k in range(8)])
    path.write_bytes(path.read_bytes()[: -(10**6)])
    out, err = texts("recognize", "--model", model, "--bag", path, "--out-bag", tmp_path / "out.mcap", status=2)
    n_frames = len(json_lines(out))
    assert 0 < n_frames < 8 and f"mcap recover '{path}' -o" in err and err.count("\n") == 1
    assert f"frames recognized before: {n_frames}, written to {tmp_path / 'out.mcap'}" in err
    assert len(messages_of(tmp_path / "out.mcap")["/thor2/detections"]) == n_frames


def test_odd_frames_of_a_recording(model: Path, tmp_path: Path, texts: Texts) -> None:
    """Frames of one stamp and before 1970 have names of their own; one that fails stops no other."""
    path, out = tmp_path / "a.mcap", tmp_path / "out"
    with bag_writer(path) as write:
        for arrival, stamp in enumerate((-1, START, START, START)):
            write_images(write, FRAMES[0], arrival, stamp, camera=False, frame_id="a\n\x1b[2J")
        write(COLOR, image(FRAMES[0].color[:100], "rgb8", START + PERIOD), START + PERIOD)
        write(DEPTH, image(FRAMES[0].depth, "16UC1", START + PERIOD), START + PERIOD)
    (tmp_path / "K.txt").write_text("290 0 160 0 290 120 0 0 1")
    outputs = ("--intrinsics", tmp_path / "K.txt", "--out", out, "--out-bag", tmp_path / "out.mcap")
    printed, err = texts("recognize", "--model", model, "--bag", path, *outputs, status=2)
    *names, failed = [line["frame"] for line in json_lines(printed)]
    assert names == ["-0.000000001", *(f"1700000000.000000000{end}" for end in ("", "-2", "-3"))]
    assert err.splitlines()[-1].startswith("error: 1 of 5 frames") and f"failed: {failed}" in err
    assert any(line.startswith("note: ") and r"color in a\n\x1b[2J" in line for line in err.splitlines())
    assert sorted(one.name for one in out.iterdir()) == sorted(names)
    messages = messages_of(tmp_path / "out.mcap")["/thor2/detections"]
    assert [time for time, _ in messages] == [0, START, START, START]
    assert (messages[0][1].header.stamp.sec, messages[0][1].header.stamp.nanosec) == (-1, 10**9 - 1)


def test_a_time_out_of_the_range_of_ros_2(model: Path, tmp_path: Path, refused: Command) -> None:
    path, late = tmp_path / "a.mcap", 2**31 * 10**9
    with bag_writer(path) as write:  # images without a time stamp have the time at which they were recorded
        write_images(write, FRAMES[0], late, 0)
    error = refused("recognize", "--model", model, "--bag", path, "--out-bag", tmp_path / "out.mcap", at_once=False)
    assert "error: --out-bag: a frame has the time 2147483648 s" in error
    assert str(tmp_path / "out.mcap") not in error and not (tmp_path / "out.mcap").exists()
