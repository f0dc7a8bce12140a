"""One track for each of many rigs: the image filter and life cycle of `cotarget.tracking`, without association.

There is one target and no clutter, so that every detection belongs to the track. Different from the tracker are: the
place and size of a detection are not gated, a track is not confirmed by its travel, and while a target comes into view
its velocity is unknown.
"""

import math

import numpy as np
import numpy.typing as npt

from cotarget.geometry import Array
from cotarget.tracking.track import BEAT_PART, BEAT_S, CUT, PIECE, TrackingSettings

Flags = npt.NDArray[np.bool_]
FEWEST_OLDER = 3  # boxes with which newer ones are compared for a trend of the size


class Tracks:
    """Tracks of n rigs.

    Attributes:
        center_px: filtered centres [px], (2, n).
        velocity_px: their velocities [px/s], (2, n).
        confirmed: whether there is a confirmed track, (n,).
        unseen_s: time since its last detection [s], (n,).
    """

    def __init__(
        self, count: int, settings: TrackingSettings, size: tuple[int, int], interval: float, *, over_beat: bool
    ) -> None:
        """Start without tracks.

        Args:
            count: number of rigs.
            settings: settings of the tracker, scaled to the image's width.
            size: (width, height) of the image [px].
            interval: time between frames [s].
            over_beat: whether sizes are the largest of the larger sides over a wing beat, and no medians.
        """
        self._settings, self._interval, self._over_beat = settings, interval, over_beat
        self._extent = np.array(size, dtype=float)[:, None]
        self._weight = 1 - math.exp(-interval / settings.score_s)
        self.center_px, self.velocity_px = np.zeros((2, count)), np.zeros((2, count))
        self._P = np.zeros((3, 2, count))  # variance, covariance and variance of the velocity
        self.confirmed, self._there = np.zeros(count, bool), np.zeros(count, bool)
        self.unseen_s, self._age_s = np.zeros(count), np.zeros(count)
        self._hits, self._score = np.zeros(count), np.zeros(count)
        self._whole = np.zeros(count, bool)  # whether any box was not clipped
        window_s = BEAT_S if over_beat else settings.size_s
        # Sides of the last boxes; infinite where there is none, so that it sorts last. One row for the larger side.
        self._sides = np.full((math.floor(window_s / interval + 1e-6) + 1, 1 if over_beat else 2, count), np.inf)
        self._oldest = 0
        self._usual = np.zeros((2, count))  # width and height of the newest whole box

    def end(self, which: Flags) -> None:
        """End the tracks of some rigs."""
        self._there &= ~which
        self.confirmed &= ~which
        self._sides[..., which] = np.inf
        self._usual[:, which] = 0.0

    def update(self, center: Array, size: Array, clipped: Flags, detected: Flags) -> None:
        """Predict all tracks to the next frame, and correct those that have a detection.

        Args:
            center: centres of the boxes [px], (2, n).
            size: widths and heights of the boxes [px], (2, n).
            clipped: whether the image's border cuts each, (n,).
            detected: whether there is each, (n,).
        """
        settings, dt = self._settings, self._interval
        noise = settings.process_noise
        position, cross, velocity = self._P
        self.center_px += dt * self.velocity_px
        position = position + dt * (2 * cross + dt * velocity) + noise * dt**3 / 3
        cross = cross + dt * velocity + noise * dt * dt / 2
        velocity = velocity + noise * dt
        lacks = np.where(size < PIECE * self._usual, self._usual - size, 0.0)
        spread = np.where(clipped, CUT, settings.noise_of_size) * size
        variance = settings.noise_px**2 + spread * spread + lacks * lacks / 4
        begins = detected & ~(self._there & self._whole)  # it goes on to begin until a whole box is seen
        gain = np.where(detected, 1 / (position + variance), 0.0)
        off = center - self.center_px
        K, K_velocity = position * gain, cross * gain
        speed = np.maximum(settings.speed_px, settings.speed_sides * size.max(axis=0)) ** 2
        self._P = np.stack([
            np.where(begins, variance, position - K * position),
            np.where(begins, 0.0, cross - K * cross),
            np.where(begins, speed, velocity - K_velocity * cross),
        ])  # fmt: skip
        self.center_px = np.where(begins, center, self.center_px + K * off)
        self.velocity_px = np.where(begins, 0.0, self.velocity_px + K_velocity * off)
        self._live(detected, clipped)
        self._add_sides(size, detected & (~clipped | ~self._whole))

    def _live(self, detected: Flags, clipped: Flags) -> None:
        """Begin, confirm and end tracks."""
        settings, dt = self._settings, self._interval
        new = detected & ~self._there
        self._age_s = np.where(new, 0.0, self._age_s + dt)
        self.unseen_s = np.where(detected, 0.0, self.unseen_s + dt)
        self._hits = np.where(new, 0.0, self._hits) + detected
        self._score = np.where(new, 0.0, self._score + self._weight * (detected - detected * self._score))
        self._whole = np.where(new, ~clipped, self._whole | (detected & ~clipped))
        self._there |= detected
        self.confirmed |= (self._hits >= settings.confirm_hits) & (self._score >= settings.confirm_score)
        self.confirmed &= self._there
        longest = np.where(self.confirmed, np.minimum(settings.lose_s, self._age_s - self.unseen_s), settings.drop_s)
        outside = ((self.center_px < -0.5) | (self.center_px > self._extent - 0.5)).any(axis=0)
        self.end(self._there & ~detected & (outside | (self.unseen_s > longest + 1e-9)))

    def _add_sides(self, size: Array, which: Flags) -> None:
        """Add boxes to the histories of sizes."""
        self._sides[self._oldest] = np.where(which, size.max(axis=0) if self._over_beat else size, np.inf)
        self._oldest = (self._oldest + 1) % len(self._sides)
        self._usual = np.where(which, size, self._usual)

    def size_px(self) -> Array:
        """Usual width and height [px], (2, n), or the larger side over a wing beat, (1, n); 0 without a box."""
        if self._over_beat:
            return _quantile(self._sides, BEAT_PART)
        found = _quantile(self._sides, 0.5)
        if not self._settings.trend:
            return found
        # A target that grows or shrinks has the size of the newest third, see `cotarget.tracking.track`.
        rows = np.roll(self._sides, -self._oldest, axis=0)
        half, third = len(rows) // 2, len(rows) // 3
        older, newer = rows[:half], _quantile(rows[half:], 0.5)
        there = np.isfinite(older)
        grows = (newer > np.where(there, older, -np.inf).max(axis=0)).all(axis=0)
        shrinks = (newer < older.min(axis=0)).all(axis=0)
        changes = (grows | shrinks) & (there[:, 0].sum(axis=0) >= FEWEST_OLDER)
        return np.where(changes, _quantile(rows[-third:], 0.5), found) if changes.any() else found


def _quantile(rows: Array, part: float) -> Array:
    """Quantile along the first axis with linear interpolation, of what is finite; 0 where nothing is."""
    ordered = np.sort(rows, axis=0)
    last = np.maximum(np.isfinite(ordered).sum(axis=0) - 1, 0)
    place = part * last
    low = place.astype(int)
    high = np.minimum(low + 1, last)
    a, b = (np.take_along_axis(ordered, each[None], axis=0)[0] for each in (low, high))
    with np.errstate(invalid="ignore"):
        found = a + (place - low) * (b - a)
    return np.where(np.isfinite(a), found, 0.0)
