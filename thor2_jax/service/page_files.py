"""The static files of the page (`page/`, plain HTML, CSS and JavaScript modules), served at /."""

import os
from pathlib import Path
from typing import Any

from starlette.responses import Response
from starlette.staticfiles import StaticFiles

__all__ = ["PageFiles"]

HEADERS = {
    # Scripts, styles, pictures and requests: this server and no other; nothing inline; in no frame.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",  # asked for again each time, sent only if it changed
}


class PageFiles(StaticFiles):
    """The files of the page, with headers that keep it to this server."""

    def __init__(self) -> None:
        super().__init__(directory=Path(__file__).parent / "page", html=True)

    def file_response(self, full_path: str | os.PathLike[str], *args: Any, **kwargs: Any) -> Response:
        """A file's response, with `HEADERS`."""
        response = super().file_response(full_path, *args, **kwargs)
        response.headers.update(HEADERS)
        return response
