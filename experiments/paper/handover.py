"""Figures of handovers: which of several targets is followed at each moment, by ground truth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cotarget.metrics import Closeup

FOLLOWED_S = 1.0  # a target counts if it was followed for this long [s]


@dataclass(frozen=True)
class Moment:
    """Ground truth of one Step.

    Attributes:
        t: time of the zoom frame [s].
        followed: target of the followed track; None where the track is on no target, or there is no track.
        is_following: whether a track is followed.
        present: targets of which at least half is in the fixed view.
        tpe_px: error of the followed target's detection in the fixed view; nan where it is not detected alone [px].
        closeup: the followed target in the zoom view.
    """

    t: float
    followed: str | None
    is_following: bool
    present: frozenset[str]
    tpe_px: float = math.nan
    closeup: Closeup | None = None


def figures(moments: Sequence[Moment]) -> dict[str, float | int | None]:
    """Compute the figures of a run; None where there is nothing to measure."""
    t = np.array([each.t for each in moments])
    took = np.diff(t, append=t[-1])
    names = [each.followed for each in moments]
    seconds = {name: float(sum(d for d, each in zip(took, names, strict=True) if each == name)) for name in set(names)}
    closeups = [each.closeup for each in moments if each.closeup is not None]
    # Where the followed track is on no target, no target is in frame.
    in_frame = [each.closeup is not None and each.closeup.in_frame for each in moments if each.is_following]
    handovers = [(old, new) for old, new in turns(names) if old is not None]
    gaps = [gap for old, new in handovers if (gap := _gap(moments, names, old, new)) is not None]
    lost = sum(d for d, each in zip(took, moments, strict=True) if each.is_following and each.followed is None)
    return {
        "followed": sum(seconds[name] >= FOLLOWED_S for name in seconds if name is not None),
        "tpe_px": _median(each.tpe_px for each in moments),
        "tpo_px": _median(each.tpo_px for each in closeups),
        "tpo_percent": _median(100 * each.tpo_px / each.width_px for each in closeups),
        "size_ratio": _median(each.size_ratio for each in closeups),
        "in_frame": float(np.mean(in_frame)) if in_frame else None,
        "handover_s": _median(gaps),
        "too_early": sum(names[old] in moments[new].present for old, new in handovers),
        "off_target_s": float(lost),
    }


def turns(names: Sequence[str | None]) -> list[tuple[int | None, int]]:
    """Find the handovers: last moment of the earlier target, and first moment of the next."""
    found: list[tuple[int | None, int]] = []
    last: int | None = None
    for i, name in enumerate(names):
        if name is None:
            continue
        if last is None or names[last] != name:
            found.append((last, i))
        last = i
    return found


def _gap(moments: Sequence[Moment], names: Sequence[str | None], old: int, new: int) -> float | None:
    """Give the time from the first target's leaving the fixed view to the second's being in frame [s].

    None if either is missing.
    """
    name = names[old]
    there = [i for i, each in enumerate(moments[:new]) if name in each.present]
    came = next(
        (i for i in range(new, len(moments)) if names[i] == names[new] and (c := moments[i].closeup) and c.in_frame),
        None,
    )
    return None if came is None or not there else max(0.0, moments[came].t - moments[there[-1]].t)


def _median(values: Any) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else None
