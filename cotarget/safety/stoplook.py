"""Looks at the stop file on a thread of its own: a file system that hangs must keep nobody from halting the head."""

import math
import threading
from pathlib import Path
from time import monotonic

from cotarget.safety.stopfile import stop_reason

POLL_S = 0.05  # a look takes well below a millisecond; it is waited for in slices of this [s]
# So many slices without an answer, and nobody knows whether somebody has called for a stop. They are counted rather
# than timed, so that a machine that stood still does not count as a file that cannot be looked at.
MOST_MISSED = 6
# A look that began this lately is good enough for a command, which then waits for none: who watches halts the head for
# a file that came meanwhile [s].
RECENT_S = 2 * POLL_S
JOIN_S = 0.2  # for the thread to end, if it is not held by the file [s]


class StopLook:
    """Tells why the head must not move, within a time that does not depend on the file.

    Args:
        path: of the stop file; None for none, which never stops.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._changed = threading.Condition()
        self._asked = self._answered = self._missed = 0
        self._reason: str | None = None
        self._looked_at = -math.inf
        self._thread: threading.Thread | None = None
        self._closed = False

    def reason(self, longest: float | None = None) -> str | None:
        """What a look that begins now says; a file that has not answered for long counts as a stop.

        Args:
            longest: how long to wait for it, and then take the last answer [s]; None to wait for an answer.
        """
        if self._path is None or self._closed:
            return self._reason
        with self._changed:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="cotarget-stop-file", daemon=True)
                self._thread.start()
            self._asked += 1
            question = self._asked
            self._changed.notify_all()
            while True:
                wait = POLL_S if longest is None else min(longest, POLL_S)
                if self._changed.wait_for(lambda: self._answered >= question, wait):
                    return self._reason
                self._missed += wait == POLL_S
                if self._missed >= MOST_MISSED:
                    return f"the stop file cannot be looked at: no answer within {MOST_MISSED * POLL_S:g} s"
                if longest is not None:
                    return self._reason

    def is_clear(self) -> bool:
        """Whether a recent look found no stop; at once."""
        with self._changed:
            return self._path is None or (self._reason is None and monotonic() - self._looked_at <= RECENT_S)

    def close(self) -> None:
        """End the thread; one that the file holds ends when the file lets it go."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(JOIN_S)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._asked > self._answered)
                if self._closed:
                    return
                question = self._asked
            begun = monotonic()
            try:
                reason = stop_reason(self._path)
            except Exception as error:  # who cannot look lets nothing move
                reason = f"the file cannot be read: {error}"
            with self._changed:
                self._answered, self._reason, self._missed, self._looked_at = question, reason, 0, begun
                self._changed.notify_all()
