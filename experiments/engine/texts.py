"""Formatting of figures as text and JSON, and of an error as one line."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cotarget.errors import CotargetError

if TYPE_CHECKING:
    from cotarget.geometry import Array


def rms(values: "Iterable[float] | Array") -> float:
    """Compute the root mean square without nan values."""
    squared = np.square(np.array(list(values), dtype=float))
    return float(np.sqrt(np.nanmean(squared))) if np.isfinite(squared).any() else math.nan


def table(head: Sequence[str], lines: Iterable[Sequence[Any]]) -> str:
    """Format a table: first column left-aligned, numbers right-aligned with at least three significant digits."""
    cells = [list(head), *([_text(cell) for cell in line] for line in lines)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(head))]
    return "\n".join(
        "  ".join(cell.rjust(w) if i else cell.ljust(w) for i, (cell, w) in enumerate(zip(line, widths, strict=True)))
        for line in cells
    )


def _text(value: Any) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:#.3g}" if abs(value) < 100 else f"{value:.0f}"
    return str(value)


def plain(value: Any) -> Any:
    """Convert a value for JSON; numbers that are not finite become null."""
    if isinstance(value, Mapping):
        return {str(key): plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def in_one_line(error: Exception) -> str:
    """Format an error as one line; the type is named except for errors of this project."""
    text = " ".join(str(error).split())
    return text if isinstance(error, CotargetError) else f"{type(error).__name__}: {text}".rstrip(": ")
