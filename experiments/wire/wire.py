"""Hardware backend over the wire, with emulated devices.

- polls: pairs of D46 positions a second at 9600 baud over a paced pseudo-terminal, against the line's capacity.
- age: age of the newest Axis frame at a consumer of 5 Hz, from the first byte sent.
- command: time from a frame's arrival to the first byte of the command on the wire, in its parts.
- faults: time from each fault of the emulated devices to a standing head, or to recovery.
- latency: latencies of cameras and commands as measured at bring-up, against the emulator's truth.
- parity: final pose of the head, the simulation opened directly and over the wire.

All run in real time beside the emulator, which needs its own core. On a busy machine the figures include its load.

    python -m experiments.wire.wire [--only NAME ...] [--seed-base 0] [--quick] [--out DIR]
"""

import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cotarget.cli.common import not_negative, positive_int
from cotarget.cli.main import Parser
from cotarget.errors import ConfigError, choices
from experiments.engine.bounds import compare
from experiments.engine.harness import TERMINATED, Experiment, Row, Settings
from experiments.engine.texts import table
from experiments.wire import age, command, latency, parity, polls
from experiments.wire import faults as faults_module
from experiments.wire.figures import AGAIN, FAULT_COLUMNS, PART_COLUMNS, bounded, missed, summarise

NEVER = (0.0, 0.0)  # bound of what must never happen, on any machine: hanging, or moving beyond the limits


@dataclass(frozen=True)
class WireSettings(Settings):
    """Settings: figures and durations of their measurement.

    Attributes:
        only: figures to measure.
        poll_s: polling of one unit [s].
        age_s: reading of the stream [s].
        targets: targets that are followed to time commands.
        command_s: following of each target [s].
        faults: faults of the devices; all if empty.
        repetitions: repetitions of each fault.
        wiggle_s: turning of the head [s].
        swing_s: swinging of the board [s].
        places: places of the static book.
        still_s: following at each place [s].
        tries: largest number of measurements of a figure that a busy machine has disturbed.
    """

    only: tuple[str, ...] = ("polls", "age", "command", "faults", "latency", "parity")
    poll_s: float = 10.0
    age_s: float = 30.0
    targets: tuple[str, ...] = ("book", "person")
    command_s: float = 20.0
    faults: tuple[str, ...] = ()
    repetitions: int = 1
    wiggle_s: float = 8.0
    swing_s: float = 10.0
    places: int = 2
    still_s: float = 6.0
    tries: int = 1

    def __post_init__(self) -> None:
        """Refuse unknown faults."""
        super().__post_init__()
        if unknown := sorted(set(self.faults) - set(faults_module.all_faults())):
            raise ConfigError(f"faults: {unknown[0]!r} is not one of: {choices(faults_module.all_faults())}")


def jobs(settings: WireSettings) -> Sequence[int]:
    """Give a job for each figure, by its index in ``only``."""
    return range(len(settings.only))


def one(_: None, settings: WireSettings, number: int) -> list[Row]:
    """Measure one of the figures; give the rows of the last measurement, with its number if it was repeated."""
    for time in range(1, settings.tries + 1):
        with TemporaryDirectory(prefix="cotarget-wire-") as name:
            rows = RUNS[settings.only[number]](settings, Path(name))
        if time == settings.tries or not _spoilt(rows):
            break
    return rows if time == 1 else [row | {AGAIN: time} for row in rows]


def _spoilt(rows: Sequence[Row]) -> bool:
    """Check whether only bounds on times are exceeded, as on a busy machine, and none on what must never happen."""
    summary = summarise(rows)
    measured = bounded(summary)
    broken = [each for each in compare(EXPERIMENT, summary) if each.name in measured and not each.kept]
    return bool(broken) and all(each.bound != NEVER for each in broken)


RUNS: Mapping[str, Callable[[WireSettings, Path], list[Row]]] = {
    "polls": lambda s, folder: polls.run(folder, s.poll_s),
    "age": lambda s, _: age.run(s.age_s, s.seed_base),
    "command": lambda s, folder: command.run(folder, s.targets, s.command_s),
    "faults": lambda s, folder: faults_module.run(
        folder, s.faults or faults_module.all_faults(), s.repetitions, s.seed_base
    ),
    "latency": lambda s, folder: latency.run(folder, s.wiggle_s, s.swing_s),
    "parity": lambda s, folder: parity.run(folder, s.places, s.still_s, s.seed_base),
}


def describe(settings: WireSettings, summary: Mapping[str, Any]) -> str:
    """Format the figures as tables."""
    found = summary["figures"]
    texts = [
        table(
            ("figure", "measured", "wanted", "unit", "reached"),
            ([n, f["measured"], f["wanted"], f["unit"], "yes" if f["reached"] else "NO"] for n, f in found.items()),
        )
    ]
    for title, columns in (("parts", PART_COLUMNS), ("faults", FAULT_COLUMNS)):
        if summary[title]:
            lines = ([name, *(values[column] for column in columns)] for name, values in summary[title].items())
            texts.append(table((title, *columns), lines))
    if summary["again"]:
        times = ", ".join(f"{name} {often} times" for name, often in summary["again"].items())
        texts.append(
            f"measured more than once, because a busy machine had spoilt it, of which this is the last: {times}"
        )
    texts.append("load of the machine meanwhile, the mean over a minute: {:.1f} to {:.1f}".format(*summary["load"]))
    return "\n\n".join(texts)


SETTINGS = WireSettings(seeds=1)
EXPERIMENT = Experiment(
    "wire",
    "The hardware backend over the wire, through the emulated devices.",
    SETTINGS,
    replace(
        SETTINGS,
        poll_s=2.0,
        age_s=6.0,
        targets=("book",),
        command_s=6.0,
        faults=("head.silence", "fixed.stall"),
        repetitions=1,
        wiggle_s=5.0,
        swing_s=6.0,
        places=1,
        still_s=4.0,
        tries=3,
    ),
    one,
    summarise,
    describe,
    missed=missed,
    jobs=jobs,
    alone=True,
    cost_s=300.0,
    bounded=bounded,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = Parser(prog="python -m experiments.wire.wire", description=EXPERIMENT.purpose)
    parser.add_argument("--only", nargs="+", choices=tuple(RUNS), default=SETTINGS.only, metavar="NAME", help="figures")
    parser.add_argument("--fault", nargs="+", choices=faults_module.all_faults(), metavar="DEVICE.FAULT", help="these")
    parser.add_argument("--repetitions", type=positive_int, metavar="N", help=f"of each fault ({SETTINGS.repetitions})")
    parser.add_argument("--seed-base", type=not_negative, default=0, metavar="B", help="the seed (0)")
    parser.add_argument("--quick", action="store_true", help="each for some seconds only")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write result.json and rows.csv there")
    given = parser.parse_args(arguments)
    settings = replace(EXPERIMENT.quick if given.quick else SETTINGS, only=tuple(given.only), seed_base=given.seed_base)
    if given.fault is not None:
        settings = replace(settings, faults=tuple(given.fault))
    if given.repetitions is not None:
        settings = replace(settings, repetitions=given.repetitions)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))  # ends the emulated devices too
    return EXPERIMENT.report(settings, given.out, quick=given.quick)


if __name__ == "__main__":
    sys.exit(main())
