"""Score runs: close-ups and wear from the rows of steps.csv.

A `Row` holds, for one zoom frame, what was commanded and the ground truth. `cotarget.evaluation` makes rows from Steps
and the simulation's truth. Scores use rows alone, so every figure can be recomputed from a steps.csv.
"""

import csv
import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cotarget.config import GOOD_SIZE
from cotarget.files import read_table

# In frame: least visible part of the silhouette, and least size ratio.
VISIBLE_IN_FRAME = 0.5
SIZE_IN_FRAME = 0.5
SERVED_S = 1.0  # total time of good close-ups from which a target counts as served [s]
CENTRED = 0.05  # largest target point offset of a centred target, over the image's width
WHOLLY_VISIBLE = 0.999  # least visible part of a wholly visible target; its area is counted on a grid and rounded


@dataclass(frozen=True)
class Closeup:
    """Ground truth of a target in one zoom frame.

    Attributes:
        u_px: true position of the target's body centre in the zoom image [px]; nan behind the camera.
        v_px: its v coordinate [px].
        width_px: width of the zoom image [px].
        height_px: height of the zoom image [px].
        size_px: true size of the wanted dimension in the zoom image, along the target's own axis [px]; nan behind the
            camera.
        wanted_px: wanted size, or the size at the longest focal length if that is less [px].
        visible: part of the true silhouette visible in the zoom image, 0 to 1.
        hidden: whether something hides a part of the target from the zoom camera.
    """

    u_px: float
    v_px: float
    width_px: int
    height_px: int
    size_px: float
    wanted_px: float
    visible: float
    hidden: bool = False

    @property
    def inside(self) -> bool:
        """Whether the body centre is inside the image."""
        return -0.5 <= self.u_px <= self.width_px - 0.5 and -0.5 <= self.v_px <= self.height_px - 0.5

    @property
    def size_ratio(self) -> float:
        """True size over the wanted size; 0 for a target behind the camera."""
        return 0.0 if math.isnan(self.size_px) else self.size_px / self.wanted_px

    @property
    def in_frame(self) -> bool:
        """Whether the target is in frame: centre inside, at least half visible, at least half as large as wanted."""
        return self.inside and self.visible >= VISIBLE_IN_FRAME and self.size_ratio >= SIZE_IN_FRAME

    @property
    def good(self) -> bool:
        """Whether the whole target is visible at about the wanted size."""
        return self.inside and self.visible >= WHOLLY_VISIBLE and GOOD_SIZE[0] <= self.size_ratio <= GOOD_SIZE[1]

    @property
    def centred(self) -> bool:
        """Whether the close-up is good, with the body centre within 5 % of the width of the image's centre."""
        return self.good and self.tpo_px <= CENTRED * self.width_px

    @property
    def tpo_px(self) -> float:
        """Target point offset: distance from the image's centre; half the diagonal if the target is not inside [px]."""
        if not self.inside:
            return math.hypot(self.width_px, self.height_px) / 2
        return math.hypot(self.u_px - (self.width_px - 1) / 2, self.v_px - (self.height_px - 1) / 2)


# Rows of steps.csv


@dataclass(frozen=True)
class Row:
    """One new zoom frame, and the fixed frame that the pipeline had processed when it came.

    Values in the fixed image are at that fixed frame's time; all others are at the zoom frame's.

    Attributes:
        t_s: middle of the zoom frame's exposure [s].
        t_fixed_s: middle of the fixed frame's exposure [s].
        state: state of the pipeline.
        track: id of the followed track; -1 for none.
        u_px, v_px, width_px, height_px, size_px, wanted_px, visible, hidden: the zoom frame's `Closeup`.
        in_wide: whether the target is wholly in the fixed image.
        u_wide_px: true position in the fixed image [px].
        v_wide_px: its v coordinate [px].
        u_detected_px: centre of the followed track's unshared detection in the fixed image [px]; nan without one.
        v_detected_px: its v coordinate [px].
        decoded: whether the target's marker decodes in the zoom image.
        decoded_wide: whether the target's marker decodes in the fixed image.
        off_target: ids of the reported tracks that are off every target, as "3 7".
        range_m: true distance from the zoom camera [m].
        depth_m: estimated depth [m]; nan if nothing was aimed at.
        pan_commanded_deg: last commanded pan [degrees].
        tilt_commanded_deg: last commanded tilt [degrees].
        focal_commanded_px: last commanded nominal focal length [px].
        pan_deg: true pan at the zoom frame's time [degrees].
        tilt_deg: true tilt at the zoom frame's time [degrees].
        focal_px: true focal length at the zoom frame's time [px].
        target: name of the followed target.
        head_commands: commands sent to the head until then, whether its goal changed or not.
        lens_commands: commands sent to the lens until then.
        on_target: confirmed tracks with an unshared detection in the fixed frame, each with every target that it is
            on, the nearest first, as "3:bird 3:bird2 7:bird".
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
    head_commands: int = 0
    lens_commands: int = 0
    on_target: str = ""
    hidden: bool = False

    @property
    def closeup(self) -> Closeup:
        """Ground truth of the zoom frame."""
        sizes = self.width_px, self.height_px, self.size_px, self.wanted_px
        return Closeup(self.u_px, self.v_px, *sizes, self.visible, self.hidden)

    @property
    def tpo_deg(self) -> float:
        """Target point offset as an angle [degrees]."""
        return math.degrees(math.atan(self.closeup.tpo_px / self.focal_px))

    @property
    def tpe_px(self) -> float:
        """Target point error: distance of the detection from the truth in the fixed image [px]; nan without one."""
        return math.hypot(self.u_wide_px - self.u_detected_px, self.v_wide_px - self.v_detected_px)


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write steps.csv, one line for each zoom frame."""
    names = [f.name for f in dataclasses.fields(Row)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows([getattr(row, name) for name in names] for row in rows)


def read_rows(path: Path) -> list[Row]:
    """Read steps.csv.

    Raises:
        ConfigError: the file is missing, or is no steps.csv.
    """
    truth_values = {"True": True, "False": False}
    parse: dict[Any, Callable[[str], Any]] = {int: int, float: float, str: str, bool: truth_values.__getitem__}
    columns = {f.name: parse[f.type] for f in dataclasses.fields(Row)}
    later = {"hidden": columns.pop("hidden")}  # version 0.1.0 wrote none
    return [Row(**row) for row in read_table(path, columns, "steps.csv", optional=later)]


# Scores of a run

# Time in frame without a break after which a target is acquired [s].
ACQUIRED_S = 0.5
# Time from the first row for which the background is learnt; the clock starts when the target is then wholly in the
# fixed image [s].
BACKGROUND_S = 2.0
# Shortest break of a run in frame that counts as fragmentation [s].
BREAK_S = 0.2
# Time off every target without a break after which a confirmed track is false [s].
FALSE_S = 0.5
ROUNDING_S = 1e-6  # frame times are sums and differences of binary fractions


@dataclass(frozen=True)
class Score:
    """Scores of one run; None if the target was never acquired, or never there.

    Wear, false tracks and ID switches count, like the yield, from when the target was wholly in the fixed image.

    Attributes:
        frames: zoom frames since the target was wholly in the fixed image.
        time_to_acquire_s: time from then to the first half second in frame [s].
        closeup_yield: good close-ups over those of these frames in which nothing hides the target, the time to acquire
            included.
        centred_yield: the same, of good close-ups with the target point within 5 % of the width of the image's centre.
        in_frame_ratio: frames in frame over all frames after acquisition, including those in which it was lost.
        tpo_px_median: median target point offset after acquisition [px].
        tpo_width_median: median target point offset after acquisition, over the image's width.
        tpo_deg_median: median target point offset after acquisition, as an angle [degrees].
        size_ratio_median: median size ratio after acquisition; a frame with the target behind the camera counts as 0.
        wanted_px: median wanted size [px].
        range_m: median true range [m].
        tpe_px_median: median target point error in the fixed image, over frames with a detection [px].
        fragmentation_per_min: breaks of more than 0.2 s while in frame [1/min].
        identification: part of the frames in which the marker decodes in the close-up. It is helped: the marker is
            searched only around the target's true box, in a part of the image that is enlarged twice, and a bird
            carries it on either flank, under its belly, and on its wings above and below.
        identification_wide: part of the frames in which it decodes in the fixed image, helped in the same ways.
        commands_per_min: commands sent to the head, whether its goal changed or not [1/min].
        reversals_per_min: changes of direction of the head's goals from row to row, both axes together [1/min].
        false_tracks_per_min: tracks that were confirmed and off every target for 0.5 s without a break [1/min].
        lens_commands_per_min: commands sent to the lens [1/min].
        id_switches_per_min: how often a track moved from one target to another, over all tracks (ID switches after Li,
            Huang and Nevatia 2009, "Learning to associate") [1/min]. A track that leaves its target for none is a false
            track instead.
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
    lens_commands_per_min: float | None = None
    id_switches_per_min: float | None = None
    centred_yield: float | None = None

    def summary(self) -> str:
        """The figures that matter most, in one line."""
        if not self.frames:
            return "never wholly in the fixed view"
        if self.time_to_acquire_s is None or self.tpo_width_median is None or self.size_ratio_median is None:
            return f"never acquired in {self.frames} frames"
        shares = {"yield": self.closeup_yield, "centred": self.centred_yield}
        yields = "".join(f"{name} {share:.2f}, " for name, share in shares.items() if share is not None)
        return (
            f"acquired after {self.time_to_acquire_s:.2f} s, {yields}offset {self.tpo_width_median:.1%} of the width, "
            f"size ratio {self.size_ratio_median:.2f}"
        )


def score(rows: Sequence[Row]) -> Score:
    """Score one run that follows one target; the fields of `Score` hold the definitions."""
    start = _start(rows)
    if start is None:
        return Score(0, *[None] * 11)
    counted = rows[start:]
    acquired = _acquired(counted)
    after = counted[acquired:] if acquired is not None else []
    shown = [row.closeup for row in counted if not row.hidden]

    def median(values: Iterable[float]) -> float | None:
        finite = [v for v in values if math.isfinite(v)]
        return float(np.median(finite)) if finite else None

    return Score(
        frames=len(counted),
        time_to_acquire_s=after[0].t_s - counted[0].t_s if after else None,
        closeup_yield=float(np.mean([closeup.good for closeup in shown])) if shown else None,
        in_frame_ratio=float(np.mean([r.closeup.in_frame for r in after])) if after else None,
        tpo_px_median=median(r.closeup.tpo_px for r in after),
        tpo_width_median=median(r.closeup.tpo_px / r.width_px for r in after),
        tpo_deg_median=median(r.tpo_deg for r in after),
        size_ratio_median=median(r.closeup.size_ratio for r in after),
        wanted_px=median(r.wanted_px for r in counted),
        range_m=median(r.range_m for r in counted),
        tpe_px_median=median(r.tpe_px for r in counted),
        fragmentation_per_min=_per_minute(_breaks(after), after),
        identification=float(np.mean([r.decoded for r in counted])),
        identification_wide=float(np.mean([r.decoded_wide for r in counted])),
        commands_per_min=_per_minute(counted[-1].head_commands - counted[0].head_commands, counted),
        reversals_per_min=_per_minute(_reversals(counted), counted),
        false_tracks_per_min=_per_minute(false_tracks((r.t_s, r.off_target.split()) for r in counted), counted),
        lens_commands_per_min=_per_minute(counted[-1].lens_commands - counted[0].lens_commands, counted),
        id_switches_per_min=_per_minute(id_switches(map(_on, counted)), counted),
        centred_yield=float(np.mean([closeup.centred for closeup in shown])) if shown else None,
    )


def out_of_frame_s(rows: Sequence[Row]) -> float:
    """Sum up how long a target was out of frame after its acquisition while nothing hid it [s]; inf if never acquired.

    Args:
        rows: rows of one run.
    """
    start = _start(rows)
    acquired = None if start is None else _acquired(rows[start:])
    if start is None or acquired is None:
        return math.inf
    after = rows[start + acquired :]
    return sum(
        row.t_s - before.t_s for before, row in itertools.pairwise(after) if not (row.hidden or row.closeup.in_frame)
    )


def _start(rows: Sequence[Row]) -> int | None:
    """Index of the first row that counts; None if there is none."""
    learnt_s = rows[0].t_s + BACKGROUND_S - ROUNDING_S if rows else 0.0
    return next((i for i, row in enumerate(rows) if row.in_wide and row.t_s >= learnt_s), None)


def _acquired(rows: Sequence[Row]) -> int | None:
    """Index of the first row of the first half second in frame without a break."""
    begin: int | None = None
    for i, row in enumerate(rows):
        if not row.closeup.in_frame:
            begin = None
        else:
            begin = i if begin is None else begin
            if row.t_s - rows[begin].t_s >= ACQUIRED_S - ROUNDING_S:
                return begin
    return None


def _per_minute(count: int, rows: Sequence[Row]) -> float | None:
    """Events per minute, over the time from the first row to the last; None if that is zero."""
    return count / ((rows[-1].t_s - rows[0].t_s) / 60) if len(rows) > 1 else None


def _breaks(rows: Sequence[Row]) -> int:
    """Count the times for which the target was out of frame for more than 0.2 s."""
    breaks, since = 0, None
    for row in rows:
        if row.closeup.in_frame:
            breaks += since is not None and row.t_s - since > BREAK_S + ROUNDING_S
            since = None
        elif since is None:
            since = row.t_s
    return breaks + (since is not None and rows[-1].t_s - since > BREAK_S + ROUNDING_S)


def _reversals(rows: Sequence[Row]) -> int:
    """Count changes of direction of the commanded axes; pauses do not matter."""
    changes = np.diff([[row.pan_commanded_deg, row.tilt_commanded_deg] for row in rows], axis=0)
    return int(sum(np.count_nonzero(np.diff(np.sign(axis[axis != 0]))) for axis in changes.T))


def _on(row: Row) -> list[tuple[str, str]]:
    """Pairs of a track and a target that it is on, in a row."""
    return [(track, target) for track, target in (pair.split(":") for pair in row.on_target.split())]


def false_tracks(off: Iterable[tuple[float, Collection[Hashable]]]) -> int:
    """Count tracks that were reported and off every target for half a second without a break.

    Args:
        off: time of each frame [s], and the reported tracks that are off every target in it.
    """
    false: set[Hashable] = set()
    since: dict[Hashable, float] = {}
    for t, tracks in off:
        since = {track: since.get(track, t) for track in tracks}
        false |= {track for track, begin in since.items() if t - begin >= FALSE_S - ROUNDING_S}
    return len(false)


def id_switches(on: Iterable[Iterable[tuple[Hashable, str]]]) -> int:
    """Count how often a track leaves its target and is on another one.

    Args:
        on: pairs of track and target in each frame; a track on several targets has a pair for each, the nearest first.
    """
    switches = 0
    was_on: dict[Hashable, str] = {}
    for pairs in on:
        now: dict[Hashable, list[str]] = {}
        for track, target in pairs:
            now.setdefault(track, []).append(target)
        for track, targets in now.items():
            switches += was_on.get(track, targets[0]) not in targets
            if was_on.get(track) not in targets:
                was_on[track] = targets[0]
    return switches
