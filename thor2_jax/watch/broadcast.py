"""The latest state of a live view, for any number of readers."""

import threading

__all__ = ["Broadcast"]


class Broadcast:
    """The latest message, for which threads may wait. Readers that are slow skip messages."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._number, self._text = 0, ""

    def publish(self, text: str) -> None:
        """Replace the message."""
        with self._changed:
            self._number, self._text = self._number + 1, text
            self._changed.notify_all()

    def wait(self, after: int, timeout: float) -> tuple[int, str] | None:
        """Return the number and the text of a message later than number `after`; None if there is none in time.

        Args:
            after: number of the last message that is known; 0 for none.
            timeout: seconds to wait.
        """
        with self._changed:
            if self._changed.wait_for(lambda: self._number > after, timeout):
                return self._number, self._text
        return None
