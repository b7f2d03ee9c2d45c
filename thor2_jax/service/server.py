"""The service under uvicorn: one process, or several workers behind one socket."""

import contextlib
import copy
import functools
import logging
import os
import signal
import socket
import sys
import tempfile

import uvicorn
from uvicorn.config import LOGGING_CONFIG
from uvicorn.supervisors import Multiprocess

from thor2_jax.service.app import create_app
from thor2_jax.service.connections import TimedConnection
from thor2_jax.service.engine import Engine
from thor2_jax.service.settings import Settings

__all__ = ["serve"]

log = logging.getLogger(__name__)


def serve(settings: Settings, host: str = "127.0.0.1", port: int = 8080, workers: int = 1) -> None:
    """Answer until SIGTERM or SIGINT; then finish what was taken and return.

    Args:
        settings: of each worker.
        host: address to listen at.
        port: to listen at; 0 takes a free one, and the log tells which.
        workers: processes with a model, a queue and preparing processes each.

    Raises:
        InputError: the run cannot be read.
        OSError: the address is taken.
    """
    log_config = copy.deepcopy(LOGGING_CONFIG)
    log_config["loggers"]["thor2_jax.service"] = {"handlers": ["default"], "level": "INFO", "propagate": False}
    config = uvicorn.Config(
        functools.partial(create_app, settings),
        factory=True,
        workers=workers,
        http=TimedConnection,
        ws="none",
        access_log=False,
        server_header=False,
        log_config=log_config,
        timeout_graceful_shutdown=int(settings.deadline) + 5,
        timeout_worker_healthcheck=60,  # a worker imports and compiles at its start
    )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family, backlog=config.backlog) as listening:
        shown = f"[{host}]" if ":" in host else host
        log.info("listening at http://%s:%d", shown, listening.getsockname()[1])
        if workers == 1:
            # uvicorn raises the signal again when all is finished: then that is the end, and no failure.
            signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
            config.load()
            with contextlib.suppress(KeyboardInterrupt):
                uvicorn.Server(config).run([listening])
        else:
            Engine(settings)  # what is wrong with the run is said once, here
            listening.set_inheritable(True)
            with tempfile.TemporaryDirectory() as folder:
                os.environ["PROMETHEUS_MULTIPROC_DIR"] = folder
                Multiprocess(config, [listening]).run()
