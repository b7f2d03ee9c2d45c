"""Timing of functions on a device: time of the first call, and median time of later calls."""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

__all__ = ["Timing", "print_step", "time_calls"]


class Timing(NamedTuple):
    """Seconds of the first call, which includes compilation, and the median of later calls."""

    first: float
    median: float


def time_calls(function: Callable[[], Any], seconds: float = 2.0, least: int = 5) -> Timing:
    """Call `function` at least `least` times and for at least `seconds`, waiting for each result."""

    def once() -> float:
        start = time.perf_counter()
        jax.block_until_ready(function())
        return time.perf_counter() - start

    first = once()
    calls: list[float] = []
    while len(calls) < least or sum(calls) < seconds:
        calls.append(once())
    return Timing(first, statistics.median(calls))


def print_step(text: str) -> None:
    """Print what a long command does now, with the time of day."""
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)
