"""One pan-tilt unit at two lines: a firmware for each, in front of the same axes.

A line serves one firmware. What is wrong is wrong with both of them; but what happens once, a gap in the power or a
blow against a limit, happens to the one that somebody speaks to, or nobody would be told.
"""

from collections.abc import Callable

from cotarget.emulators.d46 import D46, UnitProfile
from cotarget.emulators.faults import Faults
from cotarget.emulators.plant import AxisPlant

ONCE = ("power-cycle", "limit-hit")


def make_twins(
    pan: AxisPlant, tilt: AxisPlant, unit: UnitProfile, faults: Faults, now: Callable[[], float]
) -> tuple[D46, D46]:
    """Make both firmwares; the arguments are a `D46`'s."""
    last = _Last()
    first, second = (_Twin(pan, tilt, unit, _TwinFaults(faults, number, last), now) for number in range(2))
    return first, second


class _Last:
    """Which of the two was spoken to last; None before anybody has spoken."""

    number: int | None = None


class _TwinFaults(Faults):
    """The faults as one of the two has them."""

    def __init__(self, both: Faults, number: int, last: _Last) -> None:
        super().__init__(both.known)
        self._both, self._number, self._last = both, number, last

    def spoken_to(self) -> None:
        self._last.number = self._number

    def set(self, name: str, on: bool = True) -> None:
        self._both.set(name, on)

    def __contains__(self, name: str) -> bool:
        return name in self._both and self._concerns(name)

    def take(self, name: str) -> bool:
        return self._concerns(name) and self._both.take(name)

    def wait_while(self, name: str, timeout: float) -> bool:
        return self._both.wait_while(name, timeout)

    def _concerns(self, name: str) -> bool:
        return name not in ONCE or self._last.number == self._number


class _Twin(D46):
    """One of the two."""

    def __init__(
        self, pan: AxisPlant, tilt: AxisPlant, unit: UnitProfile, faults: _TwinFaults, now: Callable[[], float]
    ) -> None:
        super().__init__(pan, tilt, unit, faults, now)
        self._spoken_to = faults.spoken_to

    def receive(self, data: bytes) -> None:
        self._spoken_to()
        super().receive(data)
