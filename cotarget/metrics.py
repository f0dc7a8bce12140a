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

# In frame: at least half of the silhouette visible, and at least half as large as wanted.
VISIBLE_IN_FRAME = 0.5
SIZE_IN_FRAME = 0.5
# Acquired: in frame for this long on end [s].
ACQUIRED_S = 0.5
# A close-up is good with the whole target visible at 0.8 to 1.25 of the wanted size.
GOOD_SIZE = (0.8, 1.25)
WHOLLY_VISIBLE = 0.999  # the silhouette's area is counted on a grid; a rim of less is rounding
# The clock starts when the target is wholly in the wide view, after the background had this long to be learnt [s].
BACKGROUND_S = 2.0
# In-frame runs broken for longer than this count as fragmentation [s].
BREAK_S = 0.2
ROUNDING_S = 1e-6  # frame times are sums and differences of binary fractions


@dataclass(frozen=True)
class Row:
    """One zoom frame.

    Attributes:
        t_s: middle of the zoom frame's exposure [s].
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
        u_detected_px: where the followed track is in the wide image [px]; nan for none.
        v_detected_px: likewise.
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
    def inside(self) -> bool:
        """Whether the body centre is inside the zoom image."""
        return -0.5 <= self.u_px <= self.width_px - 0.5 and -0.5 <= self.v_px <= self.height_px - 0.5

    @property
    def size_ratio(self) -> float:
        """True size over the size wanted."""
        return self.size_px / self.wanted_px

    @property
    def in_frame(self) -> bool:
        """Whether the target is in the close-up, by the definition above."""
        return self.inside and self.visible >= VISIBLE_IN_FRAME and self.size_ratio >= SIZE_IN_FRAME

    @property
    def good_closeup(self) -> bool:
        """Whether the whole target is visible at about the wanted size."""
        return self.inside and self.visible >= WHOLLY_VISIBLE and GOOD_SIZE[0] <= self.size_ratio <= GOOD_SIZE[1]

    @property
    def tpo_px(self) -> float:
        """Target point offset: distance from the image's centre; half the diagonal for a frame without it [px]."""
        if not self.inside:
            return math.hypot(self.width_px, self.height_px) / 2
        return math.hypot(self.u_px - (self.width_px - 1) / 2, self.v_px - (self.height_px - 1) / 2)

    @property
    def tpo_deg(self) -> float:
        """The same as an angle [degrees]."""
        return math.degrees(math.atan(self.tpo_px / self.focal_px))


@dataclass(frozen=True)
class Score:
    """How well a target was held; None where it was never acquired, or never there.

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
        tpe_px_median: the followed track's error in the wide view [px].
        fragmentation_per_min: in-frame runs broken for more than 0.2 s, a minute.
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


def score(rows: Sequence[Row]) -> Score:
    """Score one run of following one target; see the fields of `Score` for the definitions."""
    start = next((i for i, row in enumerate(rows) if row.in_wide and row.t_s >= BACKGROUND_S), None)
    if start is None:
        return Score(0, *[None] * 11)
    counted = rows[start:]
    acquired = _acquired(counted)
    after = counted[acquired:] if acquired is not None else []
    off = [math.hypot(r.u_wide_px - r.u_detected_px, r.v_wide_px - r.v_detected_px) for r in counted if r.track >= 0]

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
        tpe_px_median=median(off),
        fragmentation_per_min=_fragmentation(after),
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


def _fragmentation(rows: Sequence[Row]) -> float | None:
    """How often the target was out of frame for longer than 0.2 s, a minute."""
    if len(rows) < 2:
        return None
    breaks, since = 0, None
    for row in rows:
        if row.in_frame:
            breaks += since is not None and row.t_s - since > BREAK_S + ROUNDING_S
            since = None
        elif since is None:
            since = row.t_s
    breaks += since is not None and rows[-1].t_s - since > BREAK_S + ROUNDING_S
    return breaks / ((rows[-1].t_s - rows[0].t_s) / 60)
