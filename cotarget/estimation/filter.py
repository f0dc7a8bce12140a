"""One target's filter in 3D: time-stamped measurements of both cameras, in any order, to an Estimate at any time."""

import bisect
import math
from dataclasses import replace

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import TargetConfig
from cotarget.estimation.correct import SizeSeen, WideSeen, ZoomSeen, begin, correct_wide, correct_zoom
from cotarget.estimation.estimate import Estimate
from cotarget.estimation.motion import propagate
from cotarget.estimation.node import Node, sound
from cotarget.estimation.settings import EstimationSettings, estimation_settings_for
from cotarget.estimation.sight import Sights
from cotarget.geometry import Array
from cotarget.tracking import Measurement


class SpatialFilter:
    """Where one target is in 3D and how fast it moves, how large it is, and by how much the head points wrongly.

    Measurements may come in any order, because each says when its light fell. Those of the last second or so are kept,
    and a late one is taken into account by going over all that came after it once more: the result is the same as if
    all had come in order.
    """

    def __init__(
        self, calibration: Calibration, target: TargetConfig, settings: EstimationSettings | None = None
    ) -> None:
        """Begin without a measurement.

        Args:
            calibration: of the rig, for the streams in use.
            target: its told size, and which dimension that is.
            settings: how it moves and is measured; by default those of its kind.

        Raises:
            CalibrationError: the calibration has no T.
        """
        self._calibration = calibration
        self._target = target
        self._settings = settings or estimation_settings_for(target, calibration)
        self._sights = Sights(calibration)
        self._base: Node | None = None  # the state before the first measurement kept
        self._seen: list[WideSeen | ZoomSeen] = []
        self._nodes: list[Node | None] = []  # the state after each of them, as far as gone over

    def see_wide(
        self, detection: Measurement, t: float, *, sigma_px: Array | None = None, size_px: float | None = None
    ) -> bool:
        """Take a detection in the wide view into account.

        Args:
            detection: its box; one that is clipped tells of its size only that it is no smaller.
            t: when the frame's light fell [s].
            sigma_px: standard deviation of the middle, (2,) [px]; by default from the settings and the box's size,
                and half a clipped box more, whose hidden part may be as large again.
            size_px: the known dimension in the image [px], where it is better known than from this box alone, as
                the largest over a wing beat.

        Returns:
            Whether it could be taken: not when it is older than all that is kept, or has been taken already, or no ray
            leads to its pixel.
        """
        found = self._calibration.fixed.tangents(detection.center_px)
        if found is None:
            return False
        z, J = found
        settings = self._settings
        width, height = (float(side) for side in detection.size_px)
        if sigma_px is not None:
            sigma_u, sigma_v = (float(sigma) for sigma in sigma_px)
        else:
            part = math.hypot(settings.noise_of_size, 0.5 if detection.clipped else 0.0)
            sigma_u, sigma_v = math.hypot(settings.noise_px, part * width), math.hypot(settings.noise_px, part * height)
        vertical = self._vertical(width, height)
        side = height if vertical else width
        if size_px is not None and not detection.clipped:
            side = size_px
        size = self._size(side, J[int(vertical), int(vertical)], bound=detection.clipped)
        return self._insert(WideSeen(t, z, (J * np.array([sigma_u**2, sigma_v**2])) @ J.T, size))

    def see_zoom(
        self,
        pixel: Array,
        sigma_px: float | Array,
        pan: float,
        tilt: float,
        nominal_px: float,
        t: float,
        *,
        head_sigma: float | None = None,
    ) -> bool:
        """Take what the zoom camera sees of the target into account.

        Args:
            pixel: middle of the target in the zoom image, (2,) [px].
            sigma_px: its standard deviation, one for u and v or one for each, (2,) [px].
            pan: what the head reported for the time of this frame [rad].
            tilt: likewise.
            nominal_px: what the lens reported for that time [px].
            t: when the frame's light fell [s].
            head_sigma: standard deviation of what the head reports [rad]; larger while it moves and its time is
                known badly. By default from the settings.

        Returns:
            Whether it could be taken, see `see_wide`.
        """
        lens = self._calibration.zoom.at(nominal_px)
        found = lens.tangents(pixel)
        if found is None:
            return False
        z, J = found
        sigma = self._settings.head_sigma if head_sigma is None else head_sigma
        R = (J * np.square(sigma_px)) @ J.T + np.eye(2) * sigma**2
        return self._insert(ZoomSeen(t, z, R, self._sights.at(pan, tilt, nominal_px)))

    def at(self, t: float) -> Estimate | None:
        """The estimate for a time [s], later than the newest measurement or up to a second or so before it.

        Returns:
            None before the first detection in the wide view, or longer ago than measurements are kept.
        """
        node = self._before(t)
        if node is None:
            return None
        x, P = self._propagate(node, t)
        motion = self._settings.motion
        return Estimate(
            t=t,
            measured_t=node.t,
            state=x,
            state_covariance=P,
            carried=motion.jump.by_hand_s is not None and node.jumped(motion.jump),
            size_prior=motion.size_sigma,
            bias_prior=motion.bias_sigma,
            target=self._target,
            calibration=self._calibration,
            sights=self._sights,
        )

    def knows(self, t: float) -> bool:
        """Whether there is an estimate for a time [s]."""
        return self._before(t) is not None

    def _propagate(self, node: Node, t: float) -> tuple[Array, Array]:
        """Predict state and covariance at a time that is no earlier [s]."""
        settings = self._settings
        motion = settings.jump_motion if node.jumped(settings.motion.jump) else settings.motion
        return propagate(node.x, node.P, t - node.t, motion, node.boost)

    def _before(self, t: float) -> Node | None:
        """The newest state that is no later than a time [s]."""
        self._run()
        node = next((node for node in reversed(self._nodes) if node is not None and node.t <= t), self._base)
        return None if node is None or node.t > t else node

    def _vertical(self, width: float, height: float) -> bool:
        """Whether the known dimension is the box's height."""
        dimension = self._target.dimension
        return dimension == "height" or (dimension == "wingspan" and height > width)

    def _size(self, size_px: float, tangent_per_px: float, *, bound: bool) -> SizeSeen | None:
        """What a size in the image [px] tells, or a part of it."""
        if not size_px > 0:
            return None
        settings = self._settings
        sigma = math.hypot(settings.size_noise, settings.size_noise_px / size_px)
        return SizeSeen(math.log(self._target.size / (size_px * abs(tangent_per_px))), sigma, bound)

    def _insert(self, seen: WideSeen | ZoomSeen) -> bool:
        """Put a measurement where its time belongs; what came after it will be gone over again."""
        if not math.isfinite(seen.t) or (self._base is not None and seen.t < self._base.t):
            return False
        at = bisect.bisect_left(self._seen, seen.key, key=lambda each: each.key)
        if at < len(self._seen) and self._seen[at].key == seen.key:  # a frame that is repeated tells nothing new
            return False
        self._seen.insert(at, seen)
        del self._nodes[at:]
        return True

    def _run(self) -> None:
        """Go over the measurements not gone over yet, and forget the oldest."""
        for seen in self._seen[len(self._nodes) :]:
            before = self._nodes[-1] if self._nodes else self._base
            self._nodes.append(self._step(before, seen))
        while len(self._seen) > 1 and self._seen[0].t < self._seen[-1].t - self._settings.history_s:
            self._base = self._nodes.pop(0)
            self._seen.pop(0)

    def _step(self, node: Node | None, seen: WideSeen | ZoomSeen) -> Node | None:
        """The state after one more measurement."""
        settings = self._settings
        nearest = settings.motion.nearest
        if node is None:
            return sound(begin(seen, settings), nearest) if isinstance(seen, WideSeen) else None
        x, P = self._propagate(node, seen.t)
        node = replace(node, t=seen.t, x=x, P=P)
        if isinstance(seen, WideSeen):
            corrected = correct_wide(node, seen, settings)
        else:
            corrected = correct_zoom(node, seen, settings)
        # What makes no sense of it is as good as not measured.
        return sound(corrected, nearest) or sound(node, nearest)
