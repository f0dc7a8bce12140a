"""Pan-tilt kinematics: forward, the exact inverse for any wanted pixel, and the paper's shortcut beside it.

The head turns as T_base_head = Rot(Y, pan) Trans(0, 0, dz) Rot(cos(eps) X + sin(eps) Y, tilt) Trans(0, 0, -dz); an
ideal head has dz = eps = 0. A target x_base is on the ray d of the zoom camera when some range r makes

    T_base_head(pan, tilt) T_head_zoom (r d) = x_base                                                  (Eqs. 2, 6)
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from cotarget.errors import UnreachableError
from cotarget.geometry import Array, RigidTransform, Rotation, angle_between, rot_y

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
TURN = 2.0 * np.pi


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


def zoom_fixed(
    pan: float,
    tilt: float,
    T_head_zoom: RigidTransform,
    T_zoom0_fixed: RigidTransform,
    head: HeadGeometry = IDEAL_HEAD,
) -> RigidTransform:
    """Where the fixed camera is seen from the moved zoom camera: T_zoom_fixed (Eq. 2)."""
    return T_head_zoom.inv() * base_head(pan, tilt, head).inv() * T_head_zoom * T_zoom0_fixed


def solve(
    x_base: Array,
    T_head_zoom: RigidTransform,
    head: HeadGeometry = IDEAL_HEAD,
    ray: Array | tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Pointing:
    """Solve pan, tilt and range exactly, in both branches (Eqs. 6, 13, 16 and the norm's quadratic for the range).

    The closed form holds for an ideal head; Newton's steps carry it to a head with an axis offset and axes that
    are not square, and take the closed form's own rounding away.

    Args:
        x_base: targets in the base's frame [m], (..., 3).
        T_head_zoom: the zoom camera's place on the head.
        head: the unit's own geometry.
        ray: the zoom camera's ray that shall meet the target, of any length, (3,) or (..., 3).

    Returns:
        Pan and tilt as the head reports them, their true angles within -pi..pi, and range, each (..., 2); the first
        branch is the one that faces forward. All three are nan in a branch that does not exist, as for a target
        nearer than the lever arm. Within half a degree of the pan axis, where the branches meet, both may be the same
        solution.
    """
    x_base, ray = np.broadcast_arrays(np.asarray(x_base, float), np.asarray(ray, float))
    d = T_head_zoom.rotation.as_matrix() @ (ray / np.linalg.norm(ray, axis=-1, keepdims=True))[..., None]
    d, t = d[..., 0], np.asarray(T_head_zoom.translation)
    with np.errstate(invalid="ignore", divide="ignore"):
        start = _closed_form(x_base, d, t, head)
        pan, tilt, reach = _newton(*start, x_base, d, t, head)
    found = reach > 0
    wrapped = head.reported_angles(*((angle + np.pi) % TURN - np.pi for angle in (pan, tilt)))
    return Pointing(*(np.where(found, value, np.nan) for value in (*wrapped, reach)))


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
    for pan, tilt, reach in zip(pointing.pan, pointing.tilt, pointing.range, strict=True):
        if not np.isfinite(pan + tilt + reach):
            continue
        for p in pan + TURN / head.pan_scale * np.arange(-2, 3):
            for q in tilt + TURN / head.tilt_scale * np.arange(-1, 2):
                if pan_limits[0] <= p <= pan_limits[1] and tilt_limits[0] <= q <= tilt_limits[1]:
                    travel = max(abs(p - now[0]), abs(q - now[1]))
                    candidates.append((travel, p, q, reach))
    if candidates:
        _, p, q, reach = min(candidates)
        return Pointing(p, q, reach)
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


def _closed_form(x_base: Array, d: Array, t: Array, head: HeadGeometry) -> tuple[Array, Array, Array]:
    """Both branches (pan, tilt, range), each (..., 2), in the atan2 forms of (13) and (16).

    Exact for dz = 0. With an axis offset the range depends on the tilt, and a few rounds bring both together; each
    takes off a factor of dz / range.
    """
    a, b, c = np.moveaxis(x_base[..., None, :], -1, 0)
    sin_eps, cos_eps = np.sin(head.squareness), np.cos(head.squareness)
    dz = np.array([0.0, 0.0, head.axis_offset])
    along, lever = np.sum(d * (t - dz), axis=-1)[..., None], np.sum((t - dz) ** 2)
    ahead = np.zeros((*x_base.shape[:-1], 2))  # the z of q after tilting
    for _ in range(1 if head.axis_offset == 0 else CLOSED_FORM_ROUNDS):
        # |x_base|^2 = dz^2 + 2 dz z_tilted + |q|^2 with q = r d + t - dz: a quadratic in the range r
        norm2 = np.sum(x_base**2, axis=-1)[..., None] - head.axis_offset**2 - 2 * head.axis_offset * ahead
        reach = np.sqrt(along**2 + norm2 - lever) - along
        q = reach[..., None] * d[..., None, :] + t - dz
        on_axis = cos_eps * q[..., 0] + sin_eps * q[..., 1]
        y, z, height = q[..., 1] - on_axis * sin_eps, cos_eps * q[..., 2], b - on_axis * sin_eps
        root = np.sqrt(np.maximum(y * y + z * z - height * height, 0.0)) * np.array([1.0, -1.0])
        tilt = np.arctan2(y, z) - np.arctan2(height, root)  # (13)
        turned = _turn(head.tilt_axis, tilt, q)  # (14)
        ahead = turned[..., 2]
    x, z2 = turned[..., 0], turned[..., 2] + head.axis_offset
    pan = np.arctan2(a * z2 - c * x, a * x + c * z2)  # (16)
    return pan, tilt, reach


def _newton(
    pan: Array, tilt: Array, reach: Array, x_base: Array, d: Array, t: Array, head: HeadGeometry
) -> tuple[Array, Array, Array]:
    """Polish (pan, tilt, range), each (..., 2), until base_head(pan, tilt) (range d + t) = x_base; nan if it fails."""
    shape = (*pan.shape, 3)
    unknowns = np.stack([pan, tilt, reach], axis=-1).reshape(-1, 3)
    target, d = (np.broadcast_to(v[..., None, :], shape).reshape(-1, 3) for v in (x_base, d))
    distance = np.linalg.norm(target, axis=-1)
    error = np.full(len(unknowns), np.inf)
    active = np.arange(len(unknowns))
    for _ in range(NEWTON_STEPS):
        residual, J = _residual(unknowns[active], target[active], d[active], t, head)
        error[active] = np.linalg.norm(residual, axis=-1)
        going_on = error[active] > ROUNDING * distance[active]
        # A singular J (a target on the pan axis) can go no further and is left to the final check.
        going_on &= np.abs(np.linalg.det(J)) > np.finfo(float).tiny
        active = active[going_on]
        if not len(active):
            break
        step = np.linalg.solve(J[going_on], residual[going_on][..., None])[..., 0]
        longest = np.max(np.abs(step[:, :2]), axis=-1, keepdims=True)
        unknowns[active] -= step * np.minimum(1.0, LONGEST_STEP / np.maximum(longest, LONGEST_STEP))
    unknowns[error > ACCEPTED_MISS * distance] = np.nan
    pan, tilt, reach = np.moveaxis(unknowns.reshape(shape), -1, 0)
    return pan, tilt, reach


def _residual(unknowns: Array, target: Array, d: Array, t: Array, head: HeadGeometry) -> tuple[Array, Array]:
    """base_head(pan, tilt) (range d + t) - x_base, (n, 3), and its derivative by (pan, tilt, range), (n, 3, 3)."""
    pan, tilt, reach = unknowns.T
    dz, axis, e_y = np.array([0.0, 0.0, head.axis_offset]), head.tilt_axis, np.array([0.0, 1.0, 0.0])
    q = _turn(axis, tilt, reach[:, None] * d + t - dz)
    reached = _turn(e_y, pan, q + dz)
    J = np.stack(
        [_cross(e_y, reached), _turn(e_y, pan, _cross(axis, q)), _turn(e_y, pan, _turn(axis, tilt, d))], axis=-1
    )
    return reached - target, J


def _turn(axis: Array, angle: Array, v: Array) -> Array:
    """Rodrigues' rotation of vectors (..., 3) about a unit axis (3,) by angles (...)."""
    c, s = np.cos(angle)[..., None], np.sin(angle)[..., None]
    return c * v + s * _cross(axis, v) + (1 - c) * (v @ axis)[..., None] * axis


def _cross(axis: Array, v: Array) -> Array:
    """Cross product of one vector (3,) with vectors (..., 3); numpy's own takes ten times as long for a few."""
    x, y, z = axis
    return v @ np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
