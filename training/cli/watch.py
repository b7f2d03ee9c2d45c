"""`thor2 watch`: a live page with the recognized objects of a recording, a folder or a camera."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thor2_jax.errors import InputError
from thor2_jax.printable import escape_characters
from thor2_jax.recordings.topics import Topics
from training.cli import options
from training.cli.app import app, finish

if TYPE_CHECKING:
    from thor2_jax.frames.frames import RecordedFrame

NOTICE_SECONDS = 1.0
"""Time that pages have to show an error before the server ends."""


@app.command()
def watch(
    model: options.ModelOption,
    bag: Annotated[Path | None, typer.Option(help="ROS 1 bag, ROS 2 bag or MCAP (extra bags).")] = None,
    folder: Annotated[Path | None, typer.Option(help="Folder of frames.")] = None,
    realsense: Annotated[bool, typer.Option("--realsense", help="A RealSense camera (extra realsense).")] = False,
    segment: Annotated[
        str | None, typer.Option(help="Segmenter. Default: table; in folders, for frames without labels.")
    ] = None,
    track: Annotated[
        bool, typer.Option("--track/--no-track", help="Follow the objects, and fuse the answers of their frames.")
    ] = True,
    color_topic: Annotated[str | None, typer.Option(help="Colour images of the bag.")] = None,
    depth_topic: Annotated[str | None, typer.Option(help="Aligned depth images of the bag.")] = None,
    camera_topic: Annotated[str | None, typer.Option(help="camera_info of the bag.")] = None,
    unknown_below: options.UnknownOption = None,
    answer_by: options.AnswerByOption = None,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 for other machines.")] = "127.0.0.1",
    allow_host: options.AllowHostOption = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 selects a free one.")] = 8090,
) -> None:
    """Show the recognized objects of a recording or a camera on a live page, until Ctrl-C.

    A bag plays at the speed at which it was recorded; frames for which there is no time are left out. All frames of a
    folder are shown.
    """
    with contextlib.ExitStack() as stack:
        wait = stack.enter_context(_ctrl_c())
        from thor2_jax.recordings.bags import Bag
        from thor2_jax.recordings.realsense import RealSenseCamera
        from thor2_jax.segmentation.segmenters import TABLE, load_segmenter
        from thor2_jax.watch.live import LiveView, paced
        from thor2_jax.watch.server import Broadcast, serve_live
        from training.frame_recognition import RecognizerArguments

        sources = {"--bag": bag, "--folder": folder, "--realsense": realsense or None}
        given = [name for name, value in sources.items() if value is not None]
        if len(given) != 1:
            raise InputError(f"{' and '.join(given) or 'no source'} is given; expected one of {', '.join(sources)}")
        topics = Topics(color_topic, depth_topic, camera_topic)
        if bag is None and topics != Topics():
            raise InputError("color_topic, depth_topic and camera_topic belong to --bag")
        segmenter = load_segmenter(segment or TABLE)
        if folder is not None:
            frames = _folder_frames(folder, relabel=segment is not None)
        elif bag is None:
            frames = stack.enter_context(RealSenseCamera()).frames()
        else:
            opened = stack.enter_context(Bag(bag, topics))
            for note in opened.notes:
                print(escape_characters(f"note: {note}"), file=sys.stderr)
            frames = paced(opened.frames(), sleep=wait)
        recognizer = RecognizerArguments(model, unknown_below, answer_by).load()
        broadcast = Broadcast()
        url = stack.enter_context(serve_live(broadcast, host, port, allow_host or ()))
        print(f"watch at {url}", file=sys.stderr, flush=True)
        view = LiveView(recognizer.track().update if track else recognizer.recognize, segmenter, broadcast)
        try:
            for recorded in frames:
                if wait(0):
                    return
                view.show(recorded)
        except (InputError, OSError) as error:
            view.publish_state("failed", str(error))
            wait(NOTICE_SECONDS)
            raise
        view.publish_state("ended", f"There are no more frames; {view.n_frames} were recognized.")
        shown = f"no more frames, {view.n_frames} were recognized; Ctrl-C ends"
        source = [folder or "FRAME"] if bag is None else ["--bag", bag]
        finish(shown, "keep the names", "recognize", *source, "--model", model, "--out", "answers", file=sys.stderr)
        wait(None)


@contextlib.contextmanager
def _ctrl_c() -> Iterator[Callable[[float | None], bool]]:
    """Yield a function that waits for Ctrl-C, at most for some seconds, and returns whether it has been pressed.

    Python's own handler raises an exception, which gets lost where JAX ignores those of its callbacks.
    """
    awaited = threading.Lock()  # Signal handlers may release it, but not set an Event.
    awaited.acquire()

    def press(*_: object) -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        if awaited.locked():
            awaited.release()
        os.write(2, b"ending after this frame; Ctrl-C again ends at once\n")  # A handler may not print.

    def wait(seconds: float | None) -> bool:
        is_pressed = awaited.acquire(timeout=-1 if seconds is None else seconds)
        if is_pressed:
            awaited.release()
        return is_pressed

    previous = signal.getsignal(signal.SIGINT)
    if previous is not signal.SIG_IGN:  # Background jobs ignore it.
        signal.signal(signal.SIGINT, press)
    try:
        yield wait
    finally:
        signal.signal(signal.SIGINT, previous)


def _folder_frames(folder: Path, relabel: bool) -> Iterator["RecordedFrame"]:
    """Return the frames of a folder; with `relabel`, without their labels."""
    import dataclasses
    import functools

    from thor2_jax.frames.frames import RecordedFrame, RGBDFrame
    from training.readers.frame_files import FrameSource, find_frames

    def read(source: FrameSource) -> RGBDFrame:
        try:
            frame = source.read()
        except OSError as error:
            raise InputError(f"{error.filename}: {error.strerror or error}") from None
        return dataclasses.replace(frame, labels=None) if relabel else frame

    sources = find_frames([folder])
    return (RecordedFrame(source.name, functools.partial(read, source), k) for k, source in enumerate(sources))
