"""Hardware backend over the wire, with emulated devices.

- polls: pairs of D46 positions a second at 9600 baud over a paced pseudo-terminal, against the line's capacity.
- age: age of the newest Axis frame at a consumer of 5 Hz, from the first byte sent.
- stream_age: the same of H.264 of 1920x1080 by RTSP, encoded beforehand.
- command: time from a frame's arrival to the first byte of the command on the wire, in its parts.
- faults: time from each fault of the emulated devices to a standing head, or to recovery.
- latency: latencies of cameras and commands as measured at bring-up, against the emulator's truth.
- parity: final pose of the head, the simulation opened directly and over the wire.
- follow: close-up yield of a person who is followed through a dome that deviates from its standard in a known way, over
  that of the simulation with the same rates.
- characterize: what `cotarget characterize` finds of domes drawn by seed, against the truth.

All run in real time beside the emulator, which needs its own core. On a busy machine the figures include its load.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from cotarget.errors import ConfigError, choices
from cotarget.geometry import Array
from cotarget.schema import Positive
from experiments.engine import Count, Row, Settings
from experiments.report import compare
from experiments.tables import grouped
from experiments.wire import age, characterize, command, follow, latency, parity, polls
from experiments.wire import faults as faults_module

NEVER = (0.0, 0.0)  # bound of what must never happen, on any machine: hanging, or moving beyond the limits
MS = 1e3
SHARE = 0.9  # least fraction of the line's rate
STREAM_AGE_MS = 105.0  # limit of p95: two frame periods, since a parser gives a frame when the next begins, and 25 ms
AGE_MS, DRIFT_MS = 60.0, 10.0  # limits; a median over a third of the frames varies by about 3 ms
BEYOND_MS = 25.0  # limit of p95 of a command, detection excluded
SETTLED_S = 0.5  # limit of the time from a fault to a standing head, or to recovery
LATENCY_MS = 10.0
PARITY_STEPS = 1.0
ROUNDING = 1e-6  # rounding of steps that were converted to angles
PARTS = ("in_hand", "detection", "aiming", "line", "total", "beyond")
PART_COLUMNS = ("median [ms]", "p95 [ms]", "max [ms]")
FAULT_COLUMNS = (
    "outcome", "settled [s]", "halted [s]", "recovered [s]", "moved [deg]", "beyond [deg]", "ended [s]", "hangs",
    "tracebacks", "runs",
)  # fmt: skip
SCALE_OFF, STOP_OFF_S, DELAY_OFF_S, GROWTH_OFF = 0.01, 0.03, 0.02, 0.02  # limits, of what is found of a dome
CHARACTERIZED = ("signs", "orientation", "pan_off", "tilt_off", "stop_off_s", "delay_off_s", "growth_off", "took_s")
AGAIN = "measured"  # number of repetitions, in rows of what was measured more than once
Figure = dict[str, Any]


@dataclass(frozen=True)
class WireSettings(Settings):
    """Settings: figures and durations of their measurement."""

    # Figures to measure.
    only: tuple[str, ...] = (
        "polls", "age", "stream_age", "command", "faults", "latency", "parity", "follow", "characterize",
    )  # fmt: skip
    poll_s: Positive = 10.0  # polling of one unit [s]
    age_s: Positive = 30.0  # reading of the stream [s]
    targets: tuple[str, ...] = ("book", "person")  # targets that are followed to time commands
    command_s: Positive = 20.0  # following of each target [s]
    faults: tuple[str, ...] = ()  # faults of the devices; all if empty
    repetitions: Count = 1  # repetitions of each fault
    wiggle_s: Positive = 8.0  # turning of the head [s]
    swing_s: Positive = 10.0  # swinging of the board [s]
    places: Count = 2  # places of the static book
    still_s: Positive = 6.0  # following at each place [s]
    domes: tuple[str, ...] = ()  # domes with which the person is followed; all if empty
    follow_s: Positive = 30.0  # following of the person [s]
    drawn: Count = 4  # domes drawn by seed that are characterized
    tries: Count = 1  # largest number of measurements of a figure that a busy machine has disturbed

    def __post_init__(self) -> None:
        """Refuse unknown faults and domes."""
        for name, known in (("faults", faults_module.all_faults()), ("domes", tuple(follow.DOMES))):
            if unknown := sorted(set(getattr(self, name)) - set(known)):
                raise ConfigError(f"{name}: {unknown[0]!r} is not one of: {choices(known)}")


def jobs(settings: WireSettings) -> Sequence[int]:
    """Give a job for each figure, and for each dome that is followed with or characterized."""
    return range(len(_measurements(settings)))


def _measurements(settings: WireSettings) -> list[tuple[str, Any]]:
    """List each figure with its case: a dome that is followed with, or the seed of one that is characterized."""
    cases: dict[str, Sequence[Any]] = {
        "follow": settings.domes or tuple(follow.DOMES),
        "characterize": range(settings.seed_base, settings.seed_base + settings.drawn),
    }
    return [(figure, case) for figure in settings.only for case in cases.get(figure, (None,))]


def one(settings: WireSettings, number: int) -> list[Row]:
    """Measure one of the figures; give the rows of the last measurement, with its number if it was repeated."""
    figure, case = _measurements(settings)[number]
    for time in range(1, settings.tries + 1):
        with TemporaryDirectory(prefix="cotarget-wire-") as folder:
            rows = RUNS[figure](settings, Path(folder), case)
        if time == settings.tries or not _spoilt(rows):
            break
    return rows if time == 1 else [row | {AGAIN: time} for row in rows]


def _spoilt(rows: Sequence[Row]) -> bool:
    """Check whether only bounds on times are exceeded, as on a busy machine, and none on what must never happen."""
    measured = bounded(summarise(rows))
    broken = [each for each in compare("wire", measured) if each.name in measured and not each.kept]
    return bool(broken) and all(each.bound != NEVER for each in broken)


RUNS: Mapping[str, Callable[[WireSettings, Path, Any], list[Row]]] = {
    "polls": lambda s, folder, _: polls.run(folder, s.poll_s),
    "age": lambda s, *_: age.run(s.age_s, s.seed_base),
    "stream_age": lambda s, *_: age.run_h264(s.age_s, s.seed_base),
    "command": lambda s, folder, _: command.run(folder, s.targets, s.command_s),
    "faults": lambda s, folder, _: faults_module.run(
        folder, s.faults or faults_module.all_faults(), s.repetitions, s.seed_base
    ),
    "latency": lambda s, folder, _: latency.run(folder, s.wiggle_s, s.swing_s),
    "parity": lambda s, folder, _: parity.run(folder, s.places, s.still_s, s.seed_base),
    "follow": lambda s, folder, dome: follow.run(folder, dome, s.follow_s, s.seed_base),
    "characterize": lambda s, folder, seed: characterize.run(folder, seed),
}


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Compute each figure, the parts of commands and ages, and the result of each fault."""
    of = grouped(rows, "figure")
    figures: dict[str, Figure] = {}
    for row in of.get("polls", []):
        figures[f"polls, {row['case']}"] = at_least(row["share"], SHARE, f"of {row['pairs_s'] / row['share']:.1f}/s")
    if ages := of.get("age"):
        figures["age of the newest frame, longest"] = at_most(float(_ages_ms(ages).max()), AGE_MS, "ms")
        figures["age, last third less first"] = at_most(_drift_ms(ages), DRIFT_MS, "ms")
    if ages := of.get("stream_age"):
        p95 = float(np.percentile(_ages_ms(ages), 95))
        figures["age of the newest H.264 frame, p95"] = at_most(p95, STREAM_AGE_MS, "ms")
        figures["age of H.264, last third less first"] = at_most(_drift_ms(ages), DRIFT_MS, "ms")
    for name, mine in grouped(of.get("command", []), "target").items():
        beyond = float(np.percentile([row["beyond_s"] for row in mine], 95)) * MS
        figures[f"command, {name}: p95 beyond detection"] = at_most(beyond, BEYOND_MS, "ms")
    faults = {" ".join(name): _fault(mine) for name, mine in grouped(of.get("faults", []), "fault", "way").items()}
    figures |= _of_faults(faults)
    for row in of.get("latency", []):
        off = abs(row["measured_s"] - row["truth_s"]) * MS
        name = f"latency, {row['what']}: {row['measured_s'] * MS:.1f} for {row['truth_s'] * MS:.1f}, off"
        figures[name] = at_most(off, LATENCY_MS, "ms")
    if places := of.get("parity"):
        apart = max(max(row["pan_steps"], row["tilt_steps"]) for row in places)
        figures["parity, farthest apart"] = at_most(round(apart / ROUNDING) * ROUNDING, PARITY_STEPS, "steps")
    for row in of.get("follow", []):
        figures |= _of_followed(row, follow.DOMES[row["dome"]])
    figures |= _of_characterized(of.get("characterize", []))
    loads = [row["load"] for row in rows]
    return {
        "figures": figures,
        "parts": _parts(of),
        "faults": faults,
        "characterized": {
            f"{row['seed']}: {row['profiles'] or 'by the standard'}": {name: row.get(name) for name in CHARACTERIZED}
            for row in of.get("characterize", [])
        },
        "again": {name: again for name, mine in of.items() if (again := mine[0].get(AGAIN))},
        "load": [min(loads, default=math.nan), max(loads, default=math.nan)],
    }


def _of_followed(row: Row, dome: follow.Dome) -> dict[str, Figure]:
    """Give the yield over that of the simulation, or whether a dome that cannot be followed with was named."""
    said = f" ({row['error']})" if row["error"] else ""
    if dome.ends:
        return {f"follow, {row['dome']}: not named{said}": at_most(int(dome.ends not in row["error"]), 0, "runs")}
    name = f"follow, {row['dome']}: yield {row['wire']:.3f} for {row['sim']:.3f} in the simulation{said}"
    return {name: at_least(row["wire"] / row["sim"], dome.wanted, "of it")}


def _of_characterized(rows: Sequence[Row]) -> dict[str, Figure]:
    """Give the largest errors of what was found of drawn domes."""
    if not rows:
        return {}
    found = [row for row in rows if not row["failed"]]
    wrong = sum(not (row["signs"] and row["orientation"]) for row in found)
    figures = {
        f"characterize, of {len(rows)} domes without an end": at_most(len(rows) - len(found), 0, "domes"),
        "characterize, signs or orientation wrong": at_most(wrong, 0, "domes"),
    }
    for name, columns, limit, unit in (
        ("degrees a unit", ("pan_off", "tilt_off"), SCALE_OFF, "of it"),
        ("time of a stop", ("stop_off_s",), STOP_OFF_S, "s"),
        ("time from a command to its picture", ("delay_off_s",), DELAY_OFF_S, "s"),
        ("magnification", ("growth_off",), GROWTH_OFF, "of it"),
    ):
        worst = max((row[column] for row in found for column in columns), default=math.nan)
        figures[f"characterize, {name}: largest error"] = at_most(worst, limit, unit)
    return figures


def _ages_ms(rows: Sequence[Row]) -> Array:
    return np.array([row["age_s"] for row in rows]) * MS


def _drift_ms(rows: Sequence[Row]) -> float:
    """Compare the median ages of the last and the first third of the frames [ms]."""
    thirds = [float(np.median(third)) for third in np.array_split(_ages_ms(rows), 3)]
    return abs(thirds[2] - thirds[0])


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the figures that miss their goal."""
    return [name for name, figure in summary["figures"].items() if not figure["reached"]]


def bounded(summary: Mapping[str, Any]) -> dict[str, float]:
    """Give the measured values by names without values."""
    return {
        name.partition(":")[0] if name.startswith(("latency", "follow")) else name: figure["measured"]
        for name, figure in summary["figures"].items()
    }


def at_most(measured: float, wanted: float, unit: str) -> Figure:
    """Make a figure with an upper limit."""
    return {"measured": measured, "wanted": f"<= {wanted:g}", "unit": unit, "reached": bool(measured <= wanted)}


def at_least(measured: float, wanted: float, unit: str) -> Figure:
    """Make a figure with a lower limit."""
    return {"measured": measured, "wanted": f">= {wanted:g}", "unit": unit, "reached": bool(measured >= wanted)}


def _parts(of: dict[str, list[Row]]) -> dict[str, dict[str, float]]:
    """Give median, p95 and longest of the parts of a command and of an age."""
    values = {
        f"{name}: {part}": [row[f"{part}_s"] for row in mine]
        for name, mine in grouped(of.get("command", []), "target").items()
        for part in PARTS
    }
    values |= {
        f"{name}: {part}": [row[f"{part}_s"] for row in of[name]]
        for name in ("age", "stream_age")
        for part in ("age", "read")
        if name in of
    }
    return {
        name: dict(
            zip(PART_COLUMNS, (float(v) * MS for v in (np.median(x), np.percentile(x, 95), max(x))), strict=True)
        )
        for name, x in values.items()
    }


def _fault(rows: Sequence[Row]) -> dict[str, Any]:
    """Give the worst of a fault's repetitions."""

    def worst(name: str) -> float:
        values = [math.nan if row.get(name) is None else float(row[name]) for row in rows]
        return float(np.nanmax(values)) if np.isfinite(values).any() else math.nan

    # A run that never followed cannot have settled.
    started = all(row.get("settled_s") is not None for row in rows)
    said = (
        "/".join(sorted({row["outcome"] for row in rows})),
        worst("settled_s") if started else math.inf,
        worst("halted_s"),
        worst("recovered_s"),
        worst("moved_deg"),
        worst("beyond_deg"),
        worst("ended_s"),
        sum(row.get("hang") or 0 for row in rows),
        sum(row.get("traceback") or 0 for row in rows),
        len(rows),
    )
    return dict(zip(FAULT_COLUMNS, said, strict=True))


def _of_faults(faults: dict[str, dict[str, Any]]) -> dict[str, Figure]:
    if not faults:
        return {}
    late = sum(not fault["settled [s]"] <= SETTLED_S for fault in faults.values())
    worst = {
        "from a fault to a standing head or recovery, longest": ("settled [s]", SETTLED_S, "s"),
        "motion beyond the soft limits after a fault": ("beyond [deg]", 0.0, "degrees"),
    }
    found = {
        name: at_most(max(f[column] for f in faults.values()), most, unit)
        for name, (column, most, unit) in worst.items()
    }
    found[f"faults of {len(faults)} for which that took longer"] = at_most(late, 0, "faults")
    for column in ("hangs", "tracebacks"):
        found[f"{column} after a fault"] = at_most(sum(f[column] for f in faults.values()), 0, "runs")
    return found


SETTINGS = WireSettings(seeds=1)
QUICK = replace(
    SETTINGS,
    only=tuple(name for name in SETTINGS.only if name not in ("stream_age", "characterize")),
    domes=("stale-status", "no-status", "visca", "continuous-only, stops after 0.4 s"),
    follow_s=10.0,
    poll_s=2.0,
    age_s=4.0,
    targets=("book",),
    command_s=6.0,
    faults=("head.silence", "fixed.stall"),
    wiggle_s=5.0,
    swing_s=6.0,
    places=1,
    still_s=4.0,
    tries=3,
)
ALONE = True
COST_S = 300.0
