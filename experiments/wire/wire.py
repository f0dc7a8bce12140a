"""Hardware backend over the wire, with emulated devices.

- polls: pairs of D46 positions a second at 9600 baud over a paced pseudo-terminal, against the line's capacity.
- age: age of the newest Axis frame at a consumer of 5 Hz, from the first byte sent.
- command: time from a frame's arrival to the first byte of the command on the wire, in its parts.
- faults: time from each fault of the emulated devices to a standing head, or to recovery.
- latency: latencies of cameras and commands as measured at bring-up, against the emulator's truth.
- parity: final pose of the head, the simulation opened directly and over the wire.

All run in real time beside the emulator, which needs its own core. On a busy machine the figures include its load.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from cotarget.errors import ConfigError, choices
from cotarget.schema import Positive
from experiments.engine import Count, Row, Settings
from experiments.report import compare
from experiments.wire import age, command, latency, parity, polls
from experiments.wire import faults as faults_module
from experiments.wire.figures import AGAIN, bounded, missed, summarise

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
    poll_s: Positive = 10.0
    age_s: Positive = 30.0
    targets: tuple[str, ...] = ("book", "person")
    command_s: Positive = 20.0
    faults: tuple[str, ...] = ()
    repetitions: Count = 1
    wiggle_s: Positive = 8.0
    swing_s: Positive = 10.0
    places: Count = 2
    still_s: Positive = 6.0
    tries: Count = 1

    def __post_init__(self) -> None:
        """Refuse unknown faults."""
        if unknown := sorted(set(self.faults) - set(faults_module.all_faults())):
            raise ConfigError(f"faults: {unknown[0]!r} is not one of: {choices(faults_module.all_faults())}")


def jobs(settings: WireSettings) -> Sequence[int]:
    """Give a job for each figure, by its index in ``only``."""
    return range(len(settings.only))


def one(settings: WireSettings, number: int) -> list[Row]:
    """Measure one of the figures; give the rows of the last measurement, with its number if it was repeated."""
    for time in range(1, settings.tries + 1):
        with TemporaryDirectory(prefix="cotarget-wire-") as name:
            rows = RUNS[settings.only[number]](settings, Path(name))
        if time == settings.tries or not _spoilt(rows):
            break
    return rows if time == 1 else [row | {AGAIN: time} for row in rows]


def _spoilt(rows: Sequence[Row]) -> bool:
    """Check whether only bounds on times are exceeded, as on a busy machine, and none on what must never happen."""
    measured = bounded(summarise(rows))
    broken = [each for each in compare("wire", measured) if each.name in measured and not each.kept]
    return bool(broken) and all(each.bound != NEVER for each in broken)


__all__ = ["bounded", "missed", "summarise"]  # parts of the experiment

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


SETTINGS = WireSettings(seeds=1)
QUICK = replace(
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
)
ALONE = True
COST_S = 300.0
