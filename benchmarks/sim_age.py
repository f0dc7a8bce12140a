"""Time and memory of a simulated step as the world ages, with nothing rendered.

A bird flies its rounds outdoors, before foliage that sways, and the head has backlash. Two loops run at 25 Hz:

- `rig`: a frame of each camera, states and commands of head and lens, and the true outline in both views,
- `follow`: the whole pipeline with detections from the ground truth, and the true outlines.

Given are, for each printed minute, the median of a step's processor time and the process's resident memory at the
minute's end, and the last minute's over the first's.

    python -m benchmarks.sim_age [--minutes 60] [--loop rig]
"""

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from cotarget.config import RigConfig, SimConfig, SimHead
from cotarget.evaluation import TruthDetector, true_calibration
from cotarget.pipeline import FollowSettings, follow
from cotarget.safety.safe_rig import guard
from cotarget.sim.world import SimWorld
from experiments.tables import columns

TARGET = "bird"
BACKLASH_DEG = 0.05
PRINTED = (1, 2, 4, 10, 20, 40, 60, 120)
WANTED = 1.05  # largest ratio of the last minute to the first


def config() -> RigConfig:
    """Configure the bird's world."""
    effects = replace(SimConfig().effects, clutter=True, backlash=True)
    head = SimHead(backlash_deg=BACKLASH_DEG)
    return RigConfig(sim=SimConfig(scene="outdoor", targets=(TARGET,), effects=effects, head=head))


def rig_steps(world: SimWorld, seconds: float) -> Iterator[None]:
    """Use the rig as a loop does, without the loop's own work."""
    truth, t = world.truth(), 0.0
    with world.rig as rig:
        shortest, longest = rig.zoom.focal_range
        while t < seconds:
            t = rig.fixed.read(newer_than=t).t
            zoomed = rig.zoom.read().t
            truth.silhouette(TARGET, "fixed", t)
            truth.silhouette(TARGET, "zoom", zoomed)
            rig.head.state()
            rig.zoom.state()
            phase = 2 * math.pi * t / 3.0
            rig.head.move(0.3 * math.sin(phase), 0.1 * math.cos(phase))
            rig.zoom.zoom(shortest + (0.5 + 0.4 * math.sin(phase)) * (longest - shortest))
            yield


def follow_steps(world: SimWorld, seconds: float) -> Iterator[None]:
    """Follow the bird, with detections from the ground truth."""
    truth, target, settings = world.truth(), world.config.target(TARGET), FollowSettings(closed_loop=False)
    with guard(world.rig, world.config.safety) as rig:
        calibration, detector = true_calibration(world), TruthDetector(truth, world.config.sim.seed)
        for step in follow(rig, calibration, target, detector, seconds=seconds, settings=settings):
            truth.silhouette(TARGET, "fixed", step.fixed.t)
            truth.silhouette(TARGET, "zoom", step.zoom.t)
            yield


LOOPS = {"rig": rig_steps, "follow": follow_steps}


def resident_mb() -> float:
    """Read the resident memory of this process [MB]."""
    line = next(each for each in Path("/proc/self/status").read_text().splitlines() if each.startswith("VmRSS"))
    return float(line.split()[1]) / 1024


def aged(loop: str, minutes: int) -> list[tuple[float, float]]:
    """Run a loop; give the median of a step's processor time [ms] and the memory [MB] for each minute."""
    world = SimWorld(config(), rendered=())
    a_minute = round(60 * world.config.sim.fixed.rate_hz)
    found: list[tuple[float, float]] = []
    took: list[float] = []
    steps = LOOPS[loop](world, 60.0 * minutes + 1.0)
    while len(found) < minutes:
        began = time.process_time()
        next(steps)
        took.append(time.process_time() - began)
        if len(took) == a_minute:
            found.append((1e3 * float(np.median(took)), resident_mb()))
            took.clear()
    world.close()
    return found


def main() -> None:
    """Print a table for each loop."""
    parser = argparse.ArgumentParser(description="Time and memory of a simulated step as the world ages.")
    parser.add_argument("--minutes", type=int, default=60, help="simulated minutes (default: 60)")
    parser.add_argument("--loop", choices=LOOPS, help="one of the loops (default: both, one after the other)")
    options = parser.parse_args()
    for loop in (options.loop,) if options.loop else LOOPS:
        found = aged(loop, options.minutes)
        shown = sorted({minute for minute in (*PRINTED, options.minutes) if minute <= options.minutes})
        print(f"{loop}\n" + columns(("minute", "ms a step", "resident MB"), [[m, *found[m - 1]] for m in shown]))
        ms, mb = (found[-1][i] / found[0][i] for i in range(2))
        print(f"last minute over first: time {ms:.3f}, memory {mb:.3f}; at most {WANTED:g} is wanted\n")


if __name__ == "__main__":
    main()
