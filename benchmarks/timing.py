"""Timing of functions on a device: time of the first call, and median time of later calls."""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

__all__ = ["Timing", "print_step", "seconds_of", "time_calls"]


class Timing(NamedTuple):
    """Seconds of the first call, which includes compilation, and the median of later calls."""

    first: float
    median: float


def seconds_of(function: Callable[[], Any]) -> float:
    """Call `function`, wait for its result, and return the elapsed seconds."""
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def time_calls(function: Callable[[], Any], seconds: float = 2.0, least: int = 5) -> Timing:
    """Call `function` at least `least` times and for at least `seconds`, waiting for each result."""
    first = seconds_of(function)
    calls: list[float] = []
    while len(calls) < least or sum(calls) < seconds:
        calls.append(seconds_of(function))
    return Timing(first, statistics.median(calls))


def print_step(text: str) -> None:
    """Print what a long command does now, with the time of day."""
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)
