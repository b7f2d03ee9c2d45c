"""The local web server of a live view: the page, and its messages as server-sent events.

with serve_live(broadcast, port=0) as url:
    ...
"""

import contextlib
import socket
import threading
from collections.abc import Iterator, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from thor2_jax.service.hosts import check_host_names, is_allowed_host, listening, page_headers

__all__ = ["Broadcast", "serve_live"]

_PAGE = Path(__file__).parent / "page"
_SERVICE_PAGE = Path(__file__).parents[1] / "service" / "page"

_FILES = {
    "/": (_PAGE / "index.html", "text/html; charset=utf-8"),
    "/watch.js": (_PAGE / "watch.js", "text/javascript; charset=utf-8"),
    "/watch.css": (_PAGE / "watch.css", "text/css; charset=utf-8"),
    "/style.css": (_SERVICE_PAGE / "style.css", "text/css; charset=utf-8"),
    "/icon.svg": (_SERVICE_PAGE / "icon.svg", "image/svg+xml"),
}
"""Path -> file and content type."""

_HEADERS = page_headers("'self' data:", "no-store")

KEEP_ALIVE = 2.0
"""Seconds without a message after which a comment is sent, so that a closed connection is noticed."""


class Broadcast:
    """The latest message, for which threads may wait. Readers that are slow skip messages."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._number, self._text = 0, ""

    def publish(self, text: str) -> None:
        """Replace the message."""
        with self._changed:
            self._number, self._text = self._number + 1, text
            self._changed.notify_all()

    def wait(self, after: int, timeout: float) -> tuple[int, str] | None:
        """Return the number and the text of a message later than number `after`; None if there is none in time.

        Args:
            after: number of the last message that is known; 0 for none.
            timeout: seconds to wait.
        """
        with self._changed:
            if self._changed.wait_for(lambda: self._number > after, timeout):
                return self._number, self._text
        return None


class _Server(ThreadingHTTPServer):
    def __init__(self, listener: socket.socket, broadcast: Broadcast, allow_host: Sequence[str]) -> None:
        super().__init__(listener.getsockname(), _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listener
        self.broadcast, self.allow_host, self.is_stopping = broadcast, allow_host, threading.Event()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore what goes wrong with a single connection: the browser has closed it."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = 30

    def do_GET(self) -> None:
        """Answer with a file, or with the messages of the live view."""
        address = self.connection.getsockname()[0]
        if not is_allowed_host(self.headers.get("Host", ""), address, self.server.allow_host):
            self.send_error(403, "Host is another server's; see --allow-host")
        elif self.path == "/events":
            self._send_events()
        elif self.path in _FILES:
            file, kind = _FILES[self.path]
            content = file.read_bytes()
            self._start(kind)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)
        else:
            self.send_error(404)

    def _start(self, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        for name, value in _HEADERS.items():
            self.send_header(name, value)

    def _send_events(self) -> None:
        self._start("text/event-stream")
        self.end_headers()
        number = 0
        while not self.server.is_stopping.is_set():
            message = self.server.broadcast.wait(number, KEEP_ALIVE)
            if message is None:
                self.wfile.write(b":\n\n")
            else:
                number, text = message
                self.wfile.write(f"data: {text}\n\n".encode())
            self.wfile.flush()

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: a page makes one request for each file."""


@contextlib.contextmanager
def serve_live(
    broadcast: Broadcast, host: str = "127.0.0.1", port: int = 8090, allow_host: Sequence[str] = ()
) -> Iterator[str]:
    """Serve a live view in threads of this process; yield its address.

    Args:
        broadcast: the messages.
        host: address to listen on.
        port: port to listen on; 0 chooses a free one.
        allow_host: names that the header Host may have, besides loopback names and the address that is connected to.

    Raises:
        InputError: the address cannot be used, or a name is none.
    """
    check_host_names(allow_host)
    with listening(host, port) as (listener, url), _Server(listener, broadcast, (*allow_host, host)) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
        thread.start()
        try:
            yield url
        finally:
            server.is_stopping.set()
            server.shutdown()
            thread.join()
