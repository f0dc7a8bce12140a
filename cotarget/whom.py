"""Which of several targets a run follows, as a recording keeps it and the commands' options say it."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Whom:
    """Which of several targets a run follows: one of these, or the first that comes where nothing is said.

    Attributes:
        policy: its name, of `cotarget.policies.POLICIES`.
        click: the target at this pixel of the wide view (u, v).
        track: the track of this number.
    """

    policy: str | None = None
    click: tuple[float, float] | None = None
    track: int | None = None


# Nothing is said.
ANYBODY = Whom()


def whom_table(whom: Whom) -> dict[str, Any]:
    """Write whom a run follows."""
    parts = {"policy": whom.policy, "click": whom.click and list(whom.click), "track": whom.track}
    return {name: value for name, value in parts.items() if value is not None}


def parse_whom(table: Any) -> Whom:
    """Read whom a run followed.

    Raises:
        ValueError: it is no such table.
    """
    if not isinstance(table, dict) or len(table) > 1 or not table.keys() <= {"policy", "click", "track"}:
        raise ValueError(f"{table!r} is not one of policy, click and track")
    policy, click, track = (table.get(name) for name in ("policy", "click", "track"))
    if not isinstance(policy, str | None) or not (track is None or (type(track) is int and track > 0)):
        raise ValueError(f"{table!r} is no policy's name or track's number")
    if click is None:
        return Whom(policy, None, track)
    if not (isinstance(click, list) and len(click) == 2 and all(type(x) in (int, float) for x in click)):
        raise ValueError(f"click {click!r} is no pixel")
    return Whom(click=(float(click[0]), float(click[1])))
