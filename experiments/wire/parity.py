"""Parity of the simulation opened directly and over the wire: the head's final aim at a static book.

The simulation swings the book a little, so that both runs must look at the same times of the world. The wire's zoom
camera streams smaller pictures. The book's wanted size is reduced in proportion; otherwise the lens would be at another
position, with another optical axis.
"""

from pathlib import Path

import numpy as np

from cotarget.backends import open_rig
from cotarget.calibration import Calibration
from cotarget.config import RigConfig
from cotarget.emulators.world import paced
from cotarget.pipeline import follow
from cotarget.rig import Rig
from cotarget.safety.safe_rig import guard
from cotarget.sim.world import SimWorld
from experiments.engine import Row
from experiments.wire.process import LONGEST_S, EmulatedRig
from experiments.wire.rig import MOUNT, exact_calibration, load

NAME = "book"
DISTANCE = (5.0, 9.0)  # range of the book's distance [m]
SIDE, HEIGHT = 0.3, 0.12  # largest offset from the fixed camera's axis, relative to the distance
SETTLED_S = 1.0  # averaging time of the head's angles at the end [s]


def run(folder: Path, places: int, seconds: float, seed: int) -> list[Row]:
    """Compare several places; give a row per place."""
    rng = np.random.default_rng(seed)
    return [_one(folder / f"parity_{number}", number, place(rng), seconds) for number in range(places)]


def place(rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw a place in view, x, y, z in the world [m]."""
    y = rng.uniform(*DISTANCE)
    return float(rng.uniform(-SIDE, SIDE) * y), float(y), float(MOUNT + rng.uniform(-HEIGHT, HEIGHT) * y)


def _one(folder: Path, number: int, at: tuple[float, float, float], seconds: float) -> Row:
    tables = {"sim": {"scene": "indoor", "targets": [NAME], "paths": {NAME: [[0.0, *at], [float(LONGEST_S), *at]]}}}
    with EmulatedRig(folder, tables) as emulated:
        calibration = exact_calibration(emulated.sim)
        config = emulated.config()
        with open_rig(config) as rig:
            before = emulated.truth()
            begins = before["world"] + rig.clock.now() - before["t"]
            wire = _aims(rig, config, calibration, seconds)
    step = np.radians(emulated.sim.sim.head.step_deg)
    world = SimWorld(paced(emulated.sim))  # after the end of the emulator, which needs a core
    with guard(world.rig, emulated.sim.safety) as rig:
        rig.clock.sleep_until(begins)
        direct = _aims(rig, emulated.sim, calibration, seconds)
    row = {"figure": "parity", "place": number, "x": at[0], "y": at[1], "z": at[2], "load": load()}
    for axis, name in enumerate(("pan", "tilt")):
        row[f"{name}_steps"] = float(abs(wire[-1][axis] - direct[-1][axis]) / step)
        row[f"{name}_median_steps"] = float(abs(np.median(wire[:, axis]) - np.median(direct[:, axis])) / step)
    return row


def _aims(rig: Rig, config: RigConfig, calibration: Calibration, seconds: float) -> np.ndarray:
    """Follow the book; give pan and tilt of the head at the end, (n, 2) [rad]."""
    target = config.target(NAME)
    steps = list(follow(rig, calibration, target, seconds=seconds))
    return np.array([(s.head.pan, s.head.tilt) for s in steps if s.t >= steps[-1].t - SETTLED_S])
