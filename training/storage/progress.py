"""The progress callback of long jobs."""

from collections.abc import Callable, Sequence

__all__ = ["Progress", "numbered"]

Progress = Callable[[str, int, int, str], object]
"""Called with (stage, done, total, note)."""


def numbered(progress: Progress, stages: Sequence[str]) -> Progress:
    """Return a callback that adds to the name of each stage which one of how many it is; other stages stay."""
    names = {stage: f"stage {number} of {len(stages)}: {stage}" for number, stage in enumerate(stages, 1)}
    return lambda stage, done, total, note: progress(names.get(stage, stage), done, total, note)
