"""The filter's corrections: a middle in either view and an apparent size, each against wild measurements."""

import math
from dataclasses import dataclass, replace

import numpy as np

from cotarget.estimation.motion import PAN, SEEN, STATES, TILT, A, B, C, G, K, L, W
from cotarget.estimation.node import Node
from cotarget.estimation.settings import USUAL_DEPTH, EstimationSettings
from cotarget.estimation.sight import Sight
from cotarget.geometry import Array

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
    sight: Sight

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
    surprise = float(innovation @ S_inv @ innovation)
    if surprise > settings.jump_gate:
        if node.missed_wide + 1 < settings.misses:
            return replace(node, missed_wide=node.missed_wide + 1, missed_zoom=0, lean=(0.0, 0.0))
        return _size(_elsewhere(node, seen, settings), seen.size, settings)
    if surprise > settings.gate:  # measured worse than thought: it counts as much as one that just passes
        S_inv = _inverse(PHt[:2] + R * (surprise / settings.gate))
        surprise = float(innovation @ S_inv @ innovation)
    gain = PHt @ S_inv
    P = node.P - gain @ PHt.T
    node = _told(replace(node, x=node.x + gain @ innovation, P=P, missed_wide=0, wide_t=node.t), surprise, settings)
    return _size(node, seen.size, settings)


def correct_zoom(node: Node, seen: ZoomSeen, settings: EstimationSettings) -> Node:
    """Take a middle in the zoom view into account, iterated because the depth enters in no linear way."""
    if node.missed_zoom >= settings.zoom_misses or math.hypot(*node.lean) > settings.most_lean:
        node = replace(node, P=_doubted(node.P, settings), missed_zoom=0, lean=(0.0, 0.0))
    # While the wide view surprises too, it is the target that moved, and neither its size nor the head is to blame.
    missed = node.missed_zoom + (node.missed_wide == 0 and node.surprise < settings.calm)
    x = node.x
    surprise = 0.0
    for i in range(ROUNDS):
        tangent, J, d = seen.sight.seen(x)
        if d[2] <= 0:
            return replace(node, missed_zoom=missed)
        innovation = seen.tangent - tangent + J @ (x - node.x)[SEEN]
        PHt = node.P[:, SEEN] @ J.T
        S_inv = _inverse(J @ PHt[SEEN] + seen.R)
        if i == 0:
            surprise = float(innovation @ S_inv @ innovation)
            if surprise > settings.gate:
                return replace(node, missed_zoom=missed)
            lean = _leaning(node, J @ PHt[SEEN] + seen.R, innovation, settings)
        gain = PHt @ S_inv
        before, x = x[L], node.x + gain @ innovation
        if abs(x[L] - before) < SETTLED:
            break
    P = node.P - gain @ PHt.T
    return _told(replace(node, x=x, P=P, missed_zoom=0, lean=lean), surprise, settings)


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
        P[L, L] += settings.depth_doubt**2
        P[G, G] += settings.depth_doubt**2
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


def _told(node: Node, surprise: float, settings: EstimationSettings) -> Node:
    """Keep count of how surprising measurements are; a target that surprises manoeuvres harder than usual."""
    mean = node.surprise + settings.surprise_gain * (surprise / 2 - node.surprise)
    boost = min(max(mean, 1.0), settings.most_boost)
    if node.jumped(settings.motion.jump):
        boost = max(boost, settings.jump_boost)
    return replace(node, surprise=mean, boost=boost)


def _leaning(node: Node, S: Array, innovation: Array, settings: EstimationSettings) -> tuple[float, float]:
    """Average the zoom view's innovations: what always lies to one side is no noise, however small it is."""
    if node.surprise >= settings.calm:  # the target moves otherwise than thought, which says nothing of the head
        return 0.0, 0.0
    g = settings.lean_gain
    u, v = node.lean
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
    P[L, L] += settings.depth_doubt**2
    return replace(
        node,
        x=x,
        P=P,
        missed_wide=0,
        missed_zoom=0,
        lean=(0.0, 0.0),
        surprise=1.0,
        boost=settings.jump_boost,
        moved_t=node.t,
    )


def _doubted(P: Array, settings: EstimationSettings) -> Array:
    """What the zoom view does not find where it should be: either the told size is wrong, or the head is."""
    P = P.copy()
    # Size and depth may be wrong together: by what the wide view sees, their ratio stays known.
    P[np.ix_([L, K], [L, K])] += settings.size_doubt**2
    P[PAN, PAN] += settings.bias_doubt**2
    P[TILT, TILT] += settings.bias_doubt**2
    return P


def _repeated(interval: float, lasting_s: float) -> float:
    """By what a variance counts more where errors last that long [s] and measurements come so soon [s]."""
    return max(1.0, 2 * lasting_s / max(interval, SOONEST))


def _inverse(S: Array) -> Array:
    """The inverse of a 2x2 matrix; numpy's takes five times as long."""
    (a, b), (c, d) = S.tolist()
    det = a * d - b * c
    return np.array([[d / det, -b / det], [-c / det, a / det]])
