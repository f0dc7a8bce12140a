"""Scores, computed from rows alone: whoever has a steps.csv can recompute every figure.

A row says, for one zoom frame, what was commanded and what was really so. `cotarget.judging` makes rows from Steps and
the simulation's truth; the scores only read rows.
"""

import math
from collections.abc import Collection, Hashable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from cotarget.metrics.rows import Row

# Acquired: in frame for this long on end [s].
ACQUIRED_S = 0.5
# The clock starts when the target is wholly in the wide view, after the background had this long to be learnt, from
# the first row on [s].
BACKGROUND_S = 2.0
# In-frame runs broken for longer than this count as fragmentation [s].
BREAK_S = 0.2
# A track counts as false when it was confirmed and off every target for this long on end [s].
FALSE_S = 0.5
ROUNDING_S = 1e-6  # frame times are sums and differences of binary fractions


@dataclass(frozen=True)
class Score:
    """How well a target was held; None where it was never acquired, or never there.

    Wear, false tracks and ID switches are counted, like the yield, from when the target was wholly in the wide view.

    Attributes:
        frames: zoom frames since the target was wholly in the wide view.
        time_to_acquire_s: from then to the first half second in frame [s].
        closeup_yield: good close-ups over all those frames, acquisition included.
        in_frame_ratio: frames in frame over all frames after acquisition, the lost ones too.
        tpo_px_median: of the frames after acquisition [px].
        tpo_width_median: the same over the width of the image.
        tpo_deg_median: the same as an angle [degrees].
        size_ratio_median: of the frames after acquisition; one with the target behind the camera counts as 0.
        wanted_px: size wanted [px], median.
        range_m: true range [m], median.
        tpe_px_median: the detection's error in the wide view, of the frames that have one [px].
        fragmentation_per_min: in-frame runs broken for more than 0.2 s [1/min].
        identification: frames in which the marker decodes in the close-up, over all those that the yield counts. It is
            helped: the marker is looked for about the target's true box alone, in a part of the image that was enlarged
            twice, and a bird carries it on either flank, under its belly, and on its wings above and below.
        identification_wide: the same in the wide view, for comparison, and helped in the same ways.
        commands_per_min: commands that the head was sent, whether its goal changed or not [1/min].
        reversals_per_min: changes of direction of its goals from row to row, both axes together [1/min].
        false_tracks_per_min: tracks that were confirmed and off every target for 0.5 s on end [1/min].
        lens_commands_per_min: commands that the lens was sent [1/min].
        id_switches_per_min: how often a track was on another target than before, of all tracks (ID switches after Li,
            Huang and Nevatia 2009, "Learning to associate") [1/min]. One that is off every target after it was on one
            is a false track.
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


def score(rows: Sequence[Row]) -> Score:
    """Score one run of following one target; see the fields of `Score` for the definitions."""
    learnt_s = rows[0].t_s + BACKGROUND_S - ROUNDING_S if rows else 0.0
    start = next((i for i, row in enumerate(rows) if row.in_wide and row.t_s >= learnt_s), None)
    if start is None:
        return Score(0, *[None] * 11)
    counted = rows[start:]
    acquired = _acquired(counted)
    after = counted[acquired:] if acquired is not None else []

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
        commands_per_min=_per_minute(counted[-1].head_commands - counted[0].head_commands, counted),
        reversals_per_min=_per_minute(_reversals(counted), counted),
        false_tracks_per_min=_per_minute(false_tracks((r.t_s, r.off_target.split()) for r in counted), counted),
        lens_commands_per_min=_per_minute(counted[-1].lens_commands - counted[0].lens_commands, counted),
        id_switches_per_min=_per_minute(id_switches(map(_on, counted)), counted),
    )


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


def _reversals(rows: Sequence[Row]) -> int:
    """How often an axis's commanded changes turned round, pauses aside."""
    changes = np.diff([[row.pan_commanded_deg, row.tilt_commanded_deg] for row in rows], axis=0)
    return int(sum(np.count_nonzero(np.diff(np.sign(axis[axis != 0]))) for axis in changes.T))


def _on(row: Row) -> list[tuple[str, str]]:
    """Which track is on which target in a row."""
    return [(track, target) for track, target in (pair.split(":") for pair in row.on_target.split())]


def false_tracks(off: Iterable[tuple[float, Collection[Hashable]]]) -> int:
    """How many tracks were confirmed and off every target for half a second on end.

    Args:
        off: of each frame its time [s], and which tracks were.
    """
    false: set[Hashable] = set()
    since: dict[Hashable, float] = {}
    for t, tracks in off:
        since = {track: since.get(track, t) for track in tracks}
        false |= {track for track, begin in since.items() if t - begin >= FALSE_S - ROUNDING_S}
    return len(false)


def id_switches(on: Iterable[Iterable[tuple[Hashable, str]]]) -> int:
    """How often a track was on another target than before: on that no more, and on one.

    Args:
        on: of each frame which track was on which target; one on several is told with each, the nearest first.
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
