"""Pan-tilt kinematics: forward kinematics, the exact inverse for any ray, and the paper's shortcut.

The head turns by

    T_base_head(pan, tilt) = Rot(Y, pan) Trans(0, 0, dz) Rot(n, tilt) Trans(0, 0, -dz),   n = (cos eps, sin eps, 0)

For an ideal head, dz = eps = 0, this is the paper's P (Eq. 8). A target x_base lies on the ray d of the zoom camera, at
range r, where

    T_base_head(pan, tilt) x_head = x_base,   x_head = T_head_zoom (r d)                               (Eqs. 5, 6)

`solve` solves this for pan, tilt and r. Its closed form is exact for any eps where dz = 0. For dz != 0 the range
depends on the tilt: a few rounds of the closed form come close, and Newton's method removes the rest.

The inverse is written by coordinates, in floats, because an array of one target takes twenty times as long.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import cv2
import numpy as np

from cotarget.errors import UnreachableError
from cotarget.geometry import Array, RigidTransform, Rotation

Angle = TypeVar("Angle", float, Array)


@dataclass(frozen=True)
class HeadGeometry:
    """Deviations of a real head from crossing, perpendicular axes and exact encoders.

    Attributes:
        axis_offset: dz, from the pan axis to the tilt axis along the base's z at pan = 0 [m].
        squareness: eps, angle by which the tilt axis leans from X towards Y [rad].
        pan_scale: true pan angle turned, over the reported one.
        tilt_scale: true tilt angle turned, over the reported one.
        pan_zero: true pan where the head reports 0 [rad].
        tilt_zero: true tilt where the head reports 0 [rad].
    """

    axis_offset: float = 0.0
    squareness: float = 0.0
    pan_scale: float = 1.0
    tilt_scale: float = 1.0
    pan_zero: float = 0.0
    tilt_zero: float = 0.0

    @property
    def tilt_axis(self) -> Array:
        """Direction of the tilt axis at pan = 0, the unit vector (cos eps, sin eps, 0), (3,)."""
        return np.array([np.cos(self.squareness), np.sin(self.squareness), 0.0])

    def true_angles(self, pan: Array | float, tilt: Array | float) -> tuple[Array, Array]:
        """Convert reported pan and tilt to the axes' true angles [rad]."""
        return (
            self.pan_scale * np.asarray(pan, float) + self.pan_zero,
            self.tilt_scale * np.asarray(tilt, float) + self.tilt_zero,
        )

    def reported_angles(self, pan: Angle, tilt: Angle) -> tuple[Angle, Angle]:
        """Convert true pan and tilt to the angles that the head reports [rad]."""
        return (pan - self.pan_zero) / self.pan_scale, (tilt - self.tilt_zero) / self.tilt_scale


IDEAL_HEAD = HeadGeometry()
E2, E3 = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def base_head(pan: float, tilt: float, head: HeadGeometry = IDEAL_HEAD) -> RigidTransform:
    """Compute the forward kinematics T_base_head, the paper's P (Eq. 8 with dz and eps), from reported angles [rad].

    Positive pan turns the camera right, positive tilt up. T_base_head is the identity at true pan = tilt = 0.
    """
    true_pan, true_tilt = (float(angle) for angle in head.true_angles(pan, tilt))
    panning = cv2.Rodrigues(np.array([0.0, true_pan, 0.0]))[0]
    turned = panning @ cv2.Rodrigues(head.tilt_axis * true_tilt)[0]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turned, (panning - turned)[:, 2] * head.axis_offset
    return RigidTransform(T, normalize=False)


def base_heads(head: HeadGeometry, pan: Array, tilt: Array) -> tuple[Array, Array, Array]:
    """Compute T_base_head of many reported pan and tilt [rad], (v,) each.

    Returns its rotations (v, 3, 3) and translations (v, 3), and the rotations A of tilt alone (v, 3, 3).
    """
    pan, tilt = head.true_angles(pan, tilt)
    turns = Rotation.from_rotvec(np.multiply.outer(pan, E2)).as_matrix()
    A = Rotation.from_rotvec(np.multiply.outer(tilt, head.tilt_axis)).as_matrix()
    offset = head.axis_offset * (E3 - A @ E3)  # Trans(dz) A Trans(-dz) is A with this translation
    return turns @ A, np.einsum("vij,vj->vi", turns, offset), A


def by_axes(head: HeadGeometry, A: Array, x_head: Array) -> Array:
    """Compute the derivatives of x_head by dz and by eps, (v, N, 3, 2).

    With A the rotation of tilt, x_head = A^T (q - dz e3) + dz e3 where q = Rot(Y, -pan) x_base.
    """
    by_dz = np.broadcast_to((E3 - A[:, 2])[:, None], x_head.shape)  # A^T e3 is A's third row
    # A = Rot(Z, eps) Rot(X, tilt) Rot(Z, -eps), so dA^T/deps = [e3]x A^T - A^T [e3]x
    a = x_head - head.axis_offset * E3
    u = a @ A.swapaxes(1, 2)
    by_eps = np.cross(E3, a) - np.cross(E3, u) @ A
    return np.stack([by_dz, by_eps], axis=-1)


def by_turn(head: HeadGeometry, A: Array, x_head: Array) -> Array:
    """Compute the derivatives of x_head by true pan and true tilt, (v, N, 3, 2), with A and q as in `by_axes`."""
    a = x_head - head.axis_offset * E3
    q = a @ A.swapaxes(1, 2) + head.axis_offset * E3
    by_pan = -np.cross(E2, q) @ A  # dq/dpan = -e2 x q, then A^T
    by_tilt = -np.cross(head.tilt_axis, a)
    return np.stack([by_pan, by_tilt], axis=-1)


def towards(x_base: Array) -> tuple[float, float]:
    """Compute the pan and tilt [rad] that point the z axis of an ideal head's platform at a target x_base [m], (3,).

    This ignores T_head_zoom, the pose of the camera on the head.
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
    """Compute T_zoom_fixed, from the fixed camera to the zoom camera moved by reported pan and tilt [rad] (Eq. 2)."""
    return T_head_zoom.inv() * base_head(pan, tilt, head).inv() * T_head_zoom * T_zoom0_fixed


# Rounds of the closed form for dz != 0. Each shrinks the error by dz / range, a thousandfold for a usual head.
CLOSED_FORM_ROUNDS = 4
# Newton's method converges quadratically from the closed form; only near the pan axis, where the branches meet, does it
# need many steps.
NEWTON_STEPS = 40
# Newton's method has converged when the residual over the distance is a few units in the last place.
ROUNDING = 4 * np.finfo(float).eps
# A solution is accepted when it misses by less than this angle [rad], 6e-10 degrees; rounding stays far below.
ACCEPTED_MISS = 1e-11
# Longest Newton step of an axis [rad]: where the branches meet, a full step would leave its branch.
LONGEST_STEP = 0.2
# A Jacobian with a smaller determinant has no inverse.
SINGULAR = np.finfo(float).tiny
TURN = 2.0 * np.pi
NOWHERE = (math.nan, math.nan, math.nan)
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Pointing:
    """Pan, tilt and range that bring a target onto a ray of the zoom camera.

    Each is a float, or an array (..., 2) with one value per branch.

    Attributes:
        pan: reported pan [rad].
        tilt: reported tilt [rad].
        range: distance from the zoom camera to the target along the ray [m].
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
    """Solve pan, tilt and range exactly, in both branches (Eqs. 6, 13, 14, 16; the range from |x_head| = |x_base|).

    The closed form is exact for dz = 0 and any eps. Newton's method carries it to dz != 0 and removes its rounding.

    Args:
        x_base: targets in the base's frame [m], (..., 3).
        T_head_zoom: pose of the zoom camera on the head, the paper's T.
        head: geometry of the head.
        ray: ray in the zoom camera's frame on which the target shall lie, of any length, (3,) or (..., 3).
        pupil: shift of the entrance pupil along the optical axis, forward from T_head_zoom [m].

    Returns:
        Reported pan and tilt, their true angles within -pi..pi, and range, each (..., 2); the first branch faces
        forward. All three are nan in a branch that does not exist, such as for a target nearer than the lever arm.
        Within half a degree of the pan axis, where the branches meet, both may be the same solution.
    """
    x_base, ray = np.broadcast_arrays(np.asarray(x_base, float), np.asarray(ray, float))
    T = T_head_zoom.as_matrix()
    R, t = T[:3, :3], T[:3, 3] + T[:3, 2] * pupil
    t[2] -= head.axis_offset
    ways: list[Triple] = []
    for x, d in zip(x_base.reshape(-1, 3), ray.reshape(-1, 3), strict=True):
        for *angles, reach in _solve_one(_floats(x), _floats(R @ d / math.hypot(*d)), _floats(t), head):
            pan, tilt = head.reported_angles(*((angle + math.pi) % TURN - math.pi for angle in angles))
            ways.append((pan, tilt, reach) if reach > 0 else NOWHERE)
    return Pointing(*np.moveaxis(np.reshape(ways, (*x_base.shape[:-1], 2, 3)), -1, 0))


def closed_form(
    x_base: Sequence[Array], d: Array, t: Array, head: HeadGeometry = IDEAL_HEAD, rounds: int = 2
) -> tuple[Array, Array, Array]:
    """Solve reported pan, tilt and range of many targets in the branch that faces forward (Eqs. 13, 14 and 16).

    This is `solve` without Newton's method, in arrays: for dz != 0 each round shrinks the error by dz over the range,
    so that two rounds leave less than 1e-6 rad from a metre on. It takes one target's time for some fifty.

    Args:
        x_base: targets in the base's frame [m], (3, ...).
        d: unit vector of the ray on which each target shall lie, in the head's frame, (3, ...).
        t: zoom camera's position in the head's frame [m], (3, ...).
        head: geometry of the head.
        rounds: rounds for dz != 0.

    Returns:
        Pan and tilt [rad] and range [m], (...) each; nan for a target nearer than the lever arm.
    """
    (a, b, c), (dx, dy, dz_ray), (tx, ty, tz) = x_base, d, t
    dz, cos_eps, sin_eps = head.axis_offset, math.cos(head.squareness), math.sin(head.squareness)
    tz = tz - dz
    along = dx * tx + dy * ty + dz_ray * tz
    free = along * along + a * a + b * b + c * c - dz * dz - (tx * tx + ty * ty + tz * tz)
    ahead: Array | float = 0.0
    with np.errstate(invalid="ignore"):
        for _ in range(1 if dz == 0 else rounds):
            reach = np.sqrt(free - 2 * dz * ahead) - along
            qx, qy, qz = reach * dx + tx, reach * dy + ty, reach * dz_ray + tz
            on_axis = cos_eps * qx + sin_eps * qy
            y, z, height = qy - on_axis * sin_eps, cos_eps * qz, b - on_axis * sin_eps
            tilt = np.arctan2(y, z) - np.arctan2(height, np.sqrt(np.maximum(y * y + z * z - height * height, 0.0)))
            cos, sin = np.cos(tilt), np.sin(tilt)  # rotate q about the tilt axis (Rodrigues)
            x = cos * qx + sin * sin_eps * qz + (1 - cos) * on_axis * cos_eps
            ahead = cos * qz + sin * (cos_eps * qy - sin_eps * qx)
        z2 = ahead + dz
        pan = np.arctan2(a * z2 - c * x, a * x + c * z2)
        return *head.reported_angles(pan, tilt), reach


def nearest(
    pointing: Pointing,
    pan_limits: tuple[float, float],
    tilt_limits: tuple[float, float],
    now: tuple[float, float] = (0.0, 0.0),
    head: HeadGeometry = IDEAL_HEAD,
) -> Pointing:
    """Choose the solution within the limits that is nearest to the head's present pan and tilt.

    The candidates are both branches of one target, each with whole turns added. The distance is the larger of the two
    axes' travels. Limits and present position are reported angles [rad].

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


def _floats(v: Array) -> Triple:
    x, y, z = v.tolist()
    return x, y, z


def _solve_one(target: Triple, d: Triple, t: Triple, head: HeadGeometry) -> list[Triple]:
    """Solve true pan, true tilt and range of one target in both branches; nan where a branch has no solution."""
    distance = math.hypot(*target)
    found = []
    for sign in (1.0, -1.0):
        try:
            pan, tilt, reach = _closed_form(target, d, t, sign, head)
        except ValueError:  # math.sqrt of a negative number: the target is nearer than the lever arm
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


def _closed_form(target: Triple, d: Triple, t: Triple, sign: float, head: HeadGeometry) -> Triple:
    """Compute true pan, true tilt and range in closed form: Eq. 13 and Eq. 16, with atan2.

    The ray d has length 1, and t is the zoom camera's position from the tilt axis, both in the head's frame. The sign
    is 1 for the branch that faces forward, -1 for the other. The result is exact for dz = 0. For dz != 0 the range
    depends on the tilt and both are iterated.
    """
    (a, b, c), dz = target, head.axis_offset
    sin_eps, cos_eps = math.sin(head.squareness), math.cos(head.squareness)
    along = d[0] * t[0] + d[1] * t[1] + d[2] * t[2]
    free = a * a + b * b + c * c - dz * dz - (t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    ahead = 0.0  # z of q after tilting
    for _ in range(1 if dz == 0 else CLOSED_FORM_ROUNDS):
        # |x_base|^2 = dz^2 + 2 dz z_tilted + |q|^2 with q = r d + t: a quadratic in the range r
        reach = math.sqrt(along * along + free - 2 * dz * ahead) - along
        qx, qy, qz = reach * d[0] + t[0], reach * d[1] + t[1], reach * d[2] + t[2]
        on_axis = cos_eps * qx + sin_eps * qy
        y, z, height = qy - on_axis * sin_eps, cos_eps * qz, b - on_axis * sin_eps
        left = y * y + z * z - height * height
        tilt = math.atan2(y, z) - math.atan2(height, sign * math.sqrt((left + abs(left)) / 2))  # Eq. 13
        x, _, ahead = _tilt((qx, qy, qz), math.cos(tilt), math.sin(tilt), head)  # Eq. 14
    z2 = ahead + dz
    return math.atan2(a * z2 - c * x, a * x + c * z2), tilt, reach  # Eq. 16


def _newton_step(
    cos_pan: float, sin_pan: float, cos_tilt: float, sin_tilt: float, reach: float,
    target: Triple, d: Triple, t: Triple, head: HeadGeometry,
) -> tuple[Triple, float, Triple]:  # fmt: skip
    """Compute the residual of Eq. 5 [m], the determinant of its Jacobian, and Newton's step times that determinant.

    The unknowns are (pan, tilt, range); the step is by Cramer's rule. All vectors are turned back by pan, which changes
    neither lengths nor determinants.
    """
    x, y, z = q = _tilt((reach * d[0] + t[0], reach * d[1] + t[1], reach * d[2] + t[2]), cos_tilt, sin_tilt, head)
    a, b, c = _pan(target, cos_pan, -sin_pan)
    ahead = z + head.axis_offset
    residual = x - a, y - b, ahead - c
    by_pan, by_tilt, by_reach = (ahead, 0.0, -x), _about_tilt_axis(q, head), _tilt(d, cos_tilt, sin_tilt, head)
    steps = _det(residual, by_tilt, by_reach), _det(by_pan, residual, by_reach), _det(by_pan, by_tilt, residual)
    return residual, _det(by_pan, by_tilt, by_reach), steps


def _pan(v: Triple, cos: float, sin: float) -> Triple:
    """Rotate a vector about Y, given the cosine and sine of pan."""
    return cos * v[0] + sin * v[2], v[1], cos * v[2] - sin * v[0]


def _tilt(v: Triple, cos: float, sin: float, head: HeadGeometry) -> Triple:
    """Rotate a vector about the tilt axis (Rodrigues), given the cosine and sine of tilt."""
    x_axis, y_axis = math.cos(head.squareness), math.sin(head.squareness)
    x, y, z = _about_tilt_axis(v, head)
    along = (1 - cos) * (v[0] * x_axis + v[1] * y_axis)
    return cos * v[0] + sin * x + along * x_axis, cos * v[1] + sin * y + along * y_axis, cos * v[2] + sin * z


def _about_tilt_axis(v: Triple, head: HeadGeometry) -> Triple:
    """Compute the cross product of the tilt axis with a vector."""
    x_axis, y_axis = math.cos(head.squareness), math.sin(head.squareness)
    return y_axis * v[2], -x_axis * v[2], x_axis * v[1] - y_axis * v[0]


def _det(a: Triple, b: Triple, c: Triple) -> float:
    """Compute the determinant of three columns."""
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])


def shortcut(
    x_fixed: Array,
    T_zoom0_fixed: RigidTransform,
    T_head_zoom: RigidTransform,
    reading: Literal["table", "example"],
) -> Pointing:
    """Solve pan and tilt as the paper does, with a depth in place of the range; kept for comparison.

    P is a rotation, so |x_head| must equal |x_base|. With a depth in place of the range it does not, and the rows of
    (7) contradict each other: (13) and (16) use the first two, and the third only chooses the sign.

    Args:
        x_fixed: targets in the fixed camera's frame [m], (..., 3).
        T_zoom0_fixed: the paper's Gamma.
        T_head_zoom: the paper's T.
        reading: depth that serves as z: "table" (Table 1) that of x_fixed, "example" (Section 4.2) that of x_zoom0.

    Returns:
        Pan, tilt and that depth, (...); nan where |b| > r1 or |a| > r2.
    """
    x_fixed = np.asarray(x_fixed, float)
    x_zoom0 = T_zoom0_fixed.apply(x_fixed.reshape(-1, 3)).reshape(x_fixed.shape)
    x_base = T_head_zoom.apply(x_zoom0.reshape(-1, 3)).reshape(x_fixed.shape)
    z = (x_fixed if reading == "table" else x_zoom0)[..., 2]
    x_head = z[..., None] * T_head_zoom.rotation.as_matrix()[:, 2] + np.asarray(T_head_zoom.translation)  # Eq. 6
    (x, y, z1), (a, b, c) = np.moveaxis(x_head, -1, 0), np.moveaxis(x_base, -1, 0)
    with np.errstate(invalid="ignore"):
        tilt = np.arctan2(y, z1) - np.arcsin(b / np.hypot(y, z1))  # Eq. 13 as printed
        z2 = np.sin(tilt) * y + np.cos(tilt) * z1  # Eq. 14
        swing = np.arccos(a / np.hypot(x, z2))
        pans = np.stack([np.arctan2(z2, x) + swing, np.arctan2(z2, x) - swing], axis=-1)  # Eq. 16
        off = np.abs(-np.sin(pans) * x[..., None] + np.cos(pans) * z2[..., None] - c[..., None])
        pan = np.where(off[..., 0] <= off[..., 1], pans[..., 0], pans[..., 1])
    return Pointing((pan + np.pi) % TURN - np.pi, tilt, np.where(np.isfinite(pan), z, np.nan))
