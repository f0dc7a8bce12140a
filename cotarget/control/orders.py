"""Define the orders of an operator to a run: follow, stand, move by hand, zoom, go home, stop and clear.

A run obeys the orders that it gets with a frame; a recording keeps them with that frame, so that its replay does too.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from cotarget.rig import Angles

Kind = Literal["follow", "stand", "manual", "zoom", "home", "stop", "clear"]
KINDS: tuple[Kind, ...] = get_args(Kind)
OF_ALL: tuple[Kind, ...] = ("stop", "clear")  # orders to the rig, and not to one head
# By hand an axis goes on for this long after an order [s]; orders come more often, and end by themselves so.
MANUAL_S = 0.3
HOME: Angles = (0.0, 0.0)  # pan and tilt of a head at home [rad]


@dataclass(frozen=True)
class Order:
    """One order of an operator.

    Attributes:
        kind: what to do.
        of: name of the head that obeys; empty for an order to the whole rig.
        track: id of the track to follow; None for another choice.
        click: pixel of the fixed image at which to follow a target; with neither, the run's own policy chooses.
        rates: speed of pan and tilt by hand, in parts of the field of view a second; positive to the right and up.
        factor: factor of the focal length.
        reason: why the rig is stopped.
    """

    kind: Kind
    of: str = ""
    track: int | None = None
    click: tuple[float, float] | None = None
    rates: tuple[float, float] = (0.0, 0.0)
    factor: float = 1.0
    reason: str = ""


def order_row(order: Order) -> dict[str, Any]:
    """Write an order as a line of a recording's log."""
    row: dict[str, Any] = {"order": order.kind}
    if order.kind not in OF_ALL:
        row["of"] = order.of
    match order:
        case Order(kind="follow", track=int()):
            row["track"] = order.track
        case Order(kind="follow", click=(u, v)):
            row["click"] = [u, v]
        case Order(kind="manual"):
            row["rates"] = list(order.rates)
        case Order(kind="zoom"):
            row["factor"] = order.factor
        case Order(kind="stop"):
            row["reason"] = order.reason
    return row


def parse_order(row: Mapping[str, Any]) -> Order:
    """Parse an order of the log.

    Raises:
        ValueError, TypeError, KeyError: the row is no valid order.
    """
    kind, of = row["order"], row.get("of", "")
    if kind not in KINDS or not isinstance(of, str):
        raise ValueError(f"unknown order {kind!r} of {of!r}")
    track, click = row.get("track"), row.get("click")
    if track is not None and type(track) is not int:
        raise ValueError(f"track {track!r} is no number of a track")
    factor = _finite(row.get("factor", 1.0))
    if factor <= 0:
        raise ValueError("factor is not above zero")
    pixel = None if click is None else _pair(click)
    rates = _pair(row.get("rates", (0.0, 0.0)))
    return Order(kind, of, track, pixel, rates, factor, str(row.get("reason", "")))


def _pair(values: Any) -> tuple[float, float]:
    first, second = map(_finite, values)
    return first, second


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{value!r} is not finite")
    return number
