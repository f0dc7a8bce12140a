"""Statistics of figures over the seeds, as numbers and text; shared by the experiments."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from cotarget.geometry import Array

SPREAD = ("median", "least", "largest")
WHOLE = 1000.0  # numbers from this on are printed without decimals
Range = tuple[float, float]
Row = dict[str, Any]  # a row of an experiment: numbers, texts and truth values by column


# Numbers


def rms(values: "Iterable[float] | Array") -> float:
    """Compute the root mean square without nan values."""
    squared = np.square(np.array(list(values), dtype=float))
    return float(np.sqrt(np.nanmean(squared))) if np.isfinite(squared).any() else math.nan


def spread(values: Iterable[float | None]) -> dict[str, float]:
    """Give median, least and largest of the values that are there; nan where none is."""
    told = [float(value) for value in values if value is not None]
    three = (np.median(told), min(told), max(told)) if told else (math.nan,) * 3
    return dict(zip(SPREAD, map(float, three), strict=True))


def mean_of(values: Iterable[float]) -> tuple[float, float]:
    """Give mean of values and its standard error; nan of no value, and an error of nan of one."""
    told = list(values)
    error = float(np.std(told, ddof=1) / math.sqrt(len(told))) if len(told) > 1 else math.nan
    return (float(np.mean(told)) if told else math.nan), error


def grouped(rows: Iterable[Row], *keys: str) -> dict[Any, list[Row]]:
    """Group rows by the value of a column, or by the values of several, in the order of first appearance."""
    found: dict[Any, list[Row]] = {}
    for row in rows:
        found.setdefault(row[keys[0]] if len(keys) == 1 else tuple(row[key] for key in keys), []).append(row)
    return found


def spreads(rows: Iterable[Row], by: str, figures: Iterable[str]) -> dict[Any, dict[str, dict[str, float]]]:
    """Give the spread of each figure, by the value of a column."""
    keys = list(figures)
    return {name: {key: spread(row[key] for row in mine) for key in keys} for name, mine in grouped(rows, by).items()}


def spread_columns(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give the spread of each column of numbers; the summary of an experiment without its own."""
    numbers = [
        key for key, value in rows[0].items() if isinstance(value, float) or (type(value) is int and key != "seed")
    ]
    return {key: spread(row[key] for row in rows) for key in numbers}


def outside(figures: Mapping[str, Any], wanted: Mapping[str, Range], name: str = "") -> list[str]:
    """List the figures whose value or median is not in the wanted range, with a name in front."""
    missed = []
    for key, (low, high) in wanted.items():
        value: Any = figures[key]
        if isinstance(value, Mapping):
            value = value["median"]
        if not low <= value <= high:
            missed.append(f"{name}{name and ': '}{key}: {number(value)}, not {low:g} to {high:g}")
    return missed


def leaves(tree: Any, trail: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Iterate over all values of nested dictionaries, with their paths."""
    if not isinstance(tree, Mapping):
        yield trail, tree
        return
    for key, value in tree.items():
        yield from leaves(value, (*trail, str(key)))


def plain(value: Any) -> Any:
    """Convert a value for JSON; numbers that are not finite become null."""
    if isinstance(value, Mapping):
        return {str(key): plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value


# Text


def number(value: Any) -> str:
    """Format a number with three significant digits; a spread as its median (least to largest)."""
    if isinstance(value, Mapping):
        median, least, largest = (number(value[key]) for key in SPREAD)
        return median if least == largest else f"{median} ({least} to {largest})"
    if isinstance(value, float | np.floating):
        return "-" if math.isnan(value) else format(value, ".0f" if abs(float(value)) >= WHOLE else ".3g")
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def as_text(figures: Mapping[str, Any]) -> str:
    """Format nested figures as tables, one for each depth of nesting.

    The last name of a figure makes the column, the others the line, or the other way round where that is narrower.
    """
    import pandas as pd

    tables: dict[int, dict[str, dict[str, str]]] = {}
    for trail, value in _cells(figures, ()):
        line = tables.setdefault(len(trail), {}).setdefault(" / ".join(trail[:-1]), {})
        line[trail[-1]] = number(value)
    texts = []
    for lines in tables.values():
        frame = pd.DataFrame.from_dict(lines, orient="index").fillna("")
        texts.append((frame if len(frame) >= len(frame.columns) else frame.T).to_string())
    return "\n\n".join(texts)


def _cells(tree: Mapping[str, Any], trail: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Iterate over figures with their paths; a spread is one figure."""
    for key, value in tree.items():
        if isinstance(value, Mapping) and not set(SPREAD) <= set(value):
            yield from _cells(value, (*trail, str(key)))
        else:
            yield (*trail, str(key)), value


def columns(head: Sequence[str], lines: Iterable[Sequence[Any]]) -> str:
    """Format lines under a head."""
    import pandas as pd

    return str(pd.DataFrame([list(map(number, line)) for line in lines], columns=list(head)).to_string(index=False))
