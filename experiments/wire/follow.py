"""Close-up yield of a person who is followed through an emulated dome, and in the simulation with the same rates.

The emulator runs in another process, which judges each frame of the zoom camera by its own truth. The simulation has
the rates of frames that were reached over the wire, the same delays, those of the program's own work among them, and
the same part of the person's path. Its head is honest, whatever the emulated dome does; where the lens is kept from
zooming in further than the head can follow, so it is there.
"""

import dataclasses
import os
import sys
import time
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import tomli_w

from cotarget.backends import open_rig
from cotarget.calibration import Calibration
from cotarget.calibration.calibrate import calibrate
from cotarget.cli.emulate import RENDER_THREADS, SWITCH_S
from cotarget.config import BoardConfig, RigConfig, parse_config
from cotarget.emulators.emulation import Emulation
from cotarget.emulators.world import paced
from cotarget.errors import CotargetError
from cotarget.evaluation import closeup_of
from cotarget.files import write_atomically
from cotarget.metrics import WHOLLY_VISIBLE
from cotarget.pipeline import Step, follow
from cotarget.rig import Rig, opened_from
from cotarget.safety.safe_rig import guard
from cotarget.sim.truth import Truth
from cotarget.sim.world import SimWorld
from experiments.engine import Row
from experiments.wire.rig import exact_calibration, load, talking

NAME = "person"
WATCHDOG_S = 2.0  # a machine that is busy with other things does not halt the head
LEARNT_S = 2.0  # the background is learnt [s]
USER, PASSWORD = "operator", "secret"
LATE_STREAM_S = 0.6
PLACEMENTS, STOPS, FAR_PLACEMENTS = 12, 4, 4  # of the board: some minutes, less than by default


@dataclass(frozen=True)
class Dome:
    """A dome that is followed with.

    Attributes:
        profiles: how it deviates from its standard.
        keys: of its table in rig.toml, as bring-up finds them.
        wanted: least yield, over that of the simulation.
        protocol: that moves it.
        latency_s: from light to the arrival of its picture at the stream's server [s]; None for that of the simulation.
        board: whether the rig is calibrated by the board over the wire; by the truth otherwise.
        ends: words of the error that names a dome that cannot be followed with; its yield does not count.
    """

    profiles: tuple[str, ...] = ()
    keys: Mapping[str, Any] = field(default_factory=dict)
    wanted: float = 0.9
    protocol: str = "onvif"
    latency_s: float | None = None
    board: bool = False
    ends: str = ""


STEERED = ("continuous-only",)
SLOW = (*STEERED, "lowest-speed")
DOMES: Mapping[str, Dome] = {
    "visca": Dome(protocol="visca", wanted=0.95),
    "onvif": Dome(wanted=0.95),
    "visca, board": Dome(protocol="visca", wanted=0.95, board=True),
    "onvif, board": Dome(wanted=0.95, board=True),
    "pan-reversed": Dome(("pan-reversed",), {"pan_sign": -1}),
    "tilt-reversed": Dome(("tilt-reversed",), {"tilt_sign": -1}),
    "wide-ranges": Dome(("wide-ranges",)),
    "degrees": Dome(("degrees",)),
    "rounded": Dome(("rounded",), {"slack_deg": 0.8}),
    "stale-status": Dome(("stale-status",), {"status_delay_s": 0.5}),
    "no-status": Dome(("no-status",)),
    "zoom-status": Dome(("zoom-status",)),
    "blocking-status": Dome(("blocking-status",)),
    "always-moving": Dome(("always-moving",)),
    "boolean-status": Dome(("boolean-status",)),
    "timeout-fault": Dome((*STEERED, "timeout-fault")),
    "timeout-ignored": Dome((*STEERED, "timeout-ignored")),
    "stop-fault": Dome((*STEERED, "stop-fault")),
    "stop-ignored": Dome((*STEERED, "stop-ignored")),
    "clock-20s": Dome(("clock-20s",)),
    "clock-10h": Dome(("clock-10h",)),
    "missing-is-zero": Dome(("missing-is-zero",), {"all_axes": True}),
    "pan-alone-ignored": Dome(("pan-alone-ignored",)),
    "relative-only": Dome(("relative-only",)),
    "media2-only": Dome(("media2-only",)),
    "absolute-ignored": Dome(("absolute-ignored",), {"absolute": False}, ends="did not arrive in time"),  # the lens
    "capped-by-zoom": Dome(("capped-by-zoom",), {"zoomed_speeds": [[1.6, 30.0], [2.7, 7.85], [4.4, 4.5], [7.3, 1.5]]}),
    "continuous-only": Dome(STEERED),
    "continuous-only, stops after 0.4 s": Dome((*SLOW, "slow-stop"), {"stop_delay_s": 0.4}, wanted=0.8),
    "continuous-only, stops after 1.1 s": Dome(
        (*SLOW, "slower-stop"), {"stop_delay_s": 1.1, "slack_deg": 0.8}, wanted=0.6
    ),
    "continuous-only, picture late by 0.6 s": Dome(STEERED, wanted=0.8, latency_s=LATE_STREAM_S),
}  # fmt: skip


def run(folder: Path, name: str, seconds: float, seed: int) -> list[Row]:
    """Follow through a dome of `DOMES`, then in the simulation; give a row, with the message of what ended the run."""
    dome, error, seen = DOMES[name], "", list[Times]()
    begun = time.monotonic()
    with (
        mock.patch.dict(os.environ, {"COTARGET_PASSWORD": PASSWORD}),
        talking(_emulate, seed, dome) as ((text, config, start), pipe),
    ):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / "rig.toml", text.encode())
        try:
            with open_rig(folder / "rig.toml") as rig:
                own = opened_from(rig)
                found = _calibrated(rig, own.board, seed) if dome.board else exact_calibration(config)
                begun = time.monotonic()
                for times in _seen(follow(rig, found, own.target(NAME), seconds=seconds)):
                    seen.append(times)
        except CotargetError as failed:
            error = str(failed)
        pipe.send([each.zoom - start for each in seen])
        wire = pipe.recv() if len(seen) > 1 else 0.0
    row = {"figure": "follow", "dome": name, "seed": seed, "wire": wire, "error": error, "load": load()}
    if len(seen) < 2:
        return [row | {"sim": 1.0}]
    fixed_hz, zoom_hz = _rate({each.fixed for each in seen}), _rate({each.zoom for each in seen})
    late_s = float(np.median([each.done - each.fixed for each in seen])) - config.sim.fixed.latency_s
    sim = _simulated(config, dome, begun - start, fixed_hz, zoom_hz, late_s, seconds)
    return [row | {"fixed_hz": fixed_hz, "zoom_hz": zoom_hz, "late_s": late_s, "sim": sim}]


def _calibrated(rig: Rig, board: BoardConfig, seed: int) -> Calibration:
    return calibrate(rig, board, placements=PLACEMENTS, stops=STOPS, far_placements=FAR_PLACEMENTS, seed=seed)


class Times(NamedTuple):
    """Times of a step: of its zoom and fixed frame, and when it was done [s]."""

    zoom: float
    fixed: float
    done: float


def _seen(steps: Iterable[Step]) -> Iterable[Times]:
    return (Times(step.zoom.t, step.fixed.t, step.t) for step in steps)


def _rate(times: set[float]) -> float:
    return (len(times) - 1) / (max(times) - min(times))


def _emulate(pipe: Connection, seed: int, dome: Dome) -> None:
    """Serve the emulated rig, then judge the frames that were taken at times of the world [s]."""
    os.environ.setdefault(*RENDER_THREADS)
    sys.setswitchinterval(SWITCH_S)
    sim: dict[str, Any] = {"seed": seed, "targets": [NAME]}
    if dome.latency_s is not None:
        sim["zoom"] = {"latency_s": dome.latency_s}
    config = paced(parse_config({"sim": sim}))
    with Emulation(config, dome=dome.protocol, user=USER, password=PASSWORD) as emulation:
        for name in dome.profiles:
            emulation.switch(f"ptz.{name}")
        tables = tomllib.loads(emulation.rig_toml(beside={"safety": {"watchdog_s": WATCHDOG_S}}))
        tables["hardware"]["ptz"] |= dome.keys
        pipe.send((tomli_w.dumps(tables), emulation.config, emulation.world.clock.monotonic(0.0)))
        if times := pipe.recv():
            pipe.send(_yield(emulation.world.truth(), config, times))
            pipe.recv()


def _simulated(
    config: RigConfig, dome: Dome, begins: float, fixed_hz: float, zoom_hz: float, late_s: float, seconds: float
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
    speeds = [(times * world.rig.zoom.focal_range[0], np.radians(v)) for times, v in dome.keys.get("zoomed_speeds", ())]
    spec = dataclasses.replace(
        world.rig.spec, head=dataclasses.replace(world.rig.spec.head, zoomed_speeds=tuple(speeds))
    )
    with guard(dataclasses.replace(world.rig, spec=spec), config.safety) as rig:
        rig.clock.sleep_until(begins)
        seen = _seen(follow(rig, exact_calibration(config), config.target(NAME), seconds=seconds))
        times = [each.zoom for each in seen]
    return _yield(world.truth(), config, times)


def _yield(truth: Truth, config: RigConfig, times: Sequence[float]) -> float:
    """Return the part of good close-ups among the frames at some times [s], from when the person is wholly in view."""
    target, wide = config.target(NAME), [truth.silhouette(NAME, "fixed", t) for t in times]
    begin = next((i for i, each in enumerate(wide) if each is not None and each.visible >= WHOLLY_VISIBLE), len(times))
    frames = [t for t in sorted({*times[begin:]}) if t >= times[0] + LEARNT_S]
    shown = [closeup for t in frames if not (closeup := closeup_of(truth, NAME, target, t)).hidden]
    return float(np.mean([closeup.good for closeup in shown])) if shown else 0.0
