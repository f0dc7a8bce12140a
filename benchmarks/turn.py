"""Processor time of a turn of `follow`, from a frame of the fixed camera to the commands, without the rig's own work.

A default simulated rig with exact calibration follows a person, then a bird. A turn is one Step; the time in cameras,
head and lens, where the simulation renders, is taken off. Turns without a target do not count, and none of the first 60
frames, while the background is learnt. BLAS and OpenCV use one thread.

`--against` runs another checkout of the project in turns with this one, because a machine's speed drifts, and prints
the ratio of the medians over the rounds.

    python -m benchmarks.turn [--seconds 10] [--rounds 3] [--against CHECKOUT]
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

TARGETS = ("person", "bird")
PERCENTILES = (50, 95, 99)
UNTIMED = 60  # frames, while the background is learnt
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
HERE = Path(__file__).resolve()


class Timed:
    """A device whose calls are timed."""

    def __init__(self, device: Any, spend: Callable[[float], None]) -> None:
        """Wrap a device; `spend` is called with the processor time of each call [s]."""
        self._device, self._spend = device, spend

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._device, name)
        if not callable(value):
            return value

        def call(*arguments: Any, **named: Any) -> Any:
            began = time.process_time()
            try:
                return value(*arguments, **named)
            finally:
                self._spend(time.process_time() - began)

        return call


def turns_ms(name: str, seconds: float) -> list[float]:
    """Follow a target; return the processor time of each turn [ms]."""
    from cotarget.config import RigConfig
    from cotarget.detection import make_detector
    from cotarget.evaluation import true_calibration
    from cotarget.pipeline import FollowSettings, follow
    from cotarget.sim.world import SimWorld

    config = RigConfig()
    config = replace(config, sim=replace(config.sim, targets=(name,)))
    calibration, target = true_calibration(SimWorld(config, rendered=())), config.target(name)
    in_rig: list[float] = []
    rig = SimWorld(config).rig
    devices: dict[str, Any] = {
        each: Timed(getattr(rig, each), in_rig.append) for each in ("fixed", "zoom", "head", "clock")
    }
    detector, settings = make_detector(target, config.sim.fixed.rate_hz), FollowSettings()
    steps = follow(replace(rig, **devices), calibration, target, detector, seconds=seconds, settings=settings)
    took: list[float] = []
    began = time.process_time()
    for step in steps:
        turn = time.process_time() - began - sum(in_rig)
        if step.index > UNTIMED and step.target is not None:
            took.append(1e3 * turn)
        in_rig.clear()
        began = time.process_time()
    return took


def measure(checkout: Path, name: str, seconds: float) -> list[float]:
    """Measure a checkout in a process of its own; return its percentiles [ms]."""
    done = subprocess.run(
        [sys.executable, str(HERE), "--child", name, "--seconds", str(seconds)],
        cwd=checkout,
        env={**os.environ, **ONE_THREAD, "PYTHONPATH": str(checkout)},
        stdout=subprocess.PIPE,
        check=True,
    )
    return [float(each) for each in np.percentile(json.loads(done.stdout), PERCENTILES)]


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.turn", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a run (10)")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each target and checkout (3)")
    parser.add_argument("--against", type=Path, help="another checkout of the project")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        print(json.dumps(turns_ms(given.child, given.seconds)))
        return 0
    checkouts = [HERE.parents[1]] + ([given.against.resolve()] if given.against else [])
    found: dict[tuple[str, Path], list[list[float]]] = {}
    for _ in range(given.rounds):
        for name in TARGETS:
            for checkout in checkouts:
                found.setdefault((name, checkout), []).append(measure(checkout, name, given.seconds))
    for name in TARGETS:
        medians = [np.median(found[name, checkout], axis=0) for checkout in checkouts]
        cells = [f"p{p} {value:.1f} ms" for p, value in zip(PERCENTILES, medians[0], strict=True)]
        if given.against:
            ratios = medians[0] / medians[1]
            cells += [f"over {given.against}:", *(f"{ratio:.2f}" for ratio in ratios)]
        print(f"{name:8}", "  ".join(cells))
    return 0


if __name__ == "__main__":
    sys.exit(main())
