"""One target's filter in 3D: time-stamped measurements of both cameras, in any order, to an Estimate at any time.

The filter's corrections: a middle in either view and an apparent size, each against wild measurements.

The filter's whole memory after a measurement: state, covariance, and how surprising the last ones were.
"""

import bisect
import math
from dataclasses import dataclass, replace

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import TargetConfig
from cotarget.estimation.measurement_model import Estimate, SightLine, Sights
from cotarget.estimation.motion_model import (
    PAN,
    SEEN,
    STATES,
    TILT,
    USUAL_DEPTH,
    A,
    B,
    C,
    EstimationSettings,
    G,
    Jump,
    K,
    L,
    W,
    estimation_settings_for,
    propagate,
)
from cotarget.geometry import Array
from cotarget.tracking.track import Measurement

FARTHEST = 1e5  # [m]; nothing is seen from farther away


@dataclass(frozen=True)
class Node:
    """One point in time of a filter.

    Attributes:
        t: [s].
        x: state, see `cotarget.estimation.motion_model`, (13,).
        P: its covariance, (13, 13).
        nis: squared innovation over what was expected, averaged over the last measurements of the middle.
        noise_scale: by what the acceleration's variance is larger than usual.
        missed_wide: how many measurements in the wide view were turned away on end.
        missed_zoom: likewise in the zoom view.
        missed_size: likewise of the size.
        size_t: when the size was last measured [s].
        mean_innovation: innovation in the zoom view over its standard deviation, averaged over the last second or so,
        (2,).
        wide_t: when the wide view last corrected the middle [s]; a start, at first or elsewhere, is no correction.
        moved_t: when it was last found elsewhere than it could be [s].
    """

    t: float
    x: Array
    P: Array
    nis: float = 1.0
    noise_scale: float = 1.0
    missed_wide: int = 0
    missed_zoom: int = 0
    missed_size: int = 0
    size_t: float = -math.inf
    wide_t: float = -math.inf
    moved_t: float = -math.inf
    mean_innovation: tuple[float, float] = (0.0, 0.0)

    def jumped(self, jump: Jump) -> bool:
        """Whether it was found elsewhere so lately that it may be on its way still."""
        return self.t < self.moved_t + jump.seconds


def sound(node: Node, nearest: float) -> Node | None:
    """The same with a depth that can be and a covariance that is symmetric; None where it tells nothing any more.

    Args:
        node: after a measurement.
        nearest: no target is nearer than this [m].
    """
    x, P = node.x.copy(), (node.P + node.P.T) / 2
    if not (np.isfinite(x).all() and np.isfinite(P).all() and (P.diagonal() > 0).all()):
        return None
    x[L] = min(max(x[L], math.log(nearest)), math.log(FARTHEST))
    return replace(node, x=x, P=P)


# --- correct ---

ROUNDS = 4  # of an iterated correction
SOONEST = 1e-3  # two measurements at once are that far apart [s]
SETTLED = 1e-3  # it has converged when the depth changes by less than this part


@dataclass(frozen=True)
class SizeSeen:
    """An apparent size: the logarithm of the depth that it means for a target as large as told, and its sigma.

    Of a target that is only seen in part it is a bound: it is at least that large in the image, so at most so far away.
    """

    log_depth: float
    sigma: float
    bound: bool = False


@dataclass(frozen=True)
class WideSeen:
    """A target's middle in the wide view: tangents (2,), their covariance (2, 2), and its size."""

    t: float
    tangent: Array
    R: Array
    size: SizeSeen | None

    @property
    def key(self) -> tuple[float, int]:
        """What measurements are sorted by."""
        return self.t, 0


@dataclass(frozen=True)
class ZoomSeen:
    """A target's middle in the zoom view: tangents (2,), their covariance (2, 2), and where it looked."""

    t: float
    tangent: Array
    R: Array
    sight: SightLine

    @property
    def key(self) -> tuple[float, int]:
        """What measurements are sorted by."""
        return self.t, 1


def begin(seen: WideSeen, settings: EstimationSettings) -> Node:
    """The state after the first measurement.

    No time is set in it by which the next would count less: an error that both share leaves the velocity that the two
    tell as it is.
    """
    motion = settings.motion
    x = np.zeros(STATES)
    x[:2] = seen.tangent
    x[G] = motion.attitude_mean
    x[L] = math.log(USUAL_DEPTH) if seen.size is None or seen.size.bound else seen.size.log_depth + x[G]
    nearness = math.exp(-x[L])
    sigma = np.zeros(STATES)
    sigma[L] = settings.depth_sigma
    sigma[W], sigma[C] = motion.speed * nearness, motion.acceleration * nearness
    sigma[[K, G]] = motion.size_sigma, motion.attitude_sigma
    sigma[[PAN, TILT]] = motion.bias_sigma
    P = np.diag(sigma**2)
    P[:2, :2] = seen.R
    return _size(Node(seen.t, x, P), seen.size, settings)


def correct_wide(node: Node, seen: WideSeen, settings: EstimationSettings) -> Node:
    """Take a middle and a size in the wide view into account."""
    if seen.size is None or seen.size.bound:
        node = _slowed(node, settings)
    PHt = node.P[:, :2]
    innovation = seen.tangent - node.x[:2]
    R = seen.R * _repeated(node.t - node.wide_t, settings.noise_s)
    S_inv = _inverse(PHt[:2] + R)
    nis = float(innovation @ S_inv @ innovation)
    if nis > settings.jump_gate:
        if node.missed_wide + 1 < settings.misses:
            return replace(node, missed_wide=node.missed_wide + 1, missed_zoom=0, mean_innovation=(0.0, 0.0))
        return _size(_elsewhere(node, seen, settings), seen.size, settings)
    if nis > settings.gate:  # measured worse than thought: it counts as much as one that just passes
        S_inv = _inverse(PHt[:2] + R * (nis / settings.gate))
        nis = float(innovation @ S_inv @ innovation)
    gain = PHt @ S_inv
    P = node.P - gain @ PHt.T
    node = _with_noise_scale(
        replace(node, x=node.x + gain @ innovation, P=P, missed_wide=0, wide_t=node.t), nis, settings
    )
    return _size(node, seen.size, settings)


def correct_zoom(node: Node, seen: ZoomSeen, settings: EstimationSettings) -> Node:
    """Take a middle in the zoom view into account, iterated because the depth enters in no linear way."""
    if node.missed_zoom >= settings.zoom_misses or math.hypot(*node.mean_innovation) > settings.most_mean_innovation:
        node = replace(node, P=_inflated(node.P, settings), missed_zoom=0, mean_innovation=(0.0, 0.0))
    # While the wide view surprises too, it is the target that moved, and neither its size nor the head is to blame.
    missed = node.missed_zoom + (node.missed_wide == 0 and node.nis < settings.consistent_nis)
    x = node.x
    nis = 0.0
    for i in range(ROUNDS):
        tangent, J, d = seen.sight.seen(x)
        if d[2] <= 0:
            return replace(node, missed_zoom=missed)
        innovation = seen.tangent - tangent + J @ (x - node.x)[SEEN]
        PHt = node.P[:, SEEN] @ J.T
        S_inv = _inverse(J @ PHt[SEEN] + seen.R)
        if i == 0:
            nis = float(innovation @ S_inv @ innovation)
            if nis > settings.gate:
                return replace(node, missed_zoom=missed)
            mean_innovation = _mean_innovation(node, J @ PHt[SEEN] + seen.R, innovation, settings)
        gain = PHt @ S_inv
        before, x = x[L], node.x + gain @ innovation
        if abs(x[L] - before) < SETTLED:
            break
    P = node.P - gain @ PHt.T
    return _with_noise_scale(replace(node, x=x, P=P, missed_zoom=0, mean_innovation=mean_innovation), nis, settings)


def _size(node: Node, size: SizeSeen | None, settings: EstimationSettings) -> Node:
    """Take an apparent size into account: l - k - g."""
    if size is None:
        return node
    P = node.P
    h = np.zeros(STATES)
    h[L], h[K], h[G] = 1.0, -1.0, -1.0
    # Limbs and wings move the box's sides together for a while: sizes of frames soon after each other tell less.
    variance = size.sigma**2 * _repeated(node.t - node.size_t, settings.size_s)
    Ph = P @ h
    S = float(h @ Ph) + variance
    innovation = size.log_depth - float(h @ node.x)
    if size.bound and innovation >= 0:  # it is no farther away already
        return node
    if innovation * innovation > settings.size_gate * S:
        if node.missed_size + 1 < settings.misses:
            return replace(node, missed_size=node.missed_size + 1)
        # Turned or come nearer, against all expectation: let both give way.
        P = P.copy()
        P[L, L] += settings.depth_inflation**2
        P[G, G] += settings.depth_inflation**2
        Ph = P @ h
        S = float(h @ Ph) + variance
    x = node.x + Ph * (innovation / S)
    P = P - np.outer(Ph, Ph / S)
    return replace(node, x=x, P=P, missed_size=0, size_t=node.size_t if size.bound else node.t)


def _slowed(node: Node, settings: EstimationSettings) -> Node:
    """Forget a motion along the axis that sizes have told, where none tells whether it goes on."""
    if math.isinf(node.size_t):
        return node
    rho = math.exp(-(node.t - node.wide_t) / settings.unsized_s)
    usual = np.array([settings.motion.speed, settings.motion.acceleration]) * math.exp(-node.x[L])
    x, P = node.x.copy(), node.P.copy()
    along = [W.stop - 1, C.stop - 1]
    x[along] *= rho
    P[along] *= rho
    P[:, along] *= rho
    P[along, along] += (1 - rho**2) * usual**2
    return replace(node, x=x, P=P)


def _with_noise_scale(node: Node, nis: float, settings: EstimationSettings) -> Node:
    """Keep count of how surprising measurements are; a target that surprises manoeuvres harder than usual."""
    mean = node.nis + settings.nis_gain * (nis / 2 - node.nis)
    noise_scale = min(max(mean, 1.0), settings.most_noise_scale)
    if node.jumped(settings.motion.jump):
        noise_scale = max(noise_scale, settings.jump_noise_scale)
    return replace(node, nis=mean, noise_scale=noise_scale)


def _mean_innovation(node: Node, S: Array, innovation: Array, settings: EstimationSettings) -> tuple[float, float]:
    """Average the zoom view's innovations: what always lies to one side is no noise, however small it is."""
    if node.nis >= settings.consistent_nis:  # the target moves otherwise than thought, which says nothing of the head
        return 0.0, 0.0
    g = settings.mean_innovation_gain
    u, v = node.mean_innovation
    return (
        u + g * (float(innovation[0]) / math.sqrt(S[0, 0]) - u),
        v + g * (float(innovation[1]) / math.sqrt(S[1, 1]) - v),
    )


def _elsewhere(node: Node, seen: WideSeen, settings: EstimationSettings) -> Node:
    """Start anew where the target was seen on end; what is known of its size and of the head stays known."""
    motion = settings.motion
    nearness = math.exp(-node.x[L])
    x, P = node.x.copy(), node.P.copy()
    x[:2] = seen.tangent
    x[C] = 0.0  # its velocity is the best guess still: one that is carried off is soon farther off
    moved = [A, B, *range(W.start, C.stop)]
    P[moved] = 0.0
    P[:, moved] = 0.0
    P[:2, :2] = seen.R
    # Along the axis only sizes tell, and badly: there it is taken for no faster than usual.
    speeds = motion.jump.speed, motion.jump.speed, motion.speed
    accelerations = motion.jump.acceleration, motion.jump.acceleration, motion.acceleration
    P[range(3, 9), range(3, 9)] = (np.array([*speeds, *accelerations]) * nearness) ** 2
    P[L, L] += settings.depth_inflation**2
    return replace(
        node,
        x=x,
        P=P,
        missed_wide=0,
        missed_zoom=0,
        mean_innovation=(0.0, 0.0),
        nis=1.0,
        noise_scale=settings.jump_noise_scale,
        moved_t=node.t,
    )


def _inflated(P: Array, settings: EstimationSettings) -> Array:
    """What the zoom view does not find where it should be: either the told size is wrong, or the head is."""
    P = P.copy()
    # Size and depth may be wrong together: by what the wide view sees, their ratio stays known.
    P[np.ix_([L, K], [L, K])] += settings.size_inflation**2
    P[PAN, PAN] += settings.bias_inflation**2
    P[TILT, TILT] += settings.bias_inflation**2
    return P


def _repeated(interval: float, lasting_s: float) -> float:
    """By what a variance counts more where errors last that long [s] and measurements come so soon [s]."""
    return max(1.0, 2 * lasting_s / max(interval, SOONEST))


def _inverse(S: Array) -> Array:
    """The inverse of a 2x2 matrix; numpy's takes five times as long."""
    (a, b), (c, d) = S.tolist()
    det = a * d - b * c
    return np.array([[d / det, -b / det], [-c / det, a / det]])


class TargetFilter:
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

    def update_fixed(
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

    def update_zoom(
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
            Whether it could be taken, see `update_fixed`.
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
        return propagate(node.x, node.P, t - node.t, motion, node.noise_scale)

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
