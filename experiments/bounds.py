"""What the experiments' quick runs have reached: bounds in expected/NAME.json, which only tighten.

A file holds some of the figures of a summary, under the same names, each with the least that was reached; less is
better. Where a figure is to get a bound, null stands for it until it is first reached.
"""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cotarget.calibration.atomic import write_atomically
from cotarget.errors import ConfigError
from experiments.harness import Experiment

EXPECTED = Path(__file__).parent / "expected"
WORSE = 1.10  # times the bound is still as good: other versions of the libraries differ by as much
DIGITS = 4  # of a bound

Trail = tuple[str, ...]


@dataclass(frozen=True)
class Bound:
    """A figure beside its bound.

    Attributes:
        path: where it stands in the summary.
        bound: the least that was reached before; None where that was never.
        reached: now; None where it was not measured.
    """

    path: Trail
    bound: float | None
    reached: float | None

    @property
    def name(self) -> str:
        """The path in words."""
        return " / ".join(self.path)

    @property
    def kept(self) -> bool:
        """Whether it is no worse."""
        return self.reached is not None and (self.bound is None or self.reached <= WORSE * self.bound)


def leaves(tree: Any, path: Trail = ()) -> Iterator[tuple[Trail, Any]]:
    """Every value of nested dictionaries, with its path."""
    if not isinstance(tree, Mapping):
        yield path, tree
        return
    for key, value in tree.items():
        yield from leaves(value, (*path, str(key)))


def compare(experiment: Experiment[Any], summary: Mapping[str, Any], folder: Path = EXPECTED) -> list[Bound]:
    """Each figure that has a bound, beside it; none where there is no file.

    Raises:
        ConfigError: the file cannot be read.
    """
    path = folder / f"{experiment.name}.json"
    if not path.exists():
        return []
    figures = dict(leaves(summary if experiment.bounded is None else experiment.bounded(summary)))
    return [Bound(trail, bound, _number(figures.get(trail))) for trail, bound in leaves(_read(path))]


def tighten(experiment: Experiment[Any], summary: Mapping[str, Any], folder: Path = EXPECTED) -> list[str]:
    """Write what was reached where that is less than the bound.

    Times are not written: what one machine reaches on a good day binds no other.

    Returns:
        A line for each bound that has changed.

    Raises:
        ConfigError: the file cannot be read.
        CalibrationError: it cannot be written.
    """
    if experiment.alone:
        return []
    path, changed = folder / f"{experiment.name}.json", []
    found = compare(experiment, summary, folder)
    tree = _read(path) if found else {}
    for each in found:
        if each.reached is None:
            continue
        rounded = float(f"{each.reached:.{DIGITS}g}")
        if each.bound is None or rounded < each.bound:
            place = tree
            for key in each.path[:-1]:
                place = place[key]
            place[each.path[-1]] = rounded
            before = "none" if each.bound is None else f"{each.bound:g}"
            changed.append(f"{experiment.name}: {each.name}: {before} -> {rounded:g}")
    if changed:
        write_atomically(path, (json.dumps(tree, indent=2) + "\n").encode())
    return changed


def _read(path: Path) -> dict[str, Any]:
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: is not a table of bounds")
    return tree


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
