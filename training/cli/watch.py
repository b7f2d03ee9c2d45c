"""`thor2 watch`: a live page with the recognized objects of a recording, a folder or a camera."""

import contextlib
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from thor2_jax.errors import InputError
from training.cli import options
from training.cli.app import app, finish, print_note

NOTICE_SECONDS = 1.0
"""Time for which an error is shown on open pages before the server stops."""


@app.command()
def watch(
    model: options.ModelOption,
    bag: Annotated[Path | None, typer.Option(help="ROS 1 bag, ROS 2 bag or MCAP (extra bags).")] = None,
    folder: Annotated[Path | None, typer.Option(help="Folder of frames.")] = None,
    realsense: Annotated[bool, typer.Option("--realsense", help="A RealSense camera (extra realsense).")] = False,
    segment: Annotated[
        str | None, typer.Option(help="Segmenter. Default: table, in folders only for frames without labels.")
    ] = None,
    track: Annotated[
        bool, typer.Option("--track/--no-track", help="Follow the objects, and fuse the answers of their frames.")
    ] = True,
    color_topic: Annotated[str | None, typer.Option(help="Topic of the colour images in the bag.")] = None,
    depth_topic: Annotated[str | None, typer.Option(help="Topic of the aligned depth images in the bag.")] = None,
    camera_topic: Annotated[str | None, typer.Option(help="Topic of camera_info in the bag.")] = None,
    unknown_below: options.UnknownOption = None,
    answer_by: options.AnswerByOption = None,
    host: options.HostOption = "127.0.0.1",
    allow_host: options.AllowHostOption = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 selects a free one.")] = 8090,
) -> None:
    """Show the recognized objects of a recording or a camera on a live page, until Ctrl-C.

    A bag is played at the speed at which it was recorded; frames are dropped if recognition is slower. All frames of a
    folder are shown.
    """
    # `main` repeats a KeyboardInterrupt that was lost in a finalizer or in a callback of JAX.
    with contextlib.suppress(KeyboardInterrupt), contextlib.ExitStack() as stack:
        from thor2_jax.frames.frames import RecordedFrame
        from thor2_jax.recordings.realsense import RealSenseCamera
        from thor2_jax.segmentation.segmenters import TABLE, load_segmenter
        from thor2_jax.watch.live import Broadcast, LiveView, paced, serve_live
        from training.frame_recognition import RecognizerArguments

        kinds = {"--bag": bag, "--folder": folder, "--realsense": realsense or None}
        given = [name for name, value in kinds.items() if value is not None]
        if len(given) != 1:
            raise InputError(f"sources given: {', '.join(given) or 'none'}; expected one of {', '.join(kinds)}")
        topics: dict[str, Any] = {"color_topic": color_topic, "depth_topic": depth_topic, "camera_topic": camera_topic}
        options.check_belongs("--bag", bag, **topics)
        given_frames = options.FrameOptions(None if folder is None else [folder], bag=bag, **topics)
        segment = segment or (TABLE if folder is None else None)
        segmenter = load_segmenter(segment) if segment else TABLE
        sources = [] if folder is None else given_frames.sources(segment)
        if any(each.files and each.files.labels is None for each in sources):
            segment = TABLE
            load_segmenter(TABLE)  # raises InputError if its package is missing, which frames with labels do not need
        if realsense:
            frames = stack.enter_context(RealSenseCamera()).frames()
        elif folder is not None:
            frames = (RecordedFrame(each.name, each.read, number) for number, each in enumerate(sources))
        else:
            opened = stack.enter_context(given_frames.open_bag())
            for note in opened.notes:
                print_note(f"note: {note}")
            frames = paced(opened.frames())
        arguments = RecognizerArguments(model, unknown_below, answer_by)
        recognizer = arguments.load()
        broadcast = Broadcast()
        url = stack.enter_context(serve_live(broadcast, host, port, allow_host or ()))
        print_note(f"watch at {url}")
        view = LiveView(recognizer.track().update if track else recognizer.recognize, segmenter, broadcast)
        n_shown = 0
        try:
            for recorded in frames:
                view.show(recorded)
                n_shown += 1
        except (InputError, OSError) as error:
            view.publish_state("failed", str(error))
            time.sleep(NOTICE_SECONDS)
            raise
        first_error = f" (first error: {view.first_error})" if view.first_error else ""
        recognized = f"{view.n_frames} of {n_shown} were recognized{first_error}"
        shown = f"no more frames, {recognized}; Ctrl-C ends"
        command = "recognize", *(given_frames.arguments() or ["FRAME"])
        same = {"segment": segment, **vars(arguments), "track": track or None}
        finish(shown, "store the answers", *command, file=sys.stderr, **same, out="answers")
        view.publish_state("ended", f"There are no more frames; {recognized}.")
        while True:
            time.sleep(60)
