"""The clock of real devices."""

import time


class MonotonicClock:
    """The machine's monotonic clock, which setting the time of day does not change."""

    def now(self) -> float:
        """Return the seconds since an arbitrary start."""
        return time.monotonic()

    def sleep_until(self, t: float) -> None:
        """Sleep until the clock shows ``t`` [s]."""
        time.sleep(max(t - self.now(), 0.0))
