"""Serving with uvicorn: one process, or several workers that share a socket, and HTTP connections with limits.

uvicorn itself has neither a timeout nor a size limit for the head of a request.
"""

import asyncio
import contextlib
import dataclasses
import functools
import logging
import os
import signal
import socket
import tempfile
from multiprocessing.util import get_temp_dir

import uvicorn
from fastapi import FastAPI
from prometheus_client.multiprocess import mark_process_dead
from uvicorn.config import LOGGING_CONFIG
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.supervisors import Multiprocess

from thor2_jax.errors import InputError
from thor2_jax.files import file_digest
from thor2_jax.model.run_record import RUN_FILE
from thor2_jax.processes import end_with_parent, ended_by_signals, signals_blocked, signals_handled
from thor2_jax.service.app import create_app
from thor2_jax.service.engine import InferenceEngine
from thor2_jax.service.hosts import listening, page_headers
from thor2_jax.service.settings import Settings

__all__ = ["TimedConnection", "serve"]

log = logging.getLogger(__name__)

HEAD_SECONDS = 5.0
"""Time limit for a complete request head, in seconds from the connection, the previous response or its first byte."""

EARLY_ANSWER_SECONDS = 30.0
"""This limit after a response that preceded the end of its request, since many clients send everything first."""

UNREAD_MS = 60_000
"""Time limit, on Linux, for a client that reads nothing of a response, which is in memory until then; milliseconds."""

MAX_HEAD = 2**20
"""Largest number of bytes received between the first byte of a request head and its end."""


def serve(settings: Settings, host: str = "127.0.0.1", port: int = 8080, workers: int = 1) -> None:
    """Serve until SIGTERM, SIGINT or SIGHUP, then finish the accepted requests and return.

    A thread may still be compiling or computing explanations then; a normal exit of the process waits for it.

    Args:
        settings: settings of each worker.
        host: address to listen on.
        port: port to listen on; 0 chooses a free port, which the log names.
        workers: number of processes, each with its own model, queue and preparation processes.

    Raises:
        InputError: the run cannot be read, or the address is in use.
    """
    # uvicorn raises SIGTERM again after the shutdown, and it then is like SIGINT. A closed terminal is like SIGTERM.
    ending = {signal.SIGTERM: signal.default_int_handler, signal.SIGHUP: lambda *_: signal.raise_signal(signal.SIGTERM)}
    with listening(host, port) as (listener, url), signals_handled(ending):
        digest = None
        if workers > 1:
            with ended_by_signals():
                InferenceEngine(settings)  # Report an unreadable run once, not once per worker.
            digest = file_digest(settings.model / RUN_FILE)
        settings = dataclasses.replace(settings, allow_host=(*settings.allow_host, host))
        loggers = {"thor2_jax.service": {"handlers": ["default"], "level": "INFO", "propagate": False}}
        loggers["python_multipart"] = {"level": "CRITICAL"}  # It warns of invalid forms, which are refused.
        config = uvicorn.Config(
            functools.partial(_create_worker, settings, workers, digest),
            factory=True,
            workers=workers,
            loop="asyncio",  # uvloop raises an error for each answer to a connection that was reset.
            http=TimedConnection,
            ws="none",
            access_log=False,
            server_header=False,
            # Browsers revalidate each file of the page and transfer it only if it changed.
            headers=list(page_headers("'self'", "no-cache").items()),
            log_config={**LOGGING_CONFIG, "loggers": LOGGING_CONFIG["loggers"] | loggers},
            timeout_graceful_shutdown=int(settings.deadline) + 5,
            timeout_worker_healthcheck=60,  # A worker does not answer while it imports modules.
        )
        if workers == 1:
            config.load()
            log.info("listening at %s", url)
            with contextlib.suppress(KeyboardInterrupt):
                uvicorn.Server(config).run([listener])
        else:
            log.info("listening at %s; requests wait until a worker is ready", url)
            # Workers inherit the directory of this process for sockets, which they leave, since they end by a signal.
            with tempfile.TemporaryDirectory(dir=get_temp_dir()) as directory:
                os.environ["PROMETHEUS_MULTIPROC_DIR"] = directory
                on_hangup = signal.getsignal(signal.SIGHUP)
                supervisor = _Supervisor(config, [listener])
                signal.signal(signal.SIGHUP, on_hangup)  # uvicorn would replace the workers
                supervisor.run()


class _Supervisor(Multiprocess):
    """uvicorn's supervisor; it alone receives the signals of a terminal, and ends its workers with SIGTERM."""

    def init_processes(self) -> None:
        """Start the workers."""
        with signals_blocked(signal.SIGINT, signal.SIGHUP):
            super().init_processes()

    def keep_subprocess_alive(self) -> None:
        """Replace workers that have died; their requests no longer count as in progress."""
        for process in self.processes:  # A health check ends at once if only the worker had its end of the pipe.
            process.child_conn.close()
        before = {process.pid for process in self.processes}
        with signals_blocked(signal.SIGINT, signal.SIGHUP):
            super().keep_subprocess_alive()
        for pid in before - {process.pid for process in self.processes}:
            mark_process_dead(pid)

    def terminate_all(self) -> None:
        """End the workers; new connections are refused at once, since no process accepts them any longer."""
        for listener in self.sockets:
            listener.close()
        super().terminate_all()


def _create_worker(settings: Settings, workers: int, digest: str | None = None) -> FastAPI:
    """Create the application of one process; a worker finishes the accepted requests when its parent has ended.

    Raises:
        InputError, OSError: as `create_app`, in a single process.
        SystemExit: the same in a worker, which replaces another one after the run has changed; or `digest` is not the
            digest of the run's record, since the other workers answer by the former model.
    """
    end_with_parent(signal.SIGTERM)
    with ended_by_signals():  # uvicorn's handler would wait for the compilation.
        try:
            if digest is not None and file_digest(settings.model / RUN_FILE) != digest:
                raise InputError(f"model: {settings.model} has changed since the start; restart the service to use it")
            return create_app(settings, workers)
        except (InputError, OSError) as error:
            raise error if workers == 1 else SystemExit(f"error: a worker cannot start: {error}") from None


class TimedConnection(HttpToolsProtocol):
    """uvicorn connection that is closed if a request head arrives too slowly or is too large, or nothing is read.

    Requests with complete heads are answered before the connection is closed. Bodies are limited by `decoding`.
    """

    _in_head = False
    _head_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timer of the first request head."""
        super().connection_made(transport)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # only on Linux
            transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNREAD_MS)
        self._timer = self.loop.call_later(HEAD_SECONDS, self.shutdown)

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
        self._timer.cancel()
        super().on_headers_complete()

    def on_response_complete(self) -> None:
        """Start the timer of the next request head; uvicorn restarts its own keep-alive timer with every byte."""
        super().on_response_complete()
        if self.cycle.response_complete:  # Otherwise the next request is already complete.
            self._expect_head(EARLY_ANSWER_SECONDS if self.cycle.more_body else HEAD_SECONDS)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        self._timer.cancel()
        super().connection_lost(exc)

    def _expect_head(self, seconds: float) -> None:
        self._timer.cancel()
        self._timer = self.loop.call_later(seconds, self.shutdown)
