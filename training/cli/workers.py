"""Options of the commands that use a worker pool, and the pool that they choose."""

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from thor2_jax.errors import InputError

if TYPE_CHECKING:
    from training.storage.workers import WorkerPool

__all__ = ["AddressOption", "Engine", "EngineOption", "WorkersOption", "worker_pool"]

Engine = Literal["local", "ray"]
WorkersOption = Annotated[int, typer.Option(min=1, help="Worker processes; with Ray, concurrent tasks.")]
EngineOption = Annotated[
    Engine, typer.Option(help="Work on this machine or on a Ray cluster (extra `cluster`), which has the same paths.")
]
AddressOption = Annotated[
    str | None, typer.Option(help="Address of the Ray cluster. Default: the one on this machine.")
]


def worker_pool(workers: int, engine: Engine, address: str | None) -> "WorkerPool | None":
    """Return the worker pool of these options; None stands for this process alone.

    Raises:
        InputError: `address` without Ray, or Ray is not installed.
    """
    from training.storage.workers import local_workers, ray_workers

    if engine == "ray":
        return ray_workers(workers, address)
    if address is not None:
        raise InputError(f"address is {address}; it is only used with --engine ray")
    return local_workers(workers) if workers > 1 else None
