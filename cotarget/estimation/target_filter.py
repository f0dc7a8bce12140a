"""Estimate one target's 3D state from both cameras with an iterated extended Kalman filter.

Measurements carry the time of their exposure and may arrive in any order: a late one is inserted at its time, and the
corrections after it are repeated. The state is that of `cotarget.estimation.motion_model`. A centre in either image and
an apparent size are corrected one after the other, each with a gate.

A pan bias and a wrong depth look alike along the baseline. Pointing needs only their sum, which is measured; the depth
by itself is as good as the calibration. Gates and inflations: docs/design-notes.md.
"""

import bisect
import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import TargetProfile
from cotarget.estimation.measurement_model import Estimate, SightLine, SightLines, rate
from cotarget.estimation.motion_model import (
    ACC_Z,
    ACCELERATION,
    CENTER_GATE,
    GATE,
    HEAD_SIGMA,
    LOG_APPARENT,
    LOG_DEPTH,
    LOG_SIZE,
    MOTION,
    OF_SIZE,
    PAN,
    SEEN,
    STATES,
    TAN_X,
    TAN_Y,
    TILT,
    USUAL_DEPTH,
    VEL_X,
    VEL_Y,
    VEL_Z,
    FilterSettings,
    filter_settings,
    propagate,
)
from cotarget.geometry import Array
from cotarget.rig import Detection
from cotarget.rig_geometry import FixedCamera


@dataclass(frozen=True)
class Node:
    """State of the filter at one time.

    Attributes:
        t: time [s].
        x: state, see `cotarget.estimation.motion_model`, (13,).
        P: covariance of the state, (13, 13).
        mean_nis: running mean of the normalised innovation squared per dimension, of centres in both images.
        rejected_fixed: centres in the fixed image rejected in a row.
        rejected_zoom: centres in the zoom image rejected in a row.
        rejected_size: sizes rejected in a row.
        size_t: time of the last size in the fixed image [s].
        zoom_size_t: time of the last size in the zoom image, accepted or not [s].
        fixed_t: time of the last correction by a centre in the fixed image [s]; a start or restart is no correction.
    """

    t: float
    x: Array
    P: Array
    mean_nis: float = 1.0
    rejected_fixed: int = 0
    rejected_zoom: int = 0
    rejected_size: int = 0
    size_t: float = -math.inf
    zoom_size_t: float = -math.inf
    fixed_t: float = -math.inf


def sound(node: Node, nearest: float) -> Node | None:
    """Bound the depth and symmetrise the covariance of a node; None if it is not finite or not positive.

    Args:
        node: node after a measurement.
        nearest: least depth of a target [m].
    """
    x, P = node.x.copy(), (node.P + node.P.T) / 2
    if not (np.isfinite(x).all() and np.isfinite(P).all() and (P.diagonal() > 0).all()):
        return None
    x[LOG_DEPTH] = max(x[LOG_DEPTH], math.log(nearest))
    return replace(node, x=x, P=P)


# Time for which a size in the zoom image replaces those of the fixed image: a slow wing beat [s].
ZOOM_SIZE_S = 0.5
# An iterated correction ends when the logarithm of the depth changes by less, or after so many iterations.
CONVERGED, MOST_ITERATIONS = 1e-3, 4


@dataclass(frozen=True)
class Observation:
    """Centre of the target in one camera's image, and its apparent size in the fixed camera's.

    Attributes:
        t: exposure time [s].
        tangent: tangents of the centre in the camera's frame, (2,).
        R: their covariance, (2, 2).
        sight: sight line of the zoom camera; None for an observation in the fixed image.
        log_depth: apparent size, as the logarithm of the depth at which a target of nominal size looks that large; None
            where no size was observed.
        log_depth_sigma: standard deviation of that logarithm.
        bound: whether it is an upper bound only: a clipped target is at least that large, so at most that far.
        time_sigma_s: standard deviation of its time against the fixed camera's [s].
    """

    t: float
    tangent: Array
    R: Array
    sight: SightLine | None = None
    log_depth: float | None = None
    log_depth_sigma: float = math.inf
    bound: bool = False
    time_sigma_s: float = 0.0

    @property
    def order(self) -> tuple[float, bool]:
        """Sort key: the time, and the fixed camera before the zoom camera."""
        return self.t, self.sight is not None


def begin(observed: Observation, settings: FilterSettings) -> Node:
    """Initialise the state from the first measurement.

    `fixed_t` stays unset, so that the second measurement counts fully: an error that both share does not change the
    velocity between them.
    """
    motion = settings.motion
    x = np.zeros(STATES)
    x[:2] = observed.tangent
    x[LOG_APPARENT] = motion.attitude_mean
    x[LOG_DEPTH] = math.log(USUAL_DEPTH)
    if observed.log_depth is not None and not observed.bound:
        x[LOG_DEPTH] = observed.log_depth + x[LOG_APPARENT]
    sigma = np.zeros(STATES)
    sigma[LOG_DEPTH] = settings.depth_sigma
    sigma[[LOG_SIZE, LOG_APPARENT]] = motion.size_sigma, motion.attitude_sigma
    sigma[[PAN, TILT]] = motion.bias_sigma
    P = np.diag(sigma**2)
    P[:2, :2] = observed.R
    P[MOTION, MOTION] = motion.prior(math.exp(x[LOG_DEPTH]))
    return _correct_size(Node(observed.t, x, P), observed, settings)


def correct_fixed(node: Node, observed: Observation, settings: FilterSettings) -> Node:
    """Correct a node with a centre and a size in the fixed image."""
    if observed.log_depth is None or observed.bound:
        node = _with_fading_velocity(node, settings)
    PHt = node.P[:, :2]
    innovation = observed.tangent - node.x[:2]
    R = observed.R * variance_factor(node.t - node.fixed_t, settings.noise_s)
    S_inv = _inverse(PHt[:2] + R)
    nis = float(innovation @ S_inv @ innovation)
    if nis > settings.jump_gate:
        if node.rejected_fixed + 1 < settings.misses:
            return replace(node, rejected_fixed=node.rejected_fixed + 1, rejected_zoom=0)
        return _correct_size(_restarted(node, observed, settings), observed, settings)
    if nis > CENTER_GATE:  # worse than its noise says: it counts as much as one at the gate
        S_inv = _inverse(PHt[:2] + R * (nis / CENTER_GATE))
        nis = float(innovation @ S_inv @ innovation)
    gain = PHt @ S_inv
    node = replace(
        node,
        x=node.x + gain @ innovation,
        P=node.P - gain @ PHt.T,
        mean_nis=_mean_nis(node, nis, settings),
        rejected_fixed=0,
        fixed_t=node.t,
    )
    return _correct_size(node, observed, settings)


def correct_zoom(node: Node, observed: Observation, sight: SightLine, settings: FilterSettings) -> Node:
    """Correct the 3D state by the target's offset in the zoom image, iterated because the depth enters nonlinearly."""
    if node.rejected_zoom >= settings.zoom_misses:
        node = replace(node, P=inflated(node.P, settings), rejected_zoom=0)
    x, nis = node.x, 0.0
    for i in range(MOST_ITERATIONS):
        tangent, J, d = sight.project(x)
        innovation = observed.tangent - tangent + J @ (x - node.x)[SEEN]
        PHt = node.P[:, SEEN] @ J.T
        late = J[:, :3] @ rate(x) * observed.time_sigma_s
        S_inv = _inverse(J @ PHt[SEEN] + observed.R + np.outer(late, late))
        if i == 0:
            nis = float(innovation @ S_inv @ innovation)
        if d[2] <= 0 or nis > CENTER_GATE:
            # Where the fixed image contradicts the state too, the target has moved, and neither size nor head is wrong.
            return replace(node, rejected_zoom=node.rejected_zoom + (node.rejected_fixed == 0))
        gain = PHt @ S_inv
        before, x = x[LOG_DEPTH], node.x + gain @ innovation
        if abs(x[LOG_DEPTH] - before) < CONVERGED:
            break
    mean_nis = _mean_nis(node, nis, settings)
    node = replace(node, x=x, P=node.P - gain @ PHt.T, mean_nis=mean_nis, rejected_zoom=0)
    if observed.log_depth is None:
        return node
    # It is the depth in the zoom camera's frame; d[2] is that over the depth in the fixed camera's.
    observed = replace(observed, log_depth=observed.log_depth - math.log(d[2]))
    return replace(_correct_size(node, observed, settings), zoom_size_t=node.t)


def _correct_size(node: Node, observed: Observation, settings: FilterSettings) -> Node:
    """Correct a node with an apparent size, see `OF_SIZE`."""
    if observed.log_depth is None:
        return node
    last_t = node.size_t
    if observed.sight is not None:
        last_t = node.zoom_size_t
    elif node.t - node.zoom_size_t < ZOOM_SIZE_S and not observed.bound:  # the zoom camera shows it better
        return node
    P, h = node.P, OF_SIZE
    # Limbs and wings move the box's sides together for a while, so sizes in quick succession share their error.
    variance = observed.log_depth_sigma**2 * variance_factor(node.t - last_t, settings.size_s)
    Ph = P @ h
    S = float(h @ Ph) + variance
    innovation = observed.log_depth - float(h @ node.x)
    if observed.bound and innovation >= 0:  # the state is nearer than the bound already
        return node
    if innovation * innovation > GATE * S:
        if node.rejected_size + 1 < settings.misses:
            return replace(node, rejected_size=node.rejected_size + 1)
        # The target has turned or come nearer unexpectedly: inflate depth and attitude.
        P = P.copy()
        P[[LOG_DEPTH, LOG_APPARENT], [LOG_DEPTH, LOG_APPARENT]] += settings.inflation**2
        Ph = P @ h
        S = float(h @ Ph) + variance
    x = node.x + Ph * (innovation / S)
    P = P - np.outer(Ph, Ph / S)
    is_last = observed.sight is None and not observed.bound
    return replace(node, x=x, P=P, rejected_size=0, size_t=node.t if is_last else node.size_t)


def _with_fading_velocity(node: Node, settings: FilterSettings) -> Node:
    """Let the velocity along the axis fade while no size measures it."""
    if math.isinf(node.size_t):
        return node
    motion = settings.motion
    rho = math.exp(-(node.t - node.fixed_t) / settings.unsized_s)
    usual = np.array([motion.speed, motion.acceleration]) * math.exp(-node.x[LOG_DEPTH])
    x, P = node.x.copy(), node.P.copy()
    along = [VEL_Z, ACC_Z]
    x[along] *= rho
    P[along] *= rho
    P[:, along] *= rho
    P[along, along] += (1 - rho**2) * usual**2
    return replace(node, x=x, P=P)


def _mean_nis(node: Node, nis: float, settings: FilterSettings) -> float:
    """Update the mean NIS with that of a centre, which has two dimensions."""
    return node.mean_nis + settings.nis_gain * (nis / 2 - node.mean_nis)


def _restarted(node: Node, observed: Observation, settings: FilterSettings) -> Node:
    """Restart position and motion at the measured place after a jump; size and head bias stay."""
    motion = settings.motion
    x, P = node.x.copy(), node.P.copy()
    x[:2] = observed.tangent
    x[ACCELERATION] = 0.0  # the velocity stays the best guess: a target that is carried off is soon farther off
    restarted = [TAN_X, TAN_Y, *range(VEL_X, LOG_SIZE)]
    P[restarted] = 0.0
    P[:, restarted] = 0.0
    P[:2, :2] = observed.R
    P[LOG_DEPTH, LOG_DEPTH] += settings.inflation**2
    P[MOTION, MOTION] = motion.prior(math.exp(x[LOG_DEPTH]))
    # It is faster than was expected, except along the axis, where only sizes measure, and badly.
    faster = math.sqrt(settings.most_noise_scale)
    P[[VEL_X, VEL_Y]] *= faster
    P[:, [VEL_X, VEL_Y]] *= faster
    return replace(node, x=x, P=P, rejected_fixed=0, rejected_zoom=0, mean_nis=1.0)


def inflated(P: Array, settings: FilterSettings) -> Array:
    """Inflate size, depth and head bias after zoom images that contradict them."""
    P = P.copy()
    # Size and depth are inflated together, because the fixed image keeps their ratio known.
    P[np.ix_([LOG_DEPTH, LOG_SIZE], [LOG_DEPTH, LOG_SIZE])] += settings.inflation**2
    P[[PAN, TILT], [PAN, TILT]] += settings.bias_inflation**2
    return P


def variance_factor(interval: float, correlation_s: float) -> float:
    """Factor on a variance whose error lasts correlation_s [s], for measurements an interval > 0 apart [s]."""
    return max(1.0, 2 * correlation_s / interval)


def _inverse(S: Array) -> Array:
    """Invert a 2x2 matrix; numpy takes five times as long."""
    (a, b), (c, d) = S.tolist()
    det = a * d - b * c
    return np.array([[d / det, -b / det], [-c / det, a / det]])


class TargetFilter:
    """Iterated extended Kalman filter of one target: position, velocity, size, and the head's pointing bias.

    Measurements may come in any order. Those of the last `history_s` are kept; a late one is inserted at its time and
    the later corrections are repeated, so the result is the same as if all had come in order. Reading an estimate
    changes nothing.
    """

    def __init__(self, calibration: Calibration, target: TargetProfile, settings: FilterSettings | None = None) -> None:
        """Create a filter without measurements.

        Args:
            calibration: calibration of the rig, for the streams in use.
            target: target profile, with the nominal size and which dimension that is.
            settings: motion and measurement settings; by default those of the target's kind.

        Raises:
            CalibrationError: the calibration has no T.
        """
        self._calibration = calibration
        self._target = target
        self._settings = settings or filter_settings(target, calibration)
        self._sight_lines = SightLines(calibration)
        self._base: Node | None = None  # state before the first kept measurement
        self._observed: list[Observation] = []
        self._nodes: list[Node | None] = []  # state after each of them; None before the first in the fixed image

    def add_fixed(
        self,
        detection: Detection,
        t: float,
        *,
        sigma_px: Array | None = None,
        size_px: float | None = None,
        camera: FixedCamera | None = None,
    ) -> bool:
        """Add a detection in the fixed image.

        Args:
            detection: bounding box; the size of a clipped one is only a lower bound.
            t: exposure time of the frame [s].
            sigma_px: standard deviation of the centre, (2,) [px]; by default from the settings and the box's size,
                with half the box in addition if it is clipped, whose hidden part may be as large again.
            size_px: known dimension in the image [px], if it is better known than from this box alone, such as the
                largest over a wing beat.
            camera: the fixed camera as it was turned at that time; by default as it was calibrated.

        Returns:
            False if the measurement is older than all that is kept, is a duplicate, or has a pixel without a ray.
        """
        found = (camera or self._calibration.fixed).tangents(detection.center_px)
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
        roll = self._calibration.zoom_head.fixed_roll(*z.tolist())
        side = length_px = self._target.length(width, height, roll) if width > 0 and height > 0 else 0.0
        if size_px is not None and not detection.clipped:
            side = size_px
        R = (J * np.array([sigma_u**2, sigma_v**2])) @ J.T
        log_depth, sigma = None, math.inf
        if side > 0:
            length = self._target.length(width * abs(J[0, 0]), height * abs(J[1, 1]), roll)
            log_depth = math.log(self._target.size * length_px / (side * length))
            sigma = math.hypot(settings.side_of_size, settings.side_px / side)
        return self._insert(Observation(t, z, R, None, log_depth, sigma, detection.clipped))

    def add_zoom(
        self,
        pixel: Array,
        sigma_px: float | Array,
        pan: float,
        tilt: float,
        nominal_px: float,
        t: float,
        *,
        head_sigma: float = HEAD_SIGMA,
        time_sigma_s: float = 0.0,
        size: tuple[float, float] | None = None,
    ) -> bool:
        """Add a centre of the target in the zoom image, which corrects the 3D state, see `correct_zoom`.

        Args:
            pixel: centre of the target in the zoom image, (2,) [px].
            sigma_px: standard deviation of that centre, one value or one each along u and v, (2,) [px].
            pan: pan reported for the time of the frame [rad].
            tilt: tilt reported for the time of the frame [rad].
            nominal_px: nominal focal length reported for that time [px].
            t: exposure time of the frame [s].
            head_sigma: standard deviation of the reported angles [rad]; larger while the head moves and the time is
                uncertain.
            time_sigma_s: standard deviation of that time against the fixed camera's [s].
            size: known dimension in the zoom image [tangent], and its relative standard deviation, if it was measured.

        Returns:
            False if the measurement was not added, see `add_fixed`.
        """
        lens = self._calibration.zoom_head.lens.at(nominal_px)
        found = lens.tangents(pixel)
        if found is None:
            return False
        z, J = found
        R = (J * np.square(sigma_px)) @ J.T + np.eye(2) * head_sigma**2
        log_depth, sigma = (None, math.inf) if size is None else (math.log(self._target.size / size[0]), size[1])
        sight = self._sight_lines.at(pan, tilt, nominal_px)
        return self._insert(Observation(t, z, R, sight, log_depth, sigma, time_sigma_s=time_sigma_s))

    @property
    def observations(self) -> Sequence[Observation]:
        """Observations of the last `history_s`, in the order of time."""
        return self._observed

    def from_fixed(self) -> "TargetFilter":
        """Make a filter of the same target from the observations of the fixed camera alone in the last `history_s`."""
        fixed = TargetFilter(self._calibration, self._target, self._settings)
        for each in self._observed:
            if each.sight is None:
                fixed._insert(each)
        return fixed

    def without(self, begin: float, end: float) -> "TargetFilter":
        """Make a filter of the same target without the observations after ``begin`` and up to ``end`` [s]."""
        first = bisect.bisect_right(self._observed, begin, key=lambda each: each.t)
        if first == len(self._observed) or self._observed[first].t > end:
            return self
        kept = copy.copy(self)  # what was computed from the earlier ones stays
        kept._observed, kept._nodes = self._observed[:first], self._nodes[:first]
        for each in self._observed[first:]:
            if each.t > end:
                kept._insert(each)
        return kept

    def estimate(self, t: float) -> Estimate | None:
        """Estimate the target at a time [s], after the newest measurement or up to `history_s` before it.

        Returns:
            The estimate; None before the first detection in the fixed image, or earlier than measurements are kept.
        """
        node = self._before(t)
        if node is None:
            return None
        x, P = self._propagate(node, t)
        return Estimate(
            t=t,
            measured_t=node.t,
            state=x,
            state_covariance=P,
            motion=self._settings.motion,
            target=self._target,
            calibration=self._calibration,
            sight_lines=self._sight_lines,
        )

    def knows(self, t: float) -> bool:
        """Whether there is an estimate for time t [s]."""
        return self._before(t) is not None

    def _propagate(self, node: Node, t: float) -> tuple[Array, Array]:
        """Predict state and covariance from a node to time t [s], which is no earlier."""
        noise_scale = min(max(node.mean_nis, 1.0), self._settings.most_noise_scale)
        return propagate(node.x, node.P, t - node.t, self._settings.motion, noise_scale)

    def _before(self, t: float) -> Node | None:
        """Return the newest node that is no later than time t [s]."""
        for node in (*reversed(self._nodes), self._base):
            if node is not None and node.t <= t:
                return node
        return None

    def _insert(self, observed: Observation) -> bool:
        """Insert an observation at its time, repeat the later corrections, and drop what is older than the history."""
        if not math.isfinite(observed.t) or (self._base is not None and observed.t < self._base.t):
            return False
        at = bisect.bisect_left(self._observed, observed.order, key=lambda each: each.order)
        if at < len(self._observed) and self._observed[at].order == observed.order:  # a repeated frame
            return False
        self._observed.insert(at, observed)
        del self._nodes[at:]
        for each in self._observed[at:]:
            self._nodes.append(self._step(self._nodes[-1] if self._nodes else self._base, each))
        while self._observed[0].t < self._observed[-1].t - self._settings.history_s:
            self._base = self._nodes.pop(0)
            self._observed.pop(0)
        return True

    def _step(self, node: Node | None, observed: Observation) -> Node | None:
        """Propagate a node to a measurement's time and correct it."""
        settings = self._settings
        nearest = settings.motion.nearest
        if node is None:
            return sound(begin(observed, settings), nearest) if observed.sight is None else None
        x, P = self._propagate(node, observed.t)
        node = replace(node, t=observed.t, x=x, P=P)
        if observed.sight is None:
            corrected = correct_fixed(node, observed, settings)
        else:
            corrected = correct_zoom(node, observed, observed.sight, settings)
        # A correction that is not finite is left out.
        return sound(corrected, nearest) or sound(node, nearest)
