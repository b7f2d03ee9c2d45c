"""Progress of a command on standard error: bars on a terminal, otherwise plain lines every few seconds."""

import contextlib
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager

from rich import progress
from rich.console import Console

from training.storage.progress import Progress

__all__ = ["show_progress"]

SECONDS_PER_LINE = 5.0


def show_progress(quiet: bool = False) -> AbstractContextManager[Progress]:
    """Return a context whose callback shows the progress of each stage; with `quiet`, it shows nothing."""
    if quiet:
        return contextlib.nullcontext(lambda stage, done, total, note: None)
    return _bars() if sys.stderr.isatty() else contextlib.nullcontext(_Lines())


@contextlib.contextmanager
def _bars() -> Iterator[Progress]:
    tasks: dict[str, progress.TaskID] = {}
    name = progress.TextColumn("{task.description}", markup=False)
    note = progress.TextColumn("{task.fields[note]}", markup=False)
    times = progress.TimeElapsedColumn(), progress.TimeRemainingColumn()
    columns = name, progress.BarColumn(), progress.MofNCompleteColumn(), *times, note
    with progress.Progress(*columns, console=Console(stderr=True)) as bars:

        def show(stage: str, done: int, total: int, note: str) -> None:
            if stage not in tasks:
                # A resumed stage starts at what is already done, so that the remaining time is estimated correctly.
                tasks[stage] = bars.add_task(stage, total=total, completed=done, note=note)
            bars.update(tasks[stage], completed=done, total=total, note=note)

        yield show


class _Lines:
    """Print a line when a stage begins, every few seconds, and when it ends."""

    def __init__(self) -> None:
        self._begun: dict[str, tuple[float, int]] = {}
        self._printed: tuple[str, int] | None = None
        self._next = 0.0

    def __call__(self, stage: str, done: int, total: int, note: str) -> None:
        now = time.monotonic()
        begins = stage not in self._begun
        start, first = self._begun.setdefault(stage, (now, done))
        if (stage, done) == self._printed or not (begins or done >= total or now >= self._next):
            return
        self._printed, self._next = (stage, done), now + SECONDS_PER_LINE
        elapsed = now - start
        parts = [f"{done:,} of {total:,}", note]
        if elapsed >= 1:
            parts.append(f"{elapsed:.0f} s")
            if first < done < total:
                parts.append(f"about {elapsed * (total - done) / (done - first):.0f} s left")
        print(f"{stage}: {', '.join(filter(None, parts))}", file=sys.stderr, flush=True)
