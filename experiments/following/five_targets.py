"""Target selection: how many of five targets get a good close-up under each policy.

Five persons or five birds cross the fixed view in the field of `experiments.following.field`, for a while all at
once. A target is served when it was well in the close-up, as defined by the metrics, for a second in total. The fixed
view is rendered and searched once for each seed and kind, and followed under each policy, by default without correction
from the zoom view (`--set five_targets.closed_loop=true`).
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cotarget.calibration import Calibration
from cotarget.config import RigConfig, TargetProfile
from cotarget.control.selection import POLICIES, TargetSelector
from cotarget.evaluation import closeup_of
from cotarget.metrics import SERVED_S
from cotarget.pipeline import FollowSettings
from cotarget.sim.targets.random_paths import GROUP
from cotarget.sim.truth import Truth
from experiments.engine import Count, Row
from experiments.following.field import FieldSettings, calibrated, five_targets_config, watched
from experiments.following.wide_view import WideView, record
from experiments.tables import grouped, mean_of

FIRST = "first-come"
WANTED = 1.5  # goal: targets served by the best policy over those by first-come


@dataclass(frozen=True)
class FiveSettings(FieldSettings):
    """Settings: kinds of targets."""

    seeds: Count = 2
    kinds: tuple[str, ...] = ("person", "bird")  # person or bird
    closed_loop: bool = False  # whether the zoom view corrects the aim


def one(settings: FiveSettings, seed: int) -> list[Row]:
    """Follow five of each kind under each policy; give a row per policy."""
    rows: list[Row] = []
    for kind in settings.kinds:
        config = five_targets_config(seed, kind)
        target = config.target(kind)
        view = record(config, target, settings.seconds)
        for policy, make in POLICIES.items():
            how = FollowSettings(closed_loop=settings.closed_loop)
            seconds, centred_s = good_seconds(calibrated(settings), config, target, settings.seconds, how, view, make())
            rows.append(
                {
                    "seed": seed,
                    "kind": kind,
                    "policy": policy,
                    "served": sum(value >= SERVED_S for value in seconds.values()),
                    "good_s": sum(seconds.values()),
                    "centred_s": centred_s,
                    **{f"good_{i}_s": value for i, value in enumerate(seconds.values(), 1)},
                }
            )
    return rows


def good_seconds(
    calibration: Calibration,
    config: RigConfig,
    target: TargetProfile,
    seconds: float,
    how: FollowSettings,
    view: WideView,
    selector: TargetSelector,
) -> tuple[dict[str, float], float]:
    """Measure for how long each target was well in the close-up, and any was centred in it, by ground truth [s]."""
    good, centred = dict.fromkeys(config.sim.targets, 0.0), 0.0
    last: float | None = None
    for step, truth in watched(calibration, config, target, seconds, how, view, selector):
        t = step.zoom.t
        if last is not None and t > last:  # a frame counts for the time since the one before
            for name in good:
                if _near(truth, name, t) and (closeup := closeup_of(truth, name, target, t)).good:
                    good[name] += t - last
                    centred += (t - last) * closeup.centred
        last = t
    return good, centred


def _near(truth: Truth, name: str, t: float) -> bool:
    """Check whether a target's centre is in the zoom image; faster than the full row."""
    width, height = truth.lens("zoom", t).size
    u, v = truth.pixel("zoom", truth.center(name, t), t)
    return bool(-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5)


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Give targets served by policy (mean, least and most over the seeds), and the best mean over first-come's."""
    found: dict[str, dict[str, Any]] = {}
    for kind, mine in grouped(rows, "kind").items():
        served = {policy: _of(each) for policy, each in grouped(mine, "policy").items()}
        best, first = max(each["mean"] for each in served.values()), served[FIRST]["mean"]
        found[kind] = served | {"best over first": best / first if first else math.inf * best}
    return found


def _of(rows: Sequence[Row]) -> dict[str, float]:
    served = [row["served"] for row in rows]
    seconds = {key: mean_of(row[key] for row in rows if key in row)[0] for key in ("good_s", "centred_s")}
    return {"mean": float(np.mean(served)), "least": float(min(served)), "most": float(max(served)), **seconds}


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the kinds for which no policy meets the goal."""
    return [kind for kind, found in summary.items() if not found["best over first"] >= WANTED]


def plot(rows: Sequence[Row], figure: Figure) -> None:
    """How many were served under each policy: the mean, with bars from the least seed to the most, and each seed."""
    kinds = grouped(rows, "kind")
    for ax, (kind, mine) in zip(np.ravel(figure.subplots(1, len(kinds), sharey=True)), kinds.items(), strict=True):
        for i, each in enumerate(grouped(mine, "policy").values()):
            served = [row["served"] for row in each]
            mean = float(np.mean(served))
            ax.bar(i, mean, 0.6, yerr=[[mean - min(served)], [max(served) - mean]], capsize=4, alpha=0.6)
            ax.plot(i + np.linspace(-0.12, 0.12, len(served)), served, "k.")
        ax.set(title=f"five {kind}s", ylabel="targets served", ylim=(0, GROUP + 0.2))
        ax.set_xticks(range(len(POLICIES)), POLICIES)


SETTINGS = FiveSettings()
QUICK = dataclasses.replace(SETTINGS, seeds=1, kinds=("person",), seconds=10.0, calibrated=False)
COST_S = 250.0
