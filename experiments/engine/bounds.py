"""Bounds of the quick runs' figures, in expected/NAME.json; they only tighten.

A file has some figures of a summary under the same names. Each has one or more of

    at_most, at_least   best value reached; a value up to WORSE times as bad passes
    within              pair of limits, which never changes

with null for a number that is not known yet. A number alone means at_most.
"""

import functools
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cotarget.errors import ConfigError
from cotarget.files import write_atomically
from experiments.engine.harness import Experiment
from experiments.engine.texts import plain

EXPECTED = Path(__file__).parents[1] / "expected"
WORSE = 1.10  # factor; other versions of the libraries round and render differently by about as much
DIGITS = 4  # significant digits of a bound
AT_MOST, AT_LEAST, WITHIN = "at_most", "at_least", "within"
WORDS = {AT_MOST: "at most", AT_LEAST: "at least", WITHIN: "within"}
Trail = tuple[str, ...]


@dataclass(frozen=True)
class Bound:
    """Figure with one of its bounds.

    Attributes:
        path: path of the figure in the summary.
        kind: AT_MOST, AT_LEAST or WITHIN.
        bound: best value reached before, or a pair of limits; None before the first.
        reached: value of this run; None where it was not measured.
    """

    path: Trail
    kind: str
    bound: float | tuple[float, float] | None
    reached: float | None

    @property
    def name(self) -> str:
        """Path of the figure as text."""
        return " / ".join(self.path)

    @property
    def text(self) -> str:
        """Bound as text."""
        if self.bound is None:
            return f"{WORDS[self.kind]} -"
        values = self.bound if isinstance(self.bound, tuple) else (self.bound,)
        return f"{WORDS[self.kind]} {' to '.join(f'{value:.4g}' for value in values)}"

    @property
    def kept(self) -> bool:
        """Whether the figure is within its bound."""
        if self.reached is None:
            return False
        if isinstance(self.bound, tuple):
            return self.bound[0] <= self.reached <= self.bound[1]
        if self.bound is None:
            return True
        worst = (self.bound * WORSE, self.bound / WORSE)  # for negative bounds the order is reversed
        return self.reached <= max(worst) if self.kind == AT_MOST else self.reached >= min(worst)

    @property
    def tighter(self) -> float | None:
        """New value of the bound; None where it stays."""
        if self.reached is None or self.kind == WITHIN:
            return None
        rounded = float(f"{self.reached:.{DIGITS}g}")
        if self.bound is None:
            return rounded
        assert not isinstance(self.bound, tuple), "a pair is within"
        better = rounded < self.bound if self.kind == AT_MOST else rounded > self.bound
        return rounded if better else None


def leaves(tree: Any, path: Trail = ()) -> Iterator[tuple[Trail, Any]]:
    """Iterate over all values of nested dictionaries, with their paths."""
    if not isinstance(tree, Mapping):
        yield path, tree
        return
    for key, value in tree.items():
        yield from leaves(value, (*path, str(key)))


def compare(experiment: Experiment[Any], summary: Mapping[str, Any], folder: Path = EXPECTED) -> list[Bound]:
    """List the figures that have bounds, with these; empty without a file.

    Raises:
        ConfigError: the file cannot be read.
    """
    return [bound for bound, _ in _beside(experiment, summary, folder)[0]]


def _beside(
    experiment: Experiment[Any], summary: Mapping[str, Any], folder: Path
) -> tuple[list[tuple[Bound, Callable[[float], None]]], dict[str, Any]]:
    """Pair each bounded figure with a function that replaces its bound in the table; also give the table."""
    path = folder / f"{experiment.name}.json"
    tree = _read(path) if path.exists() else {}
    figures = dict(leaves(plain(summary if experiment.bounded is None else experiment.bounded(summary))))
    found: list[tuple[Bound, Callable[[float], None]]] = []
    for trail, bound in leaves(tree):
        kind, name = (trail[-1], trail[:-1]) if trail and trail[-1] in WORDS else (AT_MOST, trail)
        each = Bound(name, kind, _checked(bound, kind, f"{path}: {' / '.join(trail)}"), _number(figures.get(name)))
        found.append((each, functools.partial(_put, tree, trail)))
    return found, tree


def _checked(bound: Any, kind: str, where: str) -> float | tuple[float, float] | None:
    if kind == WITHIN:
        if isinstance(bound, list) and len(bound) == 2 and None not in (pair := tuple(map(_number, bound))):
            return pair  # type: ignore[return-value]
        raise ConfigError(f"{where}: {bound!r} is not a pair of numbers")
    if bound is not None and _number(bound) is None:
        raise ConfigError(f"{where}: {bound!r} is not a number, nor null")
    return _number(bound)


def _put(tree: dict[str, Any], trail: Trail, value: float) -> None:
    for key in trail[:-1]:
        tree = tree[key]
    tree[trail[-1]] = value


def tighten(experiment: Experiment[Any], summary: Mapping[str, Any], folder: Path = EXPECTED) -> list[str]:
    """Write the values that are better than their bounds.

    Experiments that measure times have no bounds written, because machines differ.

    Returns:
        A line for each bound that changed.

    Raises:
        ConfigError: the file cannot be read or written.
    """
    if experiment.alone:
        return []
    found, tree = _beside(experiment, summary, folder)
    changed = []
    for bound, put in found:
        if (value := bound.tighter) is not None:
            put(value)
            changed.append(f"{experiment.name}: {bound.name}: {bound.text} -> {value:g}")
    if changed:
        write_atomically(folder / f"{experiment.name}.json", (json.dumps(tree, indent=2) + "\n").encode())
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
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if is_number else None
