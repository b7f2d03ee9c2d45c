"""The progress callback of long jobs."""

import itertools
import time
from collections.abc import Callable, Mapping

__all__ = ["Progress", "numbered"]

Progress = Callable[[str, int, int, str], object]
"""Called with (stage, done, total, note)."""


def numbered(progress: Progress, stages: Mapping[str, float]) -> Progress:
    """Return a callback that adds to each stage which one of how many it is, and the time left of all to its note.

    Args:
        progress: the callback that is called with both.
        stages: name -> share of the time of the whole job, in any unit, in the order of the stages. Stages that are not
            among them stay as they are.
    """
    names = {stage: f"stage {number} of {len(stages)}: {stage}" for number, stage in enumerate(stages, 1)}
    earlier = dict(zip(stages, itertools.accumulate(stages.values(), initial=0.0), strict=False))
    whole = sum(stages.values())
    begun: list[tuple[float, float]] = []

    def show(stage: str, done: int, total: int, note: str) -> None:
        if stage in names:
            now, part = time.monotonic(), earlier[stage] + stages[stage] * done / max(total, 1)
            begun.append((now, part))
            start, first = begun[0]
            del begun[1:]
            if now - start >= 1 and first < part < whole:
                left = (now - start) * (whole - part) / (part - first)
                note = ", ".join(filter(None, (note, f"about {left:.0f} s left in all")))
        progress(names.get(stage, stage), done, total, note)

    return show
