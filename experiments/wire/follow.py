"""Close-up yield of a person who is followed through an emulated dome, and in the simulation with the same rates.

The emulator runs in another process, which judges each frame of the zoom camera by its own truth. The simulation has
the rates of frames that were reached over the wire, the same delays, those of the program's own work among them, and
the same part of the person's path.
"""

import dataclasses
import os
import sys
import time
from collections.abc import Iterable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cotarget.backends import open_rig
from cotarget.cli.emulate import RENDER_THREADS, SWITCH_S
from cotarget.config import RigConfig, parse_config
from cotarget.emulators.emulation import Emulation
from cotarget.emulators.world import paced
from cotarget.evaluation import closeup_of
from cotarget.files import write_atomically
from cotarget.metrics import WHOLLY_VISIBLE
from cotarget.pipeline import Step, follow
from cotarget.rig import opened_from
from cotarget.safety.safe_rig import guard
from cotarget.sim.truth import Truth
from cotarget.sim.world import SimWorld
from experiments.engine import Row
from experiments.wire.rig import exact_calibration, load, talking

NAME = "person"
WATCHDOG_S = 2.0  # a machine that is busy with other things does not halt the head
LEARNT_S = 2.0  # the background is learnt [s]


def run(folder: Path, dome: str, units: str, seconds: float, seed: int) -> list[Row]:
    """Follow over the wire, then in the simulation; give a row."""
    with talking(_emulate, seed, dome, units) as ((text, config, start), pipe):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / "rig.toml", text.encode())
        with open_rig(folder / "rig.toml") as rig:
            begins, own = time.monotonic() - start, opened_from(rig)
            seen = _seen(follow(rig, exact_calibration(config), own.target(NAME), seconds=seconds))
        pipe.send([each.zoom - start for each in seen])
        wire = pipe.recv()
    fixed_hz, zoom_hz = _rate({each.fixed for each in seen}), _rate({each.zoom for each in seen})
    late_s = float(np.median([each.done - each.fixed for each in seen])) - config.sim.fixed.latency_s
    row = {"figure": "follow", "dome": dome, "units": units, "seed": seed, "fixed_hz": fixed_hz, "zoom_hz": zoom_hz}
    sim = _simulated(config, begins, fixed_hz, zoom_hz, late_s, seconds)
    return [row | {"late_s": late_s, "wire": wire, "sim": sim, "load": load()}]


class Times(NamedTuple):
    """Times of a step: of its zoom and fixed frame, and when it was done [s]."""

    zoom: float
    fixed: float
    done: float


def _seen(steps: Iterable[Step]) -> list[Times]:
    return [Times(step.zoom.t, step.fixed.t, step.t) for step in steps]


def _rate(times: set[float]) -> float:
    return (len(times) - 1) / (max(times) - min(times))


def _emulate(pipe: Connection, seed: int, dome: str, units: str) -> None:
    """Serve the emulated rig, then judge the frames that were taken at times of the world [s]."""
    os.environ.setdefault(*RENDER_THREADS)
    sys.setswitchinterval(SWITCH_S)
    sim = {"seed": seed, "targets": [NAME]}
    config = paced(parse_config({"sim": sim}))
    with Emulation(config, dome=dome, units=units) as emulation:
        text = emulation.rig_toml(beside={"safety": {"watchdog_s": WATCHDOG_S}})
        pipe.send((text, emulation.config, emulation.world.clock.monotonic(0.0)))
        if (times := pipe.recv()) is not None:
            pipe.send(_yield(emulation.world.truth(), config, times))
            pipe.recv()


def _simulated(
    config: RigConfig, begins: float, fixed_hz: float, zoom_hz: float, late_s: float, seconds: float
) -> float:
    """Follow in the simulation from a time of the world [s], commands later by ``late_s``; return the yield."""
    sim = dataclasses.replace(
        config.sim,
        fixed=dataclasses.replace(config.sim.fixed, rate_hz=fixed_hz),
        zoom=dataclasses.replace(config.sim.zoom, rate_hz=zoom_hz),
        head=dataclasses.replace(config.sim.head, command_delay_s=config.sim.head.command_delay_s + max(late_s, 0.0)),
    )
    config = dataclasses.replace(config, sim=sim)
    world = SimWorld(config)
    with guard(world.rig, config.safety) as rig:
        rig.clock.sleep_until(begins)
        seen = _seen(follow(rig, exact_calibration(config), config.target(NAME), seconds=seconds))
    return _yield(world.truth(), config, [each.zoom for each in seen])


def _yield(truth: Truth, config: RigConfig, times: Sequence[float]) -> float:
    """Return the part of good close-ups among the frames at some times [s], from when the person is wholly in view."""
    target, wide = config.target(NAME), [truth.silhouette(NAME, "fixed", t) for t in times]
    begin = next((i for i, each in enumerate(wide) if each is not None and each.visible >= WHOLLY_VISIBLE), len(times))
    frames = [t for t in sorted({*times[begin:]}) if t >= times[0] + LEARNT_S]
    shown = [closeup for t in frames if not (closeup := closeup_of(truth, NAME, target, t)).hidden]
    return float(np.mean([closeup.good for closeup in shown])) if shown else 0.0
