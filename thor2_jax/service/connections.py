"""HTTP connections with limits on the request head; uvicorn itself has neither a timeout nor a size limit there."""

import asyncio
from typing import Any, cast

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

__all__ = ["TimedConnection"]

HEAD_SECONDS = 5.0
"""Time limit for a complete request head, counted from the connection, the previous answer and its own first byte."""

EARLY_ANSWER_SECONDS = 30.0
"""The same limit after an answer that preceded the end of its request: many clients send everything before reading."""

MAX_HEAD = 2**20
"""Maximum number of bytes received between the first byte of a request head and its end."""


class _SafeTransport:
    """Transport that discards data once it is closing.

    Between the reset of a connection and the notification of the application, uvloop raises an error for each write.
    """

    def __init__(self, transport: Any) -> None:
        self._transport = transport

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        """Send data, or discard it if the connection is closing."""
        if not self._transport.is_closing():
            self._transport.write(data)


class TimedConnection(HttpToolsProtocol):
    """uvicorn connection that is closed if a request head arrives too slowly or is too large.

    Requests with complete heads are answered before the connection is closed. Bodies are limited by `uploads`.
    """

    _timer: asyncio.TimerHandle | None = None
    _in_head = False
    _head_bytes = 0

    def connection_made(self, transport: Any) -> None:
        """Start the timer of the first request head."""
        super().connection_made(cast(asyncio.Transport, _SafeTransport(transport)))
        self._expect_head(HEAD_SECONDS)

    def data_received(self, data: bytes) -> None:
        """Process received bytes, and close the connection if a request head is too large."""
        super().data_received(data)
        self._head_bytes += len(data)
        if self._in_head and self._head_bytes > MAX_HEAD:
            self.flow.pause_reading()
            self.shutdown()

    def on_message_begin(self) -> None:
        """Start the timer of a request head that has begun."""
        super().on_message_begin()
        self._in_head, self._head_bytes = True, 0
        self._expect_head(HEAD_SECONDS)

    def on_headers_complete(self) -> None:
        """Stop the timer: the request head is complete."""
        self._in_head = False
        self._stop_timer()
        super().on_headers_complete()

    def on_response_complete(self) -> None:
        """Start the timer of the next request head; uvicorn restarts its own keep-alive timer with every byte."""
        super().on_response_complete()
        if self.cycle.response_complete:  # Otherwise the next request is already complete.
            self._expect_head(EARLY_ANSWER_SECONDS if self.cycle.more_body else HEAD_SECONDS)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        self._stop_timer()
        super().connection_lost(exc)

    def _expect_head(self, seconds: float) -> None:
        self._stop_timer()
        self._timer = self.loop.call_later(seconds, self.shutdown)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
