"""HTTP connections with limits on a request's head; uvicorn would wait for ever, and take whatever comes."""

import asyncio
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

__all__ = ["TimedConnection"]

HEAD_SECONDS = 5.0
"""For a request's head to be complete: from the opening of a connection, the last answer, and its own first byte."""

REST_SECONDS = 30.0
"""Likewise from an answer that was given before all of its request had arrived: many clients read only then."""

MAX_HEAD = 2**20
"""Bytes that may arrive from the first one of a head before its end does."""


class TimedConnection(HttpToolsProtocol):
    """uvicorn's connection, closed where a head takes too long or is too large; a body has its request's limits.

    Requests whose heads are complete are answered before the connection is closed.
    """

    _timer: asyncio.TimerHandle | None = None
    _in_head = False
    _head_bytes = 0

    def connection_made(self, transport: Any) -> None:
        """Begin to wait for the first head."""
        super().connection_made(transport)
        self._expect_head(HEAD_SECONDS)

    def data_received(self, data: bytes) -> None:
        """Take bytes, and no more of a head that is too large."""
        super().data_received(data)
        self._head_bytes += len(data)
        if self._in_head and self._head_bytes > MAX_HEAD:
            self.flow.pause_reading()
            self.shutdown()

    def on_message_begin(self) -> None:
        """Begin to wait for the rest of a head."""
        super().on_message_begin()
        self._in_head, self._head_bytes = True, 0
        self._expect_head(HEAD_SECONDS)

    def on_headers_complete(self) -> None:
        """The head is there."""
        self._in_head = False
        self._stop_timer()
        super().on_headers_complete()

    def on_response_complete(self) -> None:
        """Begin to wait for the next head: uvicorn's own patience begins again with whatever byte arrives."""
        super().on_response_complete()
        if self.cycle.response_complete:  # else the next head is there already
            self._expect_head(REST_SECONDS if self.cycle.more_body else HEAD_SECONDS)

    def connection_lost(self, exc: Exception | None) -> None:
        """Nothing is waited for any more."""
        self._stop_timer()
        super().connection_lost(exc)

    def _expect_head(self, seconds: float) -> None:
        self._stop_timer()
        self._timer = self.loop.call_later(seconds, self.shutdown)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
