"""Numbers as people read them."""

import math
from collections.abc import Sequence

MOST_DECIMALS = 9
UNCERTAINTY_DIGITS = 2  # more of a standard deviation is not known
VALUE_DIGITS = 6  # of a value whose uncertainty is not known


def digits(value: float, count: int = 2) -> str:
    """Write a number with so many significant digits and, unless it is tiny, without an exponent: 0.0021, 12, 7200."""
    if not math.isfinite(value):
        return "unknown"
    if value == 0:
        return "0"
    decimals = _decimals(value, count)
    if decimals > MOST_DECIMALS:
        return f"{value:.{count - 1}e}"
    return f"{round(value, decimals):.{max(decimals, 0)}f}"


def _decimals(value: float, count: int) -> int:
    """How many decimals show so many significant digits, once the value is rounded to them: 0.0996 becomes 0.10."""
    decimals = count - 1 - math.floor(math.log10(abs(value)))
    return count - 1 - math.floor(math.log10(abs(round(value, decimals))))


def value_and_sigma(value: float, sigma: float | None) -> str:
    """Write a value to the decimals that its standard deviation leaves: 692.31 ± 0.24."""
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return digits(value, VALUE_DIGITS)
    shown = min(max(_decimals(sigma, UNCERTAINTY_DIGITS), 0), MOST_DECIMALS)
    return f"{value:.{shown}f} ± {digits(sigma, UNCERTAINTY_DIGITS)}"


def count(number: int, one: str, many: str | None = None) -> str:
    """Write a number of things: 1 view, 2 views."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def percent(share: float) -> str:
    """Write a share: 0.04 %, 3 %, 62 %."""
    if 0 < share < 0.01:
        return f"{digits(100 * share, 1)} %"
    return f"{100 * share:.0f} %"


def listed(items: Sequence[str]) -> str:
    """Join words: a, b and c."""
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)
