"""Value of prediction: the close-up's offset with and without it, over the delay of cameras and head.

A person walks and a bird flies in the field of `experiments.following.field`. The delay from light to the start
of motion goes from 0 to 600 ms; three fifths are the cameras' and the rest that of head and lens, as in the field's 120
+ 80 ms. Without prediction the head is sent to where the target was detected. The curve uses the fixed view alone,
rendered once per seed. At the field's delay both can also be compared with correction from the zoom view (`--set
delay.closed_loop=true`). A run in which the target was never acquired counts half the diagonal.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cotarget.config import RigConfig, SimZoomCamera
from cotarget.metrics import score
from cotarget.pipeline import FollowSettings
from cotarget.schema import NotNegative
from experiments.engine import Count, Row
from experiments.following.field import COMMAND_DELAY_S, LATENCY_S, FieldSettings, calibrated, held, hold_config
from experiments.following.wide_view import record
from experiments.tables import grouped, spread

FIELD_S = LATENCY_S + COMMAND_DELAY_S
LIGHT_PART = LATENCY_S / FIELD_S  # part of a delay from light to frame
WIDTH, HEIGHT = SimZoomCamera().size
NEVER = math.hypot(WIDTH, HEIGHT) / 2 / WIDTH  # offset over the width of a target that is never acquired
WANTED = 3.0  # goal: offset without prediction over that with it, at the field's delay


@dataclass(frozen=True)
class DelaySettings(FieldSettings):
    """Settings: targets and delays."""

    seeds: Count = 2
    targets: tuple[str, ...] = ("person", "bird")  # person or bird
    # Delays from light to the start of motion [s]; the goal applies to the field's, if it is among them.
    delays: tuple[NotNegative, ...] = (0.0, 0.1, FIELD_S, 0.4, 0.6)
    # Whether both ways are also compared with the zoom view's correction, at the field's delay.
    closed_loop: bool = False


def one(settings: DelaySettings, seed: int) -> list[Row]:
    """Follow each target at each delay, with and without prediction; give a row per run."""
    cases = [(delay, predict, False) for delay in settings.delays for predict in (True, False)]
    if settings.closed_loop:
        cases += [(FIELD_S, predict, True) for predict in (True, False)]
    rows: list[Row] = []
    for name in settings.targets:
        config = hold_config(name, seed)
        view = record(config, config.target(name), settings.seconds)
        for delay, predict, closed_loop in cases:
            late = delayed(config, delay)
            how = FollowSettings(predict=predict, closed_loop=closed_loop)
            found = score(held(calibrated(settings), late, name, settings.seconds, how, view))
            rows.append(
                {
                    "seed": seed,
                    "target": name,
                    "delay_s": delay,
                    "predict": predict,
                    "closed_loop": closed_loop,
                    "tpo_width": NEVER if found.tpo_width_median is None else found.tpo_width_median,
                    "tpo_deg": found.tpo_deg_median,
                    "closeup_yield": found.closeup_yield,
                    "centred_yield": found.centred_yield,
                    "in_frame_ratio": found.in_frame_ratio or 0.0,
                }
            )
    return rows


def delayed(config: RigConfig, delay: float) -> RigConfig:
    """The same rig with another delay from light to the start of motion [s]."""
    sim, latency_s = config.sim, LIGHT_PART * delay
    head = dataclasses.replace(sim.head, command_delay_s=(1 - LIGHT_PART) * delay)
    fixed = dataclasses.replace(sim.fixed, latency_s=latency_s)
    zoom = dataclasses.replace(sim.zoom, latency_s=latency_s)
    return dataclasses.replace(config, sim=dataclasses.replace(sim, fixed=fixed, zoom=zoom, head=head))


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Of each target the curve, over the seeds, and how many times prediction makes the median offset smaller."""
    return {name: _of_target(mine) for name, mine in grouped(rows, "target").items()}


def _of_target(rows: Sequence[Row]) -> dict[str, Any]:
    cells = grouped(rows, "delay_s", "closed_loop", "predict")

    def both(delay: float, closed_loop: bool) -> dict[str, Any]:
        ways = {"with": True, "without": False}
        found: dict[str, Any] = {
            name: spread(row["tpo_width"] for row in cells.get((delay, closed_loop, way), ()))
            for name, way in ways.items()
        }
        return found | {"times": found["without"]["median"] / found["with"]["median"]}

    curve = {f"{1e3 * delay:.0f} ms": both(delay, False) for delay in sorted({row["delay_s"] for row in rows})}
    return {"wide view alone": curve, "closed loop": both(FIELD_S, True)}


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the targets for which prediction misses its goal, and the whole pipeline where that was measured.

    Without the field's delay among the settings there is no goal.
    """
    lost = []
    for name, figures in summary.items():
        times = figures["closed loop"]["times"]
        if math.isnan(times):
            times = figures["wide view alone"].get(f"{1e3 * FIELD_S:.0f} ms", {"times": WANTED})["times"]
        if not times >= WANTED:
            lost.append(name)
    return lost


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """Offset over the delay: medians joined, bars from the least seed to the largest."""
    curves = grouped([row for row in rows if not row["closed_loop"]], "target")
    for ax, (name, mine) in zip(np.ravel(figure.subplots(1, len(curves), sharey=True)), curves.items(), strict=True):
        for predict, label in ((True, "with prediction"), (False, "without")):
            found = {
                1e3 * delay: spread(row["tpo_width"] for row in each if row["predict"] is predict)
                for delay, each in sorted(grouped(mine, "delay_s").items())
            }
            low, middle, high = (np.array([f[key] for f in found.values()]) for key in ("least", "median", "largest"))
            ax.errorbar(list(found), middle, yerr=(middle - low, high - middle), capsize=3, label=label)
        ax.set_yscale("log")
        ax.set(title=name, xlabel="delay from light to motion [ms]", ylabel="median offset / width")
    ax.legend(frameon=False)


SETTINGS = DelaySettings()
QUICK = dataclasses.replace(SETTINGS, seeds=1, targets=("bird",), delays=(FIELD_S,), seconds=6.0, calibrated=False)
COST_S = 250.0
