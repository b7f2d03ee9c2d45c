"""Static files of the web page (`page/`: HTML, CSS and JavaScript modules without a build step), served at /."""

import os
from pathlib import Path
from typing import Any

from starlette.responses import Response
from starlette.staticfiles import StaticFiles

__all__ = ["PageFiles"]

HEADERS = {
    # The page loads from and connects to its own server only, has no inline code and cannot be framed.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",  # Browsers revalidate each file and transfer it only if it changed.
}


class PageFiles(StaticFiles):
    """Static files of the page with security headers."""

    def __init__(self) -> None:
        super().__init__(directory=Path(__file__).parent / "page", html=True)

    def file_response(self, full_path: str | os.PathLike[str], *args: Any, **kwargs: Any) -> Response:
        """Return the response for a file, with `HEADERS`."""
        response = super().file_response(full_path, *args, **kwargs)
        response.headers.update(HEADERS)
        return response
