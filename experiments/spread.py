"""A figure over the seeds: median, least and largest, and a bar for each seed that has it."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from experiments.harness import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def spread(rows: Sequence[Row], key: str) -> dict[str, float]:
    """Median, least and largest of a figure, over the rows that have it; nan where none has."""
    values = [float(row[key]) for row in rows if row[key] is not None]
    three = (np.median(values), min(values), max(values)) if values else (np.nan,) * 3
    return dict(zip(("median", "least", "largest"), map(float, three), strict=True))


def bars(axes: "Iterable[Axes]", rows: Sequence[Row], titles: Mapping[str, str]) -> None:
    """Draw each figure in axes of its own, a bar a row that has it, under a title."""
    for ax, (key, title) in zip(axes, titles.items(), strict=True):
        told = [row for row in rows if row[key] is not None]
        ax.bar(range(len(told)), [row[key] for row in told], tick_label=[row["seed"] for row in told])
        ax.set(title=title, xlabel="seed")
        ax.title.set_size(8)
