"""Scores, computed from rows alone: whoever has a steps.csv can recompute every figure.

A row says, for one zoom frame, what was commanded and what was really so. `cotarget.judging` makes rows from Steps and
the simulation's truth; the scores only read rows.
"""

import csv
import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cotarget.errors import ConfigError
from cotarget.metrics.closeup import Closeup

# Acquired: in frame for this long on end [s].
ACQUIRED_S = 0.5
# The clock starts when the target is wholly in the wide view, after the background had this long to be learnt [s].
BACKGROUND_S = 2.0
# In-frame runs broken for longer than this count as fragmentation [s].
BREAK_S = 0.2
# A track counts as false when it was confirmed and off every target for this long on end [s].
FALSE_S = 0.5
ROUNDING_S = 1e-6  # frame times are sums and differences of binary fractions


@dataclass(frozen=True)
class Row:
    """One new zoom frame, and the fixed frame that the loop had acted on when it came.

    What is said of the wide view is at that fixed frame's own time; all else is at the zoom frame's.

    Attributes:
        t_s: middle of the zoom frame's exposure [s].
        t_fixed_s: middle of the fixed frame's exposure [s].
        state: what the loop was doing.
        track: number of the track followed; -1 for none.
        u_px: true position of the target's body centre in the zoom image [px]; nan behind the camera.
        v_px: likewise.
        width_px: width of the zoom image [px].
        height_px: its height [px].
        size_px: true size of the wanted dimension in the zoom image [px].
        wanted_px: size wanted, or what the longest focal length gives where that is less [px].
        visible: fraction of the true silhouette visible in the zoom image.
        in_wide: whether the target is wholly in the wide view.
        u_wide_px: true position in the wide image [px].
        v_wide_px: likewise.
        u_detected_px: middle of the followed track's detection in the wide image [px]; nan where that image had none.
        v_detected_px: likewise.
        decoded: whether the target's marker decodes in the zoom image.
        decoded_wide: whether it decodes in the wide image.
        off_target: numbers of the confirmed tracks that are off every target, as "3 7".
        range_m: true distance from the zoom camera [m].
        depth_m: estimated depth [m]; nan where nothing was aimed at.
        pan_commanded_deg: last command [degrees].
        tilt_commanded_deg: likewise.
        focal_commanded_px: last command, nominal [px].
        pan_deg: true pan at the zoom frame's time [degrees].
        tilt_deg: likewise.
        focal_px: true focal length at the zoom frame's time [px].
        target: name of the target that is followed.
    """

    t_s: float
    t_fixed_s: float
    state: str
    track: int
    u_px: float
    v_px: float
    width_px: int
    height_px: int
    size_px: float
    wanted_px: float
    visible: float
    in_wide: bool
    u_wide_px: float
    v_wide_px: float
    u_detected_px: float
    v_detected_px: float
    decoded: bool
    decoded_wide: bool
    off_target: str
    range_m: float
    depth_m: float
    pan_commanded_deg: float
    tilt_commanded_deg: float
    focal_commanded_px: float
    pan_deg: float
    tilt_deg: float
    focal_px: float
    target: str = ""

    @property
    def closeup(self) -> Closeup:
        """What the zoom frame shows."""
        return Closeup(self.u_px, self.v_px, self.width_px, self.height_px, self.size_px, self.wanted_px, self.visible)

    @property
    def inside(self) -> bool:
        """Whether the body centre is inside the zoom image."""
        return self.closeup.inside

    @property
    def size_ratio(self) -> float:
        """True size over the size wanted."""
        return self.closeup.size_ratio

    @property
    def in_frame(self) -> bool:
        """Whether the target is in the close-up."""
        return self.closeup.in_frame

    @property
    def good_closeup(self) -> bool:
        """Whether the whole target is visible at about the wanted size."""
        return self.closeup.good

    @property
    def tpo_px(self) -> float:
        """Target point offset: distance from the image's centre; half the diagonal for a frame without it [px]."""
        return self.closeup.tpo_px

    @property
    def tpo_deg(self) -> float:
        """The same as an angle [degrees]."""
        return math.degrees(math.atan(self.tpo_px / self.focal_px))

    @property
    def tpe_px(self) -> float:
        """Target point error: distance from the detection to the truth in the wide view [px]; nan without one."""
        return math.hypot(self.u_wide_px - self.u_detected_px, self.v_wide_px - self.v_detected_px)


@dataclass(frozen=True)
class Score:
    """How well a target was held; None where it was never acquired, or never there.

    Wear and false tracks are counted, like the yield, from when the target was wholly in the wide view.

    Attributes:
        frames: zoom frames since the target was wholly in the wide view.
        time_to_acquire_s: from then to the first half second in frame [s].
        closeup_yield: good close-ups over all those frames, acquisition included.
        in_frame_ratio: frames in frame over all frames after acquisition, the lost ones too.
        tpo_px_median: of the frames after acquisition [px].
        tpo_width_median: the same over the width of the image.
        tpo_deg_median: the same as an angle [degrees].
        size_ratio_median: of the frames after acquisition.
        wanted_px: size wanted [px], median.
        range_m: true range [m], median.
        tpe_px_median: the detection's error in the wide view, of the frames that have one [px].
        fragmentation_per_min: in-frame runs broken for more than 0.2 s [1/min].
        identification: frames in which the marker decodes in the close-up, over all those that the yield counts.
        identification_wide: the same in the wide view, for comparison.
        commands_per_min: changes of the commanded pan or tilt from one row to the next [1/min].
        reversals_per_min: changes of direction of the commands, both axes together [1/min].
        false_tracks_per_min: tracks that were confirmed and off every target for 0.5 s on end [1/min].
    """

    frames: int
    time_to_acquire_s: float | None
    closeup_yield: float | None
    in_frame_ratio: float | None
    tpo_px_median: float | None
    tpo_width_median: float | None
    tpo_deg_median: float | None
    size_ratio_median: float | None
    wanted_px: float | None
    range_m: float | None
    tpe_px_median: float | None
    fragmentation_per_min: float | None
    identification: float | None = None
    identification_wide: float | None = None
    commands_per_min: float | None = None
    reversals_per_min: float | None = None
    false_tracks_per_min: float | None = None


def score(rows: Sequence[Row]) -> Score:
    """Score one run of following one target; see the fields of `Score` for the definitions."""
    start = next((i for i, row in enumerate(rows) if row.in_wide and row.t_s >= BACKGROUND_S), None)
    if start is None:
        return Score(0, *[None] * 11)
    counted = rows[start:]
    acquired = _acquired(counted)
    after = counted[acquired:] if acquired is not None else []
    commands, reversals = _wear(counted)

    def median(values: Iterable[float]) -> float | None:
        finite = [v for v in values if math.isfinite(v)]
        return float(np.median(finite)) if finite else None

    return Score(
        frames=len(counted),
        time_to_acquire_s=after[0].t_s - counted[0].t_s if after else None,
        closeup_yield=float(np.mean([r.good_closeup for r in counted])),
        in_frame_ratio=float(np.mean([r.in_frame for r in after])) if after else None,
        tpo_px_median=median(r.tpo_px for r in after),
        tpo_width_median=median(r.tpo_px / r.width_px for r in after),
        tpo_deg_median=median(r.tpo_deg for r in after),
        size_ratio_median=median(r.size_ratio for r in after),
        wanted_px=median(r.wanted_px for r in counted),
        range_m=median(r.range_m for r in counted),
        tpe_px_median=median(r.tpe_px for r in counted),
        fragmentation_per_min=_per_minute(_breaks(after), after),
        identification=float(np.mean([r.decoded for r in counted])),
        identification_wide=float(np.mean([r.decoded_wide for r in counted])),
        commands_per_min=_per_minute(commands, counted),
        reversals_per_min=_per_minute(reversals, counted),
        false_tracks_per_min=_per_minute(_false_tracks(counted), counted),
    )


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write steps.csv, one line a zoom frame."""
    names = [f.name for f in dataclasses.fields(Row)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows([getattr(row, name) for name in names] for row in rows)


def read_rows(path: Path) -> list[Row]:
    """Read steps.csv.

    Raises:
        ConfigError: the file is missing, or is not a steps.csv.
    """
    kinds = {f.name: f.type for f in dataclasses.fields(Row)}
    parse: dict[object, Callable[[str], object]] = {int: int, float: float, str: str, bool: _truth_value}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if missing := [name for name in kinds if name not in (reader.fieldnames or ())]:
                raise ValueError(f"it has no column '{missing[0]}'")
            lines = list(reader)
        if any(None in line.values() for line in lines):
            raise ValueError("a line of it was cut off")
        return [
            Row(**{name: parse[kind](line[name]) for name, kind in kinds.items()})  # type: ignore[arg-type]
            for line in lines
        ]
    except (OSError, csv.Error, ValueError) as error:
        raise ConfigError(f"{path}: is not a steps.csv: {error}") from None


def _truth_value(text: str) -> bool:
    if text not in ("True", "False"):
        raise ValueError(f"'{text}' is not True or False")
    return text == "True"


def _acquired(rows: Sequence[Row]) -> int | None:
    """Index of the first row of the first half second in frame on end."""
    begin: int | None = None
    for i, row in enumerate(rows):
        if not row.in_frame:
            begin = None
        else:
            begin = i if begin is None else begin
            if row.t_s - rows[begin].t_s >= ACQUIRED_S - ROUNDING_S:
                return begin
    return None


def _per_minute(count: int, rows: Sequence[Row]) -> float | None:
    """Events over the time from the first row to the last [1/min]; None for no time."""
    return count / ((rows[-1].t_s - rows[0].t_s) / 60) if len(rows) > 1 else None


def _breaks(rows: Sequence[Row]) -> int:
    """How often the target was out of frame for longer than 0.2 s."""
    breaks, since = 0, None
    for row in rows:
        if row.in_frame:
            breaks += since is not None and row.t_s - since > BREAK_S + ROUNDING_S
            since = None
        elif since is None:
            since = row.t_s
    return breaks + (since is not None and rows[-1].t_s - since > BREAK_S + ROUNDING_S)


def _wear(rows: Sequence[Row]) -> tuple[int, int]:
    """How often the commanded pan or tilt changed, and how often an axis's changes turned round, pauses aside."""
    changes = np.diff([[row.pan_commanded_deg, row.tilt_commanded_deg] for row in rows], axis=0)
    reversals = sum(np.count_nonzero(np.diff(np.sign(axis[axis != 0]))) for axis in changes.T)
    return int(np.count_nonzero(changes.any(axis=1))), int(reversals)


def _false_tracks(rows: Sequence[Row]) -> int:
    """How many tracks were confirmed and off every target for half a second on end."""
    false: set[str] = set()
    since: dict[str, float] = {}
    for row in rows:
        since = {track: since.get(track, row.t_s) for track in row.off_target.split()}
        false |= {track for track, begin in since.items() if row.t_s - begin >= FALSE_S - ROUNDING_S}
    return len(false)
