"""The clock of real devices."""

import time


class MonotonicClock:
    """The machine's own clock, which nobody sets."""

    def now(self) -> float:
        """Seconds since some start."""
        return time.monotonic()

    def sleep_until(self, t: float) -> None:
        """Return when the clock shows ``t`` [s]."""
        time.sleep(max(t - self.now(), 0.0))
