"""The exact inverse: pan, tilt and range that bring a target onto a ray of the zoom camera, for one or for many.

The formulas are written once, by coordinates, for floats and for arrays: a target that is followed comes alone, and an
array of one costs twenty times as much as floats.

Pan-tilt kinematics: forward, the exact inverse for any wanted pixel, and the paper's shortcut beside it.

The head turns as T_base_head = Rot(Y, pan) Trans(0, 0, dz) Rot(cos(eps) X + sin(eps) Y, tilt) Trans(0, 0, -dz); an
ideal head has dz = eps = 0. A target x_base is on the ray d of the zoom camera when some range r makes

    T_base_head(pan, tilt) T_head_zoom (r d) = x_base                                                  (Eqs. 2, 6)

A head's own geometry, and where it brings its camera: forward kinematics.

The paper's own solution of pan and tilt, which takes a depth for the range; kept to be compared with.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np

from cotarget.errors import UnreachableError
from cotarget.geometry import Array, RigidTransform, Rotation, angle_between, rot_y


@dataclass(frozen=True)
class HeadGeometry:
    """How a real head departs from two axes that cross at a right angle and encoders that count truly.

    Attributes:
        axis_offset: dz, from the pan axis to the tilt axis along the base's z at pan = 0 [m].
        squareness: eps, how far the tilt axis leans from X towards Y [rad].
        pan_scale: true turn over the turn that the head reports.
        tilt_scale: likewise.
        pan_zero: true pan where the head reports 0 [rad].
        tilt_zero: likewise.
    """

    axis_offset: float = 0.0
    squareness: float = 0.0
    pan_scale: float = 1.0
    tilt_scale: float = 1.0
    pan_zero: float = 0.0
    tilt_zero: float = 0.0

    @property
    def tilt_axis(self) -> Array:
        """The tilt axis at pan = 0: cos(eps) X + sin(eps) Y, (3,)."""
        return np.array([np.cos(self.squareness), np.sin(self.squareness), 0.0])

    def true_angles(self, pan: Array | float, tilt: Array | float) -> tuple[Array, Array]:
        """The axes' true angles [rad] where the head reports these."""
        return (
            self.pan_scale * np.asarray(pan, float) + self.pan_zero,
            self.tilt_scale * np.asarray(tilt, float) + self.tilt_zero,
        )

    def reported_angles(self, pan: Array, tilt: Array) -> tuple[Array, Array]:
        """What the head reports at true angles [rad]."""
        return (pan - self.pan_zero) / self.pan_scale, (tilt - self.tilt_zero) / self.tilt_scale


IDEAL_HEAD = HeadGeometry()


def base_head(pan: float, tilt: float, head: HeadGeometry = IDEAL_HEAD) -> RigidTransform:
    """Forward kinematics T_base_head, the paper's P (Eq. 8); the identity at true pan = tilt = 0.

    Args:
        pan: as the head reports it, positive turns the camera right [rad].
        tilt: likewise, positive turns the camera up [rad].
        head: the unit's own geometry.
    """
    true_pan, true_tilt = (float(angle) for angle in head.true_angles(pan, tilt))
    offset = RigidTransform.from_translation([0.0, 0.0, head.axis_offset])
    tilting = RigidTransform.from_rotation(Rotation.from_rotvec(head.tilt_axis * true_tilt))
    return RigidTransform.from_rotation(rot_y(true_pan)) * offset * tilting * offset.inv()


def towards(x_base: Array) -> tuple[float, float]:
    """Pan and tilt of an ideal head whose own z then points at a target; where a camera is on it does not count.

    Args:
        x_base: the target in the base's frame [m], (3,).
    """
    x, y, z = x_base
    return math.atan2(x, z), math.atan2(-y, math.hypot(x, z))


def zoom_fixed(
    pan: float,
    tilt: float,
    T_head_zoom: RigidTransform,
    T_zoom0_fixed: RigidTransform,
    head: HeadGeometry = IDEAL_HEAD,
) -> RigidTransform:
    """Where the fixed camera is seen from the moved zoom camera: T_zoom_fixed (Eq. 2).

    Args:
        pan: the pan axis's angle [rad].
        tilt: the tilt axis's [rad].
        T_head_zoom: the paper's T.
        T_zoom0_fixed: the paper's Gamma.
        head: the unit's own geometry.
    """
    return T_head_zoom.inv() * base_head(pan, tilt, head).inv() * T_head_zoom * T_zoom0_fixed


def miss(
    pan: Array,
    tilt: Array,
    x_base: Array,
    T_head_zoom: RigidTransform,
    head: HeadGeometry = IDEAL_HEAD,
    ray: Array | tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Array:
    """Angle between the zoom camera's ray and the target, as seen from the moved camera [rad].

    Args:
        pan: [rad], (...).
        tilt: [rad], (...).
        x_base: targets in the base's frame [m], (..., 3).
        T_head_zoom: the zoom camera's place on the head.
        head: the unit's own geometry.
        ray: the ray, (3,) or (..., 3).
    """
    pan, tilt = head.true_angles(pan, tilt)
    shape = np.broadcast_shapes(np.shape(pan), np.shape(tilt), np.shape(x_base)[:-1])
    dz = np.array([0.0, 0.0, head.axis_offset])
    pans = Rotation.from_rotvec(np.multiply.outer(np.broadcast_to(pan, shape).ravel(), [0.0, 1.0, 0.0]))
    tilts = Rotation.from_rotvec(np.multiply.outer(np.broadcast_to(tilt, shape).ravel(), head.tilt_axis))
    points = np.array(np.broadcast_to(x_base, (*shape, 3))).reshape(-1, 3)
    x_head = tilts.inv().apply(pans.inv().apply(points) - dz) + dz
    x_zoom = T_head_zoom.inv().apply(x_head).reshape(*shape, 3)
    return angle_between(x_zoom, np.broadcast_to(np.asarray(ray, float), x_zoom.shape))


# Rounds by which the closed form meets an axis offset; a real one shrinks the error a thousandfold each round.
CLOSED_FORM_ROUNDS = 4
# Newton's iteration from the closed form converges quadratically; only where the branches meet does it need many.
NEWTON_STEPS = 40
# It has converged when it misses by no more than its own rounding, some units in the last place.
ROUNDING = 4 * np.finfo(float).eps
# A solution is accepted when it misses by less than this angle [rad], 6e-10 degrees; rounding stays far below.
ACCEPTED_MISS = 1e-11
# A Newton step turns an axis by at most this [rad]: where the branches meet, a full step would leave its branch.
LONGEST_STEP = 0.2
# A derivative with a smaller determinant has no inverse.
SINGULAR = np.finfo(float).tiny
TURN = 2.0 * np.pi
NOWHERE = (math.nan, math.nan, math.nan)
V = TypeVar("V")
Triple = tuple[V, V, V]


@dataclass(frozen=True)
class Pointing:
    """Ways to bring a target onto a ray of the zoom camera.

    Attributes:
        pan: [rad], a float or (..., 2), one for each branch.
        tilt: [rad], likewise.
        range: distance from the zoom camera to the target along that ray [m], likewise.
    """

    pan: Array
    tilt: Array
    range: Array


def solve(
    x_base: Array,
    T_head_zoom: RigidTransform,
    head: HeadGeometry = IDEAL_HEAD,
    ray: Array | tuple[float, float, float] = (0.0, 0.0, 1.0),
    *,
    pupil: float = 0.0,
) -> Pointing:
    """Solve pan, tilt and range exactly, in both branches (Eqs. 6, 13, 16 and the norm's quadratic for the range).

    The closed form holds for an ideal head; Newton's steps carry it to a head with an axis offset and axes that
    are not square, and take the closed form's own rounding away.

    Args:
        x_base: targets in the base's frame [m], (..., 3).
        T_head_zoom: the zoom camera's place on the head.
        head: the unit's own geometry.
        ray: the zoom camera's ray that shall meet the target, of any length, (3,) or (..., 3).
        pupil: how far the camera's entrance pupil has moved forward from there [m].

    Returns:
        Pan and tilt as the head reports them, their true angles within -pi..pi, and range, each (..., 2); the first
        branch is the one that faces forward. All three are nan in a branch that does not exist, as for a target
        nearer than the lever arm. Within half a degree of the pan axis, where the branches meet, both may be the same
        solution.
    """
    x_base, ray = np.asarray(x_base, float), np.asarray(ray, float)
    T = T_head_zoom.as_matrix()
    R, t = T[:3, :3], T[:3, 3] + T[:3, 2] * pupil
    t[2] -= head.axis_offset
    if x_base.ndim == ray.ndim == 1:
        x, d = _floats(x_base), _floats(R @ ray / math.hypot(*ray))
        ways = [_reported(*way, head) if way[2] > 0 else NOWHERE for way in _solve_one(x, d, _floats(t), head)]
        return Pointing(*np.array(ways).T)
    x_base, ray = np.broadcast_arrays(x_base, ray)
    with np.errstate(invalid="ignore", divide="ignore"):
        d_many = ray / np.linalg.norm(ray, axis=-1, keepdims=True) @ R.T
        found = _solve_many(x_base, d_many, t, head)
    return Pointing(*(np.where(found[2] > 0, value, np.nan) for value in _reported(*found, head)))


def nearest(
    pointing: Pointing,
    pan_limits: tuple[float, float],
    tilt_limits: tuple[float, float],
    now: tuple[float, float] = (0.0, 0.0),
    head: HeadGeometry = IDEAL_HEAD,
) -> Pointing:
    """Choose from both branches, whole turns included, the solution within the limits that is nearest to now.

    Args:
        pointing: one target's two branches, as `solve` gives them.
        pan_limits: lowest and highest pan [rad].
        tilt_limits: lowest and highest tilt [rad].
        now: where the head is, (pan, tilt) [rad]. Near is what the slower axis has to travel.
        head: the unit's own geometry, for what it reports after a whole turn.

    Raises:
        UnreachableError: there is no solution, or none within the limits.
    """
    candidates = []
    for pan, tilt, reach in zip(pointing.pan.tolist(), pointing.tilt.tolist(), pointing.range.tolist(), strict=True):
        if not math.isfinite(pan + tilt + reach):
            continue
        pans = [pan + turns * TURN / head.pan_scale for turns in range(-2, 3)]
        tilts = [tilt + turns * TURN / head.tilt_scale for turns in range(-1, 2)]
        candidates += [
            (max(abs(p - now[0]), abs(q - now[1])), p, q, reach)
            for p in pans
            if pan_limits[0] <= p <= pan_limits[1]
            for q in tilts
            if tilt_limits[0] <= q <= tilt_limits[1]
        ]
    if candidates:
        return Pointing(*np.array(min(candidates)[1:]))
    if not np.isfinite(pointing.pan).any():
        raise UnreachableError("no pan and tilt bring this point to the wanted pixel: it is too close to the head")
    wanted = " or ".join(
        f"pan {np.degrees(p):.2f}, tilt {np.degrees(q):.2f}"
        for p, q in zip(pointing.pan, pointing.tilt, strict=True)
        if np.isfinite(p)
    )
    lo_hi = np.degrees([*pan_limits, *tilt_limits])
    raise UnreachableError(
        f"the point needs {wanted} degrees, beyond the limits "
        f"pan {lo_hi[0]:g} to {lo_hi[1]:g}, tilt {lo_hi[2]:g} to {lo_hi[3]:g} degrees"
    )


def _reported(pan: Any, tilt: Any, reach: Any, head: HeadGeometry) -> Triple[Any]:
    """What the head reports at true angles, which are taken within -pi..pi, and the range, of floats or arrays."""
    pan, tilt = head.reported_angles((pan + math.pi) % TURN - math.pi, (tilt + math.pi) % TURN - math.pi)
    return pan, tilt, reach


def _floats(v: Array) -> Triple[float]:
    x, y, z = v.tolist()
    return x, y, z


def _solve_one(target: Triple[float], d: Triple[float], t: Triple[float], head: HeadGeometry) -> list[Triple[float]]:
    """True pan, true tilt and range of one target in both branches, nan where there is none."""
    distance = math.hypot(*target)
    found = []
    for sign in (1.0, -1.0):
        try:
            pan, tilt, reach = _closed_form(target, d, t, sign, head, math)
        except ValueError:  # the root of a negative number
            found.append(NOWHERE)
            continue
        error = math.inf
        for _ in range(NEWTON_STEPS):
            turns = math.cos(pan), math.sin(pan), math.cos(tilt), math.sin(tilt)
            residual, det, steps = _newton_step(*turns, reach, target, d, t, head)
            error = math.hypot(*residual)
            if error <= ROUNDING * distance or abs(det) <= SINGULAR:
                break
            pan_step, tilt_step, reach_step = (step / det for step in steps)
            part = min(1.0, LONGEST_STEP / max(abs(pan_step), abs(tilt_step), LONGEST_STEP))
            pan, tilt, reach = pan - part * pan_step, tilt - part * tilt_step, reach - part * reach_step
        found.append((pan, tilt, reach) if error <= ACCEPTED_MISS * distance else NOWHERE)
    return found


def _solve_many(x_base: Array, d: Array, t: Array, head: HeadGeometry) -> Triple[Array]:
    """As `_solve_one`, for targets (..., 3) and rays d (..., 3); true pan, true tilt and range, each (..., 2)."""
    target, d = (
        np.array(np.broadcast_to(v[..., None, :], (*v.shape[:-1], 2, 3))).reshape(-1, 3).T for v in (x_base, d)
    )
    distance = np.linalg.norm(target, axis=0)
    sign = np.tile([1.0, -1.0], len(distance) // 2)
    (x, y, z), (d_x, d_y, d_z), (t_x, t_y, t_z) = target, d, t
    unknowns = np.array(_closed_form((x, y, z), (d_x, d_y, d_z), (t_x, t_y, t_z), sign, head, np))
    error = np.full(len(distance), np.inf)
    active = np.arange(len(distance))
    for _ in range(NEWTON_STEPS):
        pan, tilt, reach = unknowns[:, active]
        turns = np.cos(pan), np.sin(pan), np.cos(tilt), np.sin(tilt)
        residual, det, steps = _newton_step(*turns, reach, tuple(target[:, active]), tuple(d[:, active]), t, head)
        error[active] = np.linalg.norm(residual, axis=0)
        # A singular J (a target on the pan axis) can go no further and is left to the final check.
        going_on = (error[active] > ROUNDING * distance[active]) & (np.abs(det) > SINGULAR)
        active = active[going_on]
        if not len(active):
            break
        step = np.array(steps)[:, going_on] / det[going_on]
        longest = np.max(np.abs(step[:2]), axis=0)
        unknowns[:, active] -= step * np.minimum(1.0, LONGEST_STEP / np.maximum(longest, LONGEST_STEP))
    unknowns[:, ~(error <= ACCEPTED_MISS * distance)] = np.nan
    pan, tilt, reach = unknowns.reshape(3, *x_base.shape[:-1], 2)
    return pan, tilt, reach


def _closed_form(target: Triple[Any], d: Triple[Any], t: Triple[Any], sign: Any, head: HeadGeometry, lib: Any) -> Any:
    """Pan, tilt and range in the atan2 forms of (13) and (16), of floats or arrays alike.

    Exact for dz = 0. With an axis offset the range depends on the tilt, and a few rounds bring both together; each
    takes off a factor of dz / range.

    Args:
        target: x, y and z of the target in the base's frame [m].
        d: of the ray in the head's frame, of length 1.
        t: of the zoom camera in the head's frame, from the tilt axis [m].
        sign: 1 for the branch that faces forward, -1 for the other.
        head: the unit's own geometry.
        lib: `math` or `numpy`, for its functions.
    """
    (a, b, c), dz = target, head.axis_offset
    sin_eps, cos_eps = math.sin(head.squareness), math.cos(head.squareness)
    along = d[0] * t[0] + d[1] * t[1] + d[2] * t[2]
    free = a * a + b * b + c * c - dz * dz - (t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    ahead = 0.0  # the z of q after tilting
    for _ in range(1 if dz == 0 else CLOSED_FORM_ROUNDS):
        # |x_base|^2 = dz^2 + 2 dz z_tilted + |q|^2 with q = r d + t: a quadratic in the range r
        reach = lib.sqrt(along * along + free - 2 * dz * ahead) - along
        qx, qy, qz = (reach * along_d + from_t for along_d, from_t in zip(d, t, strict=True))
        on_axis = cos_eps * qx + sin_eps * qy
        y, z, height = qy - on_axis * sin_eps, cos_eps * qz, b - on_axis * sin_eps
        left = y * y + z * z - height * height
        tilt = lib.atan2(y, z) - lib.atan2(height, sign * lib.sqrt((left + abs(left)) / 2))  # (13)
        x, _, ahead = _tilt((qx, qy, qz), lib.cos(tilt), lib.sin(tilt), head)  # (14)
    z2 = ahead + dz
    return lib.atan2(a * z2 - c * x, a * x + c * z2), tilt, reach  # (16)


def _newton_step(
    cos_pan: Any, sin_pan: Any, cos_tilt: Any, sin_tilt: Any, reach: Any,
    target: Triple[Any], d: Triple[Any], t: Triple[Any] | Array, head: HeadGeometry,
) -> tuple[Triple[Any], Any, Triple[Any]]:  # fmt: skip
    """What base_head(pan, tilt) (range d + t) misses the target by, and Newton's step by Cramer's rule.

    Returns:
        The residual [m]; the determinant of its derivative by (pan, tilt, range); and the step times that.
    """
    q = _tilt((reach * d[0] + t[0], reach * d[1] + t[1], reach * d[2] + t[2]), cos_tilt, sin_tilt, head)
    reached = _pan((q[0], q[1], q[2] + head.axis_offset), cos_pan, sin_pan)
    residual = (reached[0] - target[0], reached[1] - target[1], reached[2] - target[2])
    by_pan = (reached[2], 0.0, -reached[0])
    by_tilt = _pan(_about_tilt_axis(q, head), cos_pan, sin_pan)
    by_reach = _pan(_tilt(d, cos_tilt, sin_tilt, head), cos_pan, sin_pan)
    normal = _cross(by_tilt, by_reach)
    steps = _dot(residual, normal), _dot(by_pan, _cross(residual, by_reach)), _dot(by_pan, _cross(by_tilt, residual))
    return residual, _dot(by_pan, normal), steps


def _pan(v: Triple[Any], cos: Any, sin: Any) -> Triple[Any]:
    """Rotation about Y."""
    return cos * v[0] + sin * v[2], v[1], cos * v[2] - sin * v[0]


def _tilt(v: Triple[Any], cos: Any, sin: Any, head: HeadGeometry) -> Triple[Any]:
    """Rodrigues' rotation about the tilt axis."""
    x_axis, y_axis = math.cos(head.squareness), math.sin(head.squareness)
    x, y, z = _about_tilt_axis(v, head)
    along = (1 - cos) * (v[0] * x_axis + v[1] * y_axis)
    return cos * v[0] + sin * x + along * x_axis, cos * v[1] + sin * y + along * y_axis, cos * v[2] + sin * z


def _about_tilt_axis(v: Triple[Any], head: HeadGeometry) -> Triple[Any]:
    """Cross product of the tilt axis with a vector."""
    x_axis, y_axis = math.cos(head.squareness), math.sin(head.squareness)
    return y_axis * v[2], -x_axis * v[2], x_axis * v[1] - y_axis * v[0]


def _cross(a: Triple[Any], b: Triple[Any]) -> Triple[Any]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a: Triple[Any], b: Triple[Any]) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


# --- shortcut ---


def shortcut(
    x_fixed: Array,
    T_zoom0_fixed: RigidTransform,
    T_head_zoom: RigidTransform,
    reading: Literal["table", "example"],
) -> Pointing:
    """The paper's own solution, which takes a depth for the range; kept to be compared with.

    P is a rotation, so |x_head| must equal |x_base|; a depth in place of the range does not satisfy that, and the
    rows of (7) contradict each other: (13) and (16) use the first two and the third only chooses the sign.

    Args:
        x_fixed: targets in the fixed camera's frame [m], (..., 3).
        T_zoom0_fixed: Gamma.
        T_head_zoom: T.
        reading: which depth is z: "table" (Table 1) that in x_fixed, "example" (Section 4.2) that in x_zoom0.

    Returns:
        Pan, tilt and that depth, (...); nan where |b| > r1 or |a| > r2.
    """
    x_fixed = np.asarray(x_fixed, float)
    x_zoom0 = T_zoom0_fixed.apply(x_fixed.reshape(-1, 3)).reshape(x_fixed.shape)
    x_base = T_head_zoom.apply(x_zoom0.reshape(-1, 3)).reshape(x_fixed.shape)
    z = (x_fixed if reading == "table" else x_zoom0)[..., 2]
    x_head = z[..., None] * T_head_zoom.rotation.as_matrix()[:, 2] + np.asarray(T_head_zoom.translation)  # (6)
    (x, y, z1), (a, b, c) = np.moveaxis(x_head, -1, 0), np.moveaxis(x_base, -1, 0)
    with np.errstate(invalid="ignore"):
        tilt = np.arctan2(y, z1) - np.arcsin(b / np.hypot(y, z1))  # (13)
        z2 = np.sin(tilt) * y + np.cos(tilt) * z1  # (14)
        swing = np.arccos(a / np.hypot(x, z2))
        pans = np.stack([np.arctan2(z2, x) + swing, np.arctan2(z2, x) - swing], axis=-1)  # (16)
        off = np.abs(-np.sin(pans) * x[..., None] + np.cos(pans) * z2[..., None] - c[..., None])
        pan = np.where(off[..., 0] <= off[..., 1], pans[..., 0], pans[..., 1])
    return Pointing((pan + np.pi) % TURN - np.pi, tilt, np.where(np.isfinite(pan), z, np.nan))
