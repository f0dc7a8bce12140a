"""Statistics of a figure over the seeds (median, least and largest; or mean), as numbers, text and plots."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.engine.harness import Row
from experiments.engine.texts import table

if TYPE_CHECKING:
    from matplotlib.axes import Axes


WHOLE = 1000.0  # numbers from this on are printed without decimals
HEADROOM = 1.1  # upper limit of an axis over the highest value
BESIDE = 0.12  # offset of the values to the right of the median


def spread(rows: Sequence[Row], key: str) -> dict[str, float]:
    """Give median, least and largest of a figure, over the rows that have it; nan where none has."""
    return spread_of(float(row[key]) for row in rows if row[key] is not None)


def spread_of(values: Iterable[float]) -> dict[str, float]:
    """Give median, least and largest of values; nan of none."""
    told = list(values)
    three = (np.median(told), min(told), max(told)) if told else (np.nan,) * 3
    return dict(zip(("median", "least", "largest"), map(float, three), strict=True))


def mean_of(values: Iterable[float]) -> tuple[float, float]:
    """Give mean of values and its standard error; nan of no value, and an error of nan of one."""
    told = list(values)
    error = float(np.std(told, ddof=1) / math.sqrt(len(told))) if len(told) > 1 else math.nan
    return (float(np.mean(told)) if told else math.nan), error


def in_words(found: Mapping[str, float], form: str = "") -> str:
    """Format a spread: the median, then least and largest where they differ; three significant digits by default."""
    three = (found[key] for key in ("median", "least", "largest"))
    median, least, largest = (_text(each, form) for each in three)
    return median if least == largest else f"{median} ({least} to {largest})"


def _text(value: float, form: str) -> str:
    return "-" if math.isnan(value) else format(value, form or (".0f" if abs(value) >= WHOLE else ".3g"))


def ways_of(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Group rows by their "way", in the order of first appearance."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row["way"], []).append(row)
    return found


def ways_table(what: str, summary: Mapping[str, Mapping[str, Any]], figures: Mapping[str, str]) -> str:
    """Format spreads as a table with a line per figure and a column per way."""
    lines = [[words, *(in_words(found[key]) for found in summary.values())] for key, words in figures.items()]
    return table((what, *summary), lines)


def points(ax: "Axes", at: float, values: Sequence[float], **how: Any) -> None:
    """Draw values at a place on the x axis: their median with a bar from least to largest, and each value beside it.

    Args:
        ax: axes to draw in.
        at: place on the x axis.
        values: values to draw; with none, nothing is drawn.
        how: colour and label, as for matplotlib.
    """
    if values:
        found = spread_of(values)
        reach = [[found["median"] - found["least"]], [found["largest"] - found["median"]]]
        bar = ax.errorbar([at], [found["median"]], yerr=reach, fmt="_", markersize=12, capsize=3, **how)
        ax.plot([at + BESIDE] * len(values), values, ".", color=bar.lines[0].get_color(), alpha=0.5)


def bars(ax: "Axes", at: Sequence[float], values: Sequence[Sequence[float]], width: float, **how: Any) -> None:
    """Draw the mean of each group of values as a bar with its standard error, and each value as a point on it.

    Args:
        ax: axes to draw in.
        at: place of each group on the x axis.
        values: values of each group.
        width: width of a bar.
        how: colour and label, as for matplotlib.
    """
    means, errors = np.array([mean_of(each) for each in values]).T
    ax.bar(at, means, width, yerr=np.nan_to_num(errors), capsize=3, **how)
    for place, each in zip(at, values, strict=True):
        ax.plot([place] * len(each), each, ".", ms=3, color="k")


def by_way(axes: "Iterable[Axes]", rows: Sequence[Row], titles: Mapping[str, str]) -> None:
    """Draw each figure in its own axes from zero on, with the rows of each way side by side, under a title."""
    ways = ways_of(rows)
    for ax, (key, title) in zip(axes, titles.items(), strict=True):
        for i, mine in enumerate(ways.values()):
            points(ax, i, [row[key] for row in mine if row[key] is not None], color=f"C{i}")
        ax.set(xticks=range(len(ways)), xticklabels=list(ways), xlim=(-0.5, len(ways) - 0.5))
        ax.set_ylim(0, HEADROOM * ax.get_ylim()[1])
        ax.set_title(title, size=7)
