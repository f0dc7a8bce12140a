"""Time for drivers that passes only when somebody waits."""


class SimClock:
    """Simulated time."""

    def __init__(self):
        self.t = 100.0

    def now(self):
        return self.t

    def sleep_until(self, t):
        self.t = max(self.t, t)
