"""Options of the commands that use a worker pool, and the pool that they choose."""

import dataclasses
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from thor2_jax.errors import InputError

if TYPE_CHECKING:
    from training.storage.workers import WorkerPool

__all__ = ["MAX_WORKERS", "Engine", "WorkerOptions"]

Engine = Literal["local", "ray"]

MAX_WORKERS = 1024
"""Largest number of processes of a command: each needs memory and open files."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorkerOptions:
    """Where a command computes."""

    workers: Annotated[
        int, typer.Option(min=1, max=MAX_WORKERS, help="Worker processes; with Ray, concurrent tasks.")
    ] = 1
    engine: Annotated[
        Engine,
        typer.Option(help="Work on this machine or on a Ray cluster (extra `cluster`), which has the same paths."),
    ] = "local"
    address: Annotated[
        str | None, typer.Option(help="Address of the Ray cluster. Default: the one on this machine.")
    ] = None

    def pool(self) -> "WorkerPool | None":
        """Return the worker pool of these options; None stands for this process alone.

        Raises:
            InputError: `address` without Ray, or Ray is not installed.
        """
        from training.storage.workers import local_workers, ray_workers

        if self.engine == "ray":
            return ray_workers(self.workers, self.address)
        if self.address is not None:
            raise InputError(f"address is {self.address}; it is only used with --engine ray")
        return local_workers(self.workers) if self.workers > 1 else None
