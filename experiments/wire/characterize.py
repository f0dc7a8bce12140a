"""What `cotarget characterize` finds of domes that were drawn by seed, against the truth of their emulators.

A dome is drawn: how it is moved, what it does otherwise than its standard, which way its axes and its picture are
turned, its delays. `rig.toml` knows none of that: its angles are off by up to a quarter and its field of view by a
tenth. The command runs as a user runs it, a second time where it asks for that, and its keys are compared with the
truth.
"""

import math
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import tomli_w

from cotarget.backends import open_rig
from cotarget.characterization import SLOW_DEG_S
from cotarget.cli.emulate import RENDER_THREADS, SWITCH_S
from cotarget.config import RigConfig, parse_config
from cotarget.emulators.emulation import Emulation
from cotarget.emulators.onvif import BLOCK
from cotarget.emulators.world import paced
from cotarget.errors import DeviceError
from cotarget.files import write_atomically
from cotarget.rig import Rig
from cotarget.sim.world import SimWorld
from experiments.engine import Row
from experiments.wire.follow import PASSWORD, USER
from experiments.wire.rig import load, talking

FIXED_HZ = 5.0  # of the fixed camera, of which the command takes one picture; the watchdog wants three in a second
LONGEST_S = 600.0  # a command that takes longer is given up [s]
MOST_TIMES = 2  # that the command is run
AGAIN = "again"  # in the words of the command, where a second time would find more
STOPS_S = {"": 0.0, "slow-stop": 0.4, "slower-stop": 1.1}
MOVES, FRAMES = 8, 40  # by which the true delays are measured
AT_ONCE_DEG = 2.0
LONGEST_MOVE_S = 20.0  # for the head to stand after each of these moves


@dataclass(frozen=True)
class Facts:
    """What a drawn dome does.

    Attributes:
        profiles: how it deviates from its standard.
        signs: of its pan and tilt, -1 where they count the other way.
        scale: true angles of pan and tilt over those of rig.toml.
        wide: horizontal field of view in rig.toml over the true one.
        picture: how its picture is turned: "upside-down", "mirrored", or both.
        latency_s: from light to the arrival of its picture at the stream's server.
        delay_s: from a command to the start of motion.
        stop_s: by which a stop takes longer.
    """

    profiles: tuple[str, ...]
    signs: tuple[int, int]
    scale: tuple[float, float]
    wide: float
    picture: tuple[str, ...]
    latency_s: float
    delay_s: float
    stop_s: float


def drawn(seed: int) -> Facts:
    """Draw a dome."""
    random = np.random.default_rng(seed)

    def one_of(*names: str) -> tuple[str, ...]:
        name = str(random.choice(names))
        return (name,) if name else ()

    way = str(random.choice(["", "continuous-only", "relative-only"], p=[0.4, 0.4, 0.2]))
    stop = str(random.choice(list(STOPS_S))) if way == "continuous-only" else ""
    signs = [int(sign) for sign in random.choice([-1, 1], 2)]
    # A dome that is steered or goes by steps has to say where it is.
    silent = ("no-status", "zoom-status") if not way else ()
    status = one_of("", "", "stale-status", "always-moving", "boolean-status", *silent)
    coordinates = one_of("", "", "wide-ranges", "degrees")
    how = {
        "": ("", "rounded", "missing-is-zero", "pan-alone-ignored"),
        "continuous-only": ("", "timeout-fault", "timeout-ignored", "stop-fault", "stop-ignored"),
        "relative-only": ("",),
    }
    others = (*one_of(*how[way]), *one_of("", "capped-by-zoom"), *one_of("", "clock-20s", "clock-10h", "media2-only"))
    scale = random.uniform(0.8, 1.25, 2) if "degrees" not in coordinates else np.ones(2)
    names = ("pan-reversed", "tilt-reversed")
    return Facts(
        profiles=(
            *filter(None, (way, stop)),
            *(name for name, sign in zip(names, signs, strict=True) if sign < 0),
            *status,
            *coordinates,
            *others,
        ),
        signs=(signs[0], signs[1]),
        scale=(float(scale[0]), float(scale[1])),
        wide=float(random.uniform(0.9, 1.1)),
        picture=(*one_of("", "upside-down"), *one_of("", "", "mirrored")),
        latency_s=float(random.uniform(0.05, 0.4)),
        delay_s=float(random.uniform(0.03, 0.15)),
        stop_s=STOPS_S[stop],
    )


def run(folder: Path, seed: int) -> list[Row]:
    """Characterize a drawn dome; give a row."""
    facts, begun = drawn(seed), time.monotonic()
    said = ""
    with (
        mock.patch.dict(os.environ, {"COTARGET_PASSWORD": PASSWORD}),
        talking(_emulate, seed, facts) as ((text, config, start), pipe),
    ):
        folder.mkdir(parents=True, exist_ok=True)
        file, keys, status, said = folder / "rig.toml", dict[str, Any](), 0, AGAIN
        for _ in range(MOST_TIMES):
            if status or AGAIN not in said:
                break
            keys.pop("slack_deg", None)  # as the command asks for
            _write(file, text, keys)
            status, out, said = _call("characterize", "--rig", f"{file}", "--yes")
            keys |= {} if status else tomllib.loads(out)["hardware"]["ptz"]
        took_s = time.monotonic() - begun
        row = {"figure": "characterize", "seed": seed, "profiles": " ".join((*facts.profiles, *facts.picture))}
        row |= {"took_s": took_s, "load": load(), "words": said}
        if status:
            return [row | {"failed": True}]
        table = _write(file, text, keys)
        delay_s = _true_delay(file, config, start, pipe) + SLOW_DEG_S / config.sim.head.accel_deg_s2 / 2
    return [row | {"failed": False} | errors(facts, config, table, said, delay_s)]


def _write(file: Path, text: str, keys: Mapping[str, Any]) -> Mapping[str, Any]:
    """Write rig.toml with further keys of the dome; return the dome's table."""
    tables = tomllib.loads(text)
    tables["hardware"]["ptz"] |= keys
    write_atomically(file, tomli_w.dumps(tables).encode())
    table: Mapping[str, Any] = tables["hardware"]["ptz"]
    return table


def _call(*arguments: str) -> tuple[int, str, str]:
    """Run a command; return its exit status, and what it wrote to stdout and stderr."""
    variables = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-m", "cotarget.cli", *arguments]
    try:
        done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=LONGEST_S, check=False)
    except subprocess.TimeoutExpired as late:
        return 1, "", f"{(late.stderr or b'').decode()}not over after {LONGEST_S:g} s"
    return done.returncode, done.stdout, done.stderr


def errors(facts: Facts, config: RigConfig, keys: Mapping[str, Any], said: str, delay_s: float) -> Row:
    """Compare the keys of rig.toml with the truth."""
    head = config.sim.head
    scales = []
    for name, sign in zip(("pan", "tilt"), facts.signs, strict=True):
        (low, high), (true_low, true_high) = keys[f"{name}_deg"], getattr(head, f"{name}_deg")
        scales.append(keys.get(f"{name}_sign", 1) * sign * (high - low) / (true_high - true_low))
    words = "upside down" in said, "mirrored" in said
    turned = tuple(name in facts.picture for name in ("upside-down", "mirrored"))
    return {
        "signs": all(scale > 0 for scale in scales),
        "orientation": words == turned,
        "pan_off": abs(abs(scales[0]) - 1),
        "tilt_off": abs(abs(scales[1]) - 1),
        "stop_off_s": abs(keys.get("stop_delay_s", 0.0) - facts.stop_s),
        "delay_off_s": abs(keys["latency_s"] + keys["command_delay_s"] - delay_s),
        "whole": len(keys["lens"]) > 2,
        "growth_off": _growth_off(config, keys),
    }


def _growth_off(config: RigConfig, keys: Mapping[str, Any]) -> float:
    """Return the largest relative error of a magnification."""
    world = SimWorld(config, rendered=())
    shortest, longest = world.rig.zoom.focal_range
    numbers, times = np.array(BLOCK.lens_table(longest / shortest)).T
    worst, first = 0.0, world.zoom_lens_for(shortest).focal_px[0]
    for number, found in keys["lens"]:
        nominal_px = shortest * math.exp(np.interp(number, numbers, np.log(times)))
        worst = max(worst, abs(found * first / world.zoom_lens_for(nominal_px).focal_px[0] - 1))
    return worst


def _true_delay(file: Path, config: RigConfig, start: float, pipe: Connection) -> float:
    """Measure the true time from a move's call to its motion, and from light to its picture; return the sum [s]."""
    with open_rig(file) as rig:
        period, frame = 1 / config.sim.zoom.rate_hz, rig.zoom.read()
        late = []
        for _ in range(FRAMES):
            frame = rig.zoom.read(newer_than=frame.t)
            arrived = frame.t + rig.spec.zoom.latency_s - start
            nominal = config.sim.zoom.latency_s + period
            exposed = round((arrived - nominal) / period) * period
            late.append(arrived - exposed)
        pipe.send("begin")
        called, state = [], rig.head.state()
        for i in range(MOVES):
            called.append(rig.clock.now())
            way = math.radians(AT_ONCE_DEG) * (1 - i % 2)
            rig.head.move(state.pan + way, state.tilt + way / 4)
            # A head that is still on its way gets commands without a call. The watchdog wants its frames to be read.
            while _moving(rig) and rig.clock.now() < LONGEST_MOVE_S + called[-1]:
                frame = rig.zoom.read(newer_than=frame.t)
        pipe.send("end")
        moved = pipe.recv()
    transits = [next((t for t in moved if t >= call), math.nan) - call for call in called]
    return float(np.median(late) + np.nanmedian(transits)) + config.sim.head.command_delay_s


def _moving(rig: Rig) -> bool:
    """Return whether the head moves; one that did not arrive in time was halted."""
    try:
        return rig.head.state().moving
    except DeviceError:
        return False


def _emulate(pipe: Connection, seed: int, facts: Facts) -> None:
    """Serve the emulated rig; note when its pan is commanded."""
    os.environ.setdefault(*RENDER_THREADS)
    sys.setswitchinterval(SWITCH_S)
    sim = {
        "seed": seed,
        "scene": "indoor",
        "targets": ["person"],
        "fixed": {"rate_hz": FIXED_HZ},
        "zoom": {"latency_s": facts.latency_s},
        "head": {"command_delay_s": facts.delay_s},
    }
    config = paced(parse_config({"sim": sim}))
    with Emulation(config, dome="onvif", user=USER, password=PASSWORD) as emulation:
        for name in facts.profiles:
            emulation.switch(f"ptz.{name}")
        for name in facts.picture:
            emulation.switch(f"picture.{name}")
        tables = tomllib.loads(emulation.rig_toml())
        table, head = tables["hardware"]["ptz"], emulation.config.sim.head
        for name, scale in zip(("pan", "tilt"), facts.scale, strict=True):
            table[f"{name}_deg"] = [end / scale for end in getattr(head, f"{name}_deg")]
        table["wide_deg"] *= facts.wide
        for name in ("latency_s", "command_delay_s"):
            del table[name]
        (least, most) = table["lens"][0][1], table["lens"][-1][1]
        table["lens"] = [[0, least], [1, most]]
        pipe.send((tomli_w.dumps(tables), emulation.config, emulation.world.clock.monotonic(0.0)))
        if pipe.recv() != "begin":
            return
        noted, command = list[float](), emulation.world.pan.command

        def note(*arguments: Any) -> None:
            noted.append(time.monotonic())
            command(*arguments)

        with mock.patch.object(emulation.world.pan, "command", note):
            pipe.recv()
        pipe.send(noted)
        pipe.recv()
