"""Time that passes only when somebody waits."""


class SimClock:
    """Simulated time."""

    def __init__(self):
        self.t = 100.0

    def now(self):
        return self.t

    def sleep_until(self, t):
        self.t = max(self.t, t)


class RigClock:
    """The clock of an object whose time is its attribute ``t``; each look at it takes some time [s]."""

    def __init__(self, rig, look_s=0.0):
        self.rig, self._look_s = rig, look_s

    def now(self):
        self.rig.t += self._look_s
        return self.rig.t

    def sleep_until(self, t):
        self.rig.t = max(self.rig.t, t)
