"""Adaptation while frames arrive: the colour transform is estimated again, in a thread, from the latest instances."""

import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from thor2_jax.adaptation.estimate import MAX_INSTANCES, MIN_INSTANCES, Adaptation, estimate_transform
from thor2_jax.adaptation.objective import Criterion, Objective
from thor2_jax.frames.prepared_instance import EMPTY_INSTANCE, PreparedInstance

__all__ = ["CAPACITY", "OnlineAdaptation"]

log = logging.getLogger(__name__)

CAPACITY = 2048
"""Most points of an instance that is used, so that one shape is compiled."""

EVERY = 20
"""New instances after which the transform is estimated again."""


class OnlineAdaptation:
    """The colour transform of one camera, from the instances of its latest frames.

    The estimate runs in one thread at a time; instances that arrive meanwhile are kept for the next one.
    """

    def __init__(self, criterion: Criterion, adapted: Callable[[Adaptation], None] = lambda adaptation: None) -> None:
        """Start without instances.

        Args:
            criterion: see `estimate_transform`.
            adapted: called with each new estimate, in the thread that made it.
        """
        self._criterion, self._adapted = criterion, adapted
        self._recent: deque[PreparedInstance] = deque(maxlen=MAX_INSTANCES)
        self._new = 0
        self._thread: threading.Thread | None = None
        self.latest: Adaptation | None = None

    def compile(self) -> None:
        """Compile everything that an estimate needs, by evaluating an instance."""
        Objective([EMPTY_INSTANCE], self._criterion, CAPACITY).total(np.zeros(4))

    def observe(self, instances: Sequence[PreparedInstance]) -> None:
        """Add the instances of a frame, with the camera's colours, and start an estimate if there are enough."""
        usable = [each for each in instances if each.reason is None and len(each.points) <= CAPACITY]
        self._recent.extend(usable)
        self._new += len(usable)
        is_busy = self._thread is not None and self._thread.is_alive()
        if is_busy or self._new < EVERY or len(self._recent) < MIN_INSTANCES:
            return
        self._new = 0
        self._thread = threading.Thread(target=self._estimate, args=(list(self._recent),), name="adapt", daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Return when no estimate is running."""
        if self._thread is not None:
            self._thread.join()

    def _estimate(self, instances: Sequence[PreparedInstance]) -> None:
        try:
            adaptation = estimate_transform(instances, self._criterion, capacity=CAPACITY)
        except Exception:
            log.exception("adaptation failed; the colours are corrected as before")
            return
        self.latest = adaptation
        self._adapted(adaptation)
