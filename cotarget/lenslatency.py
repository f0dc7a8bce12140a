"""Measures how late the zoom lens obeys, by how the zoom camera's picture grows: from a command to where that begins.

The lens is sent in and out a few times. From frame to frame the scale is told by corners that are followed (Lucas and
Kanade) and a similarity through them; the first part of each way, back to where the picture had its old scale, tells
when the lens set out.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from cotarget.calibration.standing import LENS_TIMEOUT, POLL, wait_for_lens
from cotarget.errors import CalibrationError, StaleFrameError
from cotarget.geometry import Array
from cotarget.rig import Frame, Image, Rig

GROWTH = 2.0  # how far the lens zooms in, or as far as it can; less than LEAST_GROWTH tells nothing
LEAST_GROWTH = 1.1
WAYS = 6  # in and out
BEFORE_S, AFTER_S = 0.5, 0.5  # frames are kept from so long before a command to so long after the lens stands [s]
# Of a way in the logarithm of the scale, the part that tells where it began: beyond what the corners' noise makes, and
# before most of it, because no lens goes evenly all the way.
FIRST, LAST = 0.08, 0.5
# The whole way must be what the device says it is, as a part of that; otherwise something else made the picture grow.
AS_TOLD = 0.25
CORNERS, WEAKEST, APART_PX = 200, 0.01, 8
FEWEST_CORNERS = 12  # with fewer no scale is told


@dataclass(frozen=True)
class LensLatency:
    """What zooming in and out tells.

    Attributes:
        command: from a command to the start of the lens's motion, the median over all [s].
        spread: half the interquartile range of these [s].
        frames: of the zoom camera.
    """

    command: float
    spread: float
    frames: int


def measure_lens(rig: Rig, late_s: float = 0.0) -> LensLatency:
    """Zoom in and out a few times, and watch the picture grow and shrink.

    Args:
        rig: its head is left where it is.
        late_s: by how much the zoom camera's frames are dated too late, as `cotarget.latency.measure_head` tells [s].

    Raises:
        CalibrationError: the lens hardly zooms or does not come to rest, or the picture does not grow as the lens says.
        StaleFrameError: frames stopped coming.
    """
    shortest, longest = rig.zoom.focal_range
    goal = min(GROWTH * shortest, longest)
    if goal < LEAST_GROWTH * shortest:
        raise CalibrationError(f"the lens zooms by {longest / shortest:.3g} times at most, too little to see when")
    rig.zoom.zoom(shortest)
    before = wait_for_lens(rig).focal_px
    delays: list[float] = []
    count = 0
    for way in range(WAYS):
        frames = _frames(rig, rig.clock.now() + BEFORE_S)
        t = rig.clock.now()
        after = rig.zoom.zoom(shortest if way % 2 else goal)
        frames += _moving_frames(rig, frames)
        count += len(frames)
        grown = scales([frame.image for frame in frames])
        told = math.log(after / before)
        if not abs(grown[-1] - told) <= AS_TOLD * abs(told):
            seen = "shows too little" if math.isnan(grown[-1]) else f"grows {math.exp(grown[-1]):.2f} times"
            raise CalibrationError(
                f"the zoom camera's picture {seen} where the lens tells of {after / before:.2f} times; point it at "
                "something with structure that stands still, all over the picture"
            )
        times = np.array([frame.t for frame in frames]) - late_s
        delays.append(began(times, grown / grown[-1]) - t)
        before = after
    low, middle, high = np.percentile(delays, (25, 50, 75)).tolist()
    return LensLatency(middle, (high - low) / 2, count)


def began(times: Array, part: Array) -> float:
    """When a way began, of which the first part goes evenly [s].

    Args:
        times: of frames, increasing [s], (n,).
        part: of the way that is done in each, from 0 to 1, (n,).
    """
    moving = int(np.argmax(part >= LAST))
    standing = int(np.flatnonzero(part[:moving] < FIRST)[-1]) if moving and (part[:moving] < FIRST).any() else 0
    inside = slice(standing + 1, moving + 1)
    if moving - standing < 2:  # it jumps from one frame to the next
        return float((times[standing] + times[moving]) / 2)
    slope, offset = np.polyfit(part[inside], times[inside], 1)
    return float(np.clip(offset, times[standing] - slope * FIRST, times[standing + 1]))


def scales(images: Sequence[Image]) -> Array:
    """Logarithm of how many times larger each picture is than the first one, (n,); nan from where that is not told."""
    found = [0.0]
    greys = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]
    for one, other in itertools.pairwise(greys):
        found.append(found[-1] + _scale(one, other))
    return np.array(found)


def _scale(before: Image, after: Image) -> float:
    """The same of two that follow each other."""
    corners = cv2.goodFeaturesToTrack(before, CORNERS, WEAKEST, APART_PX)
    if corners is None or len(corners) < FEWEST_CORNERS:
        return math.nan
    moved, seen, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)
    kept = seen.ravel() > 0
    if np.count_nonzero(kept) < FEWEST_CORNERS:
        return math.nan
    similarity, _ = cv2.estimateAffinePartial2D(corners[kept], moved[kept])
    return math.nan if similarity is None else math.log(math.hypot(similarity[0, 0], similarity[1, 0]))


def _frames(rig: Rig, until: float) -> list[Frame]:
    """The zoom camera's frames until a time [s]."""
    frames: list[Frame] = []
    while rig.clock.now() < until:
        frames.append(rig.zoom.read(newer_than=frames[-1].t if frames else None))
    return frames


def _moving_frames(rig: Rig, before: Sequence[Frame]) -> list[Frame]:
    """The frames that follow until the lens has stood for a while."""
    frames, clock = list(before[-1:]), rig.clock
    deadline, rests = clock.now() + LENS_TIMEOUT, math.inf
    while clock.now() < rests:
        try:
            frames.append(rig.zoom.read(newer_than=frames[-1].t))
        except StaleFrameError:
            if clock.now() > deadline:
                raise
            clock.sleep_until(clock.now() + POLL)
        if rig.zoom.state().moving:
            rests = math.inf
        elif rests == math.inf:
            rests = clock.now() + AFTER_S
        if clock.now() > deadline:
            raise CalibrationError(f"the zoom lens still moves after {LENS_TIMEOUT:g} s")
    return frames[1:]
