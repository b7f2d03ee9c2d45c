"""`thor2 serve`: the HTTP service."""

import dataclasses
import os
import shutil
from multiprocessing.util import get_temp_dir
from pathlib import Path
from typing import Annotated

import typer

from thor2_jax.errors import needs_extra
from training.cli import options
from training.cli.app import app


@dataclasses.dataclass(frozen=True)
class ServiceOptions:
    """Options that are fields of `Settings`."""

    model: options.ModelOption
    processes: Annotated[
        int, typer.Option(min=1, max=options.MAX_WORKERS, help="Processes per worker that decode and prepare frames.")
    ] = 2
    queue: Annotated[int, typer.Option(min=1, help="Concurrent requests per worker; others get status 429.")] = 32
    deadline: Annotated[float, typer.Option(help="Seconds per request before it gets status 504.")] = 5.0
    max_batch: Annotated[int, typer.Option(help="Largest number of clouds in a device batch.")] = 32
    unknown_below: options.UnknownOption = None
    cache: Annotated[
        Path | None, typer.Option(help="Directory for compiled programs. Default: the user's cache directory.")
    ] = None
    gallery: options.GalleryOption = None
    teach: Annotated[bool, typer.Option("--teach", help="Let clients enroll and forget objects.")] = False
    adapt: Annotated[
        bool, typer.Option("--adapt", help="Estimate the camera's colours from the latest frames, and correct them.")
    ] = False
    warm_why: Annotated[
        bool,
        typer.Option(
            help="Compile explanations (/v1/why) in the background after the start, rather than at the first request."
        ),
    ] = True


@app.command()
@options.grouped_options
def serve(
    given: ServiceOptions,
    host: options.HostOption = "127.0.0.1",
    allow_host: options.AllowHostOption = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 selects a free port, which is logged.")] = 8080,
    workers: Annotated[
        int, typer.Option(min=1, max=options.MAX_WORKERS, help="Server processes, each with its own model and queue.")
    ] = 1,
    segment: Annotated[
        str | None,
        typer.Option(help="Segmenter for frames without labels, or none. Default: table, if OpenCV is installed."),
    ] = None,
    token: Annotated[
        str | None, typer.Option(envvar="THOR2_TOKEN", help="Bearer token that clients must send.")
    ] = None,
) -> None:
    """Serve recognition over HTTP (extra `serve`); see /openapi.json."""
    from thor2_jax.processes import ended_by_signals

    with ended_by_signals():
        with needs_extra("serve", "FastAPI and uvicorn", "serve"):
            from thor2_jax.service.server import serve as serve_forever
        from thor2_jax.service.settings import Settings, default_segmenter

        settings = Settings(
            token=os.environ.get("THOR2_TOKEN") if token is None else token,  # Typer ignores an empty variable
            segmenter=default_segmenter() if segment is None else segment if segment != "none" else None,
            allow_host=tuple(allow_host or ()),
            **vars(given),
        )
    serve_forever(settings, host, port, workers)
    shutil.rmtree(get_temp_dir(), ignore_errors=True)  # as a normal exit does, which would wait for a compilation
    os._exit(0)
