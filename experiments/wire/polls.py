"""Polling rate of the pan-tilt unit's position over a paced pseudo-terminal, against the line's capacity."""

import time
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.ptu_d46 import D46Head, D46Settings
from cotarget.drivers.rig import devices
from cotarget.emulators.ptu_d46.firmware import D46, D46_FAULTS
from cotarget.emulators.ptu_d46.ports import UnitPorts
from cotarget.emulators.ptu_d46.unit import D46_PAPER
from cotarget.emulators.serve import Faults
from experiments.engine import Row
from experiments.wire.process import EmulatedRig
from experiments.wire.rig import Tap, beside, load, tapped

BAUD, BITS = 9600, 10
BYTES_S = BAUD / BITS
NEAR, FAR = (0, 0), (-3000, -1500)  # steps of pan and tilt; the latter have the most digits of a D46's
PAN_DEG, TILT_DEG = (-180.0, 180.0), (-79.97, 29.98)  # ranges of D46_PAPER
UNIT = D46Settings(baud=BAUD, pan_deg=PAN_DEG, tilt_deg=TILT_DEG, speed_deg_s=100.0)
QUESTION = b"PP "  # first query of a pair


class Standing:
    """Axis at rest; an `AxisPlant`."""

    def __init__(self, position: int) -> None:
        self._position = position

    def command(self, goal: int, speed: float, acceleration: float) -> None:
        """Go to the goal at once."""
        self._position = goal

    def halt(self, acceleration: float) -> None:
        """Stay at rest."""

    def position(self) -> int:
        """Position [steps]."""
        return self._position

    def speed(self) -> float:
        """Speed, which is zero."""
        return 0.0

    def moving(self) -> bool:
        """Whether it moves, which is never."""
        return False


def serve(pipe: Connection, position: tuple[int, int]) -> None:
    """Emulate a unit on a pseudo-terminal in another process, until the pipe receives something."""
    pan, tilt = map(Standing, position)
    with UnitPorts(D46(pan, tilt, D46_PAPER, Faults(D46_FAULTS), time.monotonic)) as ports:
        pipe.send(ports.port)
        pipe.recv()


def poll_alone(position: tuple[int, int], seconds: float) -> Row:
    """Poll a unit at rest, with no other load."""
    with beside(serve, position) as port:
        name = "alone, {} and {} steps".format(*position)
        return _poll(name, replace(UNIT, port=port), seconds)


def poll_in_world(folder: Path, seconds: float) -> Row:
    """Poll the unit of an emulated rig while both cameras are rendered."""
    with EmulatedRig(folder, {"sim": {"scene": "outdoor", "targets": ["person"]}}) as emulated:
        return _poll("beside the rendering world", devices(emulated.config().hardware)["head"].settings, seconds)


def run(folder: Path, seconds: float) -> list[Row]:
    """Measure all cases; give a row per case."""
    rows = [poll_alone(NEAR, seconds), poll_alone(FAR, seconds), poll_in_world(folder / "polls", seconds)]
    return [{"figure": "polls", **row, "load": load()} for row in rows]


def _poll(case: str, config: D46Settings, seconds: float) -> Row:
    clock = MonotonicClock()
    with tapped(clock) as taps:
        head = D46Head(config, clock)
        try:
            begun, (first, received) = clock.now(), _count(taps[0])
            clock.sleep_until(begun + seconds)
            took, (last, received_then) = clock.now() - begun, _count(taps[0])
        finally:
            head.close()
    sent = taps[0].written[first:last]
    pairs = sum(data == QUESTION for _, data in sent)
    size = (sum(len(data) for _, data in sent) + received_then - received) / pairs
    return {"case": case, "pairs_s": pairs / took, "bytes": size, "share": pairs / took / (BYTES_S / size)}


def _count(tap: Tap) -> tuple[int, int]:
    return len(tap.written), tap.received
