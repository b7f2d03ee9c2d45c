"""The progress callback of long jobs."""

import itertools
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager

__all__ = ["Display", "Progress", "numbered", "of_stage"]

Progress = Callable[[str, int, int, str], object]
"""Called with (stage, done, total, note)."""

Display = Callable[[], AbstractContextManager[Progress]]
"""Opens a progress display, such as `training.cli.progress.show_progress`."""


def of_stage(progress: Progress, stage: str, note: str = "") -> Callable[[int, int], None]:
    """Return the callback of a stage whose note is always the same, called with (done, total)."""

    def show(done: int, total: int) -> None:
        progress(stage, done, total, note)

    return show


def numbered(progress: Progress, stages: Mapping[str, float]) -> Progress:
    """Return a callback that adds to each stage which one of how many it is, and the time left of all to its note.

    The present stage keeps its own pace, and later stages take their shares at the pace of all progress seen so far.
    What a resumed stage has done before does not count.

    Args:
        progress: the callback that is called with both.
        stages: name -> share of the time of all stages, in any unit, in the order of the stages; 0 if it is not known.
            Stages that are not among them stay as they are.
    """
    names = {stage: f"stage {number} of {len(stages)}: {stage}" for number, stage in enumerate(stages, 1)}
    earlier = dict(zip(stages, itertools.accumulate(stages.values(), initial=0.0), strict=False))
    seconds, made, first, last = 0.0, 0.0, (0.0, 0.0), ("", 0.0, 0.0)

    def show(stage: str, done: int, total: int, note: str) -> None:
        nonlocal seconds, made, first, last
        if stages.get(stage):
            now, part = time.monotonic(), earlier[stage] + stages[stage] * done / max(total, 1)
            if stage == last[0]:
                seconds, made = seconds + now - last[1], made + part - last[2]
            else:
                first = now, part
            last, end = (stage, now, part), earlier[stage] + stages[stage]
            pace = seconds / made if made > 0 else 0.0
            own = (now - first[0]) / (part - first[1]) if part > first[1] else pace
            left = own * (end - part) + pace * (sum(stages.values()) - end)
            if seconds >= 1 and left >= 1:
                note = ", ".join(filter(None, (note, f"about {left:.0f} s left of all stages")))
        progress(names.get(stage, stage), done, total, note)

    return show
