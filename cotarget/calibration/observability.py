"""Observability: find and name the directions of the parameters that motions or views leave undetermined.

`judge_motions` is for hand-eye motions; `weak_directions` and `name_directions` are for a rig's joint fit. A direction
is undetermined where its standard deviation exceeds a limit of use, beyond which an estimate is worthless. With every
parameter divided by its limit of use, that is an eigenvalue below 1 of the normal matrix N, the inverse covariance. The
texts say what is undetermined and which motions or views to add. Sources: docs/design-notes.md.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from scipy.linalg import eigh

from cotarget.camera import Intrinsics
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform

# Limits of use of a rotation [rad] and a position [m]. A start that is wrong by that much still leads later fits to the
# optimum.
USELESS_ROTATION = np.radians(5.0)
USELESS_POSITION = 0.5  # [m]
# Limit of use of a lens parameter, in half diagonals of the image: it moves corners near the image's edge by 50 px of
# 640 x 480, about as much as 5 degrees at a focal length of 600 px.
USELESS_SHARE, EDGE_SHARE = 0.125, 0.9
USUAL_LENS = Intrinsics((640, 480), (600.0, 600.0), (319.5, 239.5))
USELESS_SCALE = 0.1  # limit of use of an encoder's scale: 5 of 50 degrees
NO_LENSES: Mapping[str, Intrinsics] = MappingProxyType({})
TILT_BOARDS = "tilt the boards against the camera by 20 to 40 degrees, in several directions"
OUTWARD = "show boards out to the image's corners"
FARTHER = "show a larger board farther away, where the head reaches and the fixed camera still finds it"
BOTH = "show both cameras the same placements, near and far"
NEARER = "move both pan and tilt further, with boards nearer"
# Name of each parameter in messages, and the advice that determines it.
WORDS = {
    **dict.fromkeys(("fx", "fy"), ("focal length", TILT_BOARDS)),
    **dict.fromkeys(("cx", "cy"), ("principal point", TILT_BOARDS)),
    **dict.fromkeys(("k1", "k2", "k3", "p1", "p2"), ("distortion", OUTWARD)),
    **dict.fromkeys(("warp_x", "warp_y"), ("bend", TILT_BOARDS)),
    "pupil": ("pupil's shift", "show boards near and far at that focal length"),
    "axis_offset": ("axis offset", NEARER),
    "squareness": ("squareness", NEARER),
    "tilt_scale": ("scale of tilt", "add tilt"),
    "pan_scale": ("scale of pan", "add pan"),
    **dict.fromkeys(
        ("pan_zero", "tilt_zero"), ("zero angles", "hold these or T_zoom0_fixed: they have the same effect")
    ),
}
# Noise of the hand's pose perturbs the axes and makes an undetermined direction look measured. A direction must be seen
# this many times as strongly as by noise alone; below, noise biases the estimate by more than a tenth.
ABOVE_NOISE = 3.0
# Eigenvalues below this share of the largest are rounding, because the boards' poses are eliminated by subtraction.
ROUNDING = 1e-12
# All motions turn about one axis when the second singular value of their rotation vectors is below this share of the
# first. A head that only pans or only tilts leaves two of T's six numbers undetermined.
PARALLEL_SHARE = 0.05
SMALLEST_TURN = np.radians(0.5)  # smaller turns show noise rather than axes
SMALLEST_SHIFT = 1e-3  # smaller shifts show noise rather than motion [m]
# The axes of a pan-tilt head nearly cross: it shifts by at most this per radian [m/rad].
LONGEST_OFFSET = 0.05
ALIGNED = 0.99  # cosine of 8 degrees, within which two directions have one name
# A parameter takes part in the free directions where the diagonal of the projection on them exceeds this.
TAKES_PART = 0.05


@dataclass(frozen=True, eq=False)
class Observability:
    """Verdict on what motions determine of a transform."""

    determined: bool  # True if no direction is undetermined
    text: str  # the verdict in words, with what to add
    free: tuple[str, ...]  # names of what is undetermined; empty where all is determined
    directions: Array  # undetermined directions (w, d) of the transform [rad] and [m], unit vectors, (k, 6)


def spectrum(normal: Array, noise: Array) -> tuple[Array, Array]:
    """Compute how well each direction of a transform is known, against the limits of use and noise.

    This solves N v = u (L^-2 + k^2 N0) v, with N the normal matrix of a transform's (w, d), L the limits of use, k
    `ABOVE_NOISE`, and N0 the normal matrix that noise alone would show, given by its diagonal.

    Returns:
        Eigenvalues u, ascending, (6,), where u < 1 is undetermined; and the directions v, one per column, (6, 6).
    """
    bound = 1 / np.repeat([USELESS_ROTATION, USELESS_POSITION], 3) ** 2 + ABOVE_NOISE**2 * noise
    values, vectors = eigh((normal + normal.T) / 2, np.diag(bound))
    return np.asarray(values), np.asarray(vectors)


def judge_motions(normal: Array, noise: Array, motions: RigidTransform, turns_base: Array | None) -> Observability:
    """Judge what motions of the hand determine of X in A X = X B; see `spectrum` for normal and noise.

    The motions are in the hand's frame, and their rotation vectors also in the base's [rad], (n, 3), where poses are
    known.
    """
    values, vectors = spectrum(normal, noise)
    basis = vectors[:, values < 1]
    if not basis.shape[1]:
        turn, shift = (np.sqrt(np.linalg.eigvalsh(np.linalg.inv(normal)[s, s])[-1]) for s in (slice(3), slice(3, 6)))
        text = (
            f"determined: the rotation to {np.degrees(turn):.2g} degrees and the position to {1000 * shift:.2g} mm "
            "(one standard deviation of the worst direction)"
        )
        return Observability(True, text, (), np.empty((0, 6)))
    moved, axis, axis_name, advice = _how_it_moved(motions, turns_base)
    turns, shifts = _free_axes(basis)
    free = (*_along("position", "along", shifts, axis, axis_name), *_along("rotation", "about", turns, axis, axis_name))
    text = f"{moved}: the camera's {listed(free)} {'is' if len(free) == 1 else 'are'} free; {advice}"
    return Observability(False, text, free, (basis / np.linalg.norm(basis, axis=0)).T)


def weak_directions(
    normal: Array, parameters: Sequence[str], variance: float, lenses: Mapping[str, Intrinsics] = NO_LENSES
) -> Array:
    """Find the directions that a normal matrix leaves undetermined, measured by the parameters' limits of use.

    Args:
        normal: normal matrix (n, n); its inverse times the variance is the covariance.
        parameters: names of the n parameters, as in `Covariance`.
        variance: variance of one coordinate [px^2]; 0 to find what even exact corners leave undetermined.
        lenses: lenses by the prefix of their parameters' names, as in `BundleModel.lenses`; for those not given, one
            of 600 px with an image of 640 x 480.

    Returns:
        Directions (k, n) in the parameters' units, the least known first. Divided by the limits of use they are
        orthonormal; the standard deviation along each is larger than its length.

    Raises:
        CalibrationError: a parameter's name is unknown.
    """
    limits = limits_of_use(parameters, lenses)
    values, vectors = np.linalg.eigh(normal * np.outer(limits, limits))
    weak = values < max(variance, ROUNDING * values[-1])
    return (vectors[:, weak] * limits[:, None]).T


def name_directions(parameters: Sequence[str], directions: Array, lenses: Mapping[str, Intrinsics] = NO_LENSES) -> str:
    """Describe undetermined directions in words, with what to add.

    Args:
        parameters: names of the n parameters, as in `Covariance`.
        directions: independent directions in the parameters' units, (k, n), as `weak_directions` returns them.
        lenses: as in `weak_directions`.

    Returns:
        One sentence without a full stop; empty where there are no directions.

    Raises:
        CalibrationError: a parameter's name is unknown.
    """
    if not len(directions):
        return ""
    # The projection depends only on the space that the directions span.
    basis = np.linalg.qr((directions / limits_of_use(parameters, lenses)).T)[0]
    part = np.sum(basis**2, axis=1)
    reason = ""
    what: list[str] = []
    add: list[str] = []
    hand = [i for i, name in enumerate(parameters) if name.startswith("T_head_zoom.")]
    if hand and (part[hand] > TAKES_PART).any():
        head = [i for i, name in enumerate(parameters) if name.startswith("head.")]
        reason, what, add = _name_hand([parameters[i] for i in hand], _still(basis, head)[hand])
    for name, share in zip(parameters, part, strict=True):
        owner, kind = name.rsplit(".", 1)
        if share <= TAKES_PART or owner == "T_head_zoom":
            continue
        if owner == "T_zoom0_fixed":
            word, advice = "rotation" if kind.startswith("r") else "position", BOTH
        else:
            word, advice = WORDS[kind]
        what.append(f"{_owner(owner)}'s {word}")
        if not (reason and owner == "head"):  # where an axis did not move, moving it determines the head too
            add.append(advice)
    what, add = list(dict.fromkeys(what)), list(dict.fromkeys(add))
    return f"{reason}{listed(what)} {'is' if len(what) == 1 else 'are'} free; {listed(add)}"


def limits_of_use(parameters: Sequence[str], lenses: Mapping[str, Intrinsics] = NO_LENSES) -> Array:
    """Look up the limit of use of each parameter, in its unit, (n,); see `weak_directions`."""
    limits = []
    for name in parameters:
        owner, _, kind = name.rpartition(".")
        lens = lenses.get(owner, USUAL_LENS)
        f, half_px = lens.focal_px[0], math.hypot(*lens.size) / 2
        useless_px, r = USELESS_SHARE * half_px, EDGE_SHARE * half_px / f
        match kind:
            case "rx" | "ry" | "rz" | "squareness" | "pan_zero" | "tilt_zero":
                limits.append(USELESS_ROTATION)
            case "tx" | "ty" | "tz" | "axis_offset" | "pupil" | "warp_x" | "warp_y":
                limits.append(USELESS_POSITION)
            case "fx" | "fy":
                limits.append(useless_px / r)
            case "cx" | "cy":
                limits.append(useless_px)
            case "k1":
                limits.append(useless_px / (f * r**3))
            case "k2":
                limits.append(useless_px / (f * r**5))
            case "k3":
                limits.append(useless_px / (f * r**7))
            case "p1" | "p2":
                limits.append(useless_px / (3 * f * r**2))
            case "pan_scale" | "tilt_scale":
                limits.append(USELESS_SCALE)
            case _:
                raise CalibrationError(f"'{name}' is no parameter whose observability can be judged")
    return np.array(limits)


def _owner(owner: str) -> str:
    """Name the owner of parameters for messages."""
    if owner.startswith("zoom["):
        return f"the zoom camera's stop {owner[5:-1]}"
    return {"fixed": "the fixed camera", "zoom": "the zoom camera", "head": "the head", "board": "the board"}.get(
        owner, owner
    )


def _still(basis: Array, rows: Sequence[int]) -> Array:
    """Select the directions that do not change some parameters; all directions where each changes them.

    With tilt alone, an axis offset equals a shift of T_head_zoom, of which the verdict on T_head_zoom shall be free.
    """
    _, s, Vt = np.linalg.svd(basis[list(rows)])
    rank = int(np.sum(s**2 > TAKES_PART))
    return basis @ Vt[rank:].T if rank < len(Vt) else basis


def _name_hand(names: Sequence[str], basis: Array) -> tuple[str, list[str], list[str]]:
    """Describe why T_head_zoom is undetermined, from the free directions' rows (m, k) for parameters with these names.

    Returns the reason, the names of what is undetermined, and what to add.
    """
    spans = []
    for kind in ("r", "t"):
        rows = np.zeros((3, basis.shape[1]))
        for name, row in zip(names, basis, strict=True):
            if name.startswith(f"T_head_zoom.{kind}"):
                rows["xyz".index(name[-1])] = row
        U, s, _ = np.linalg.svd(rows)
        spans.append(U.T[: int(np.sum(s**2 > TAKES_PART))])
    turns, shifts = spans
    for axis, moved, other in ((1, "pan", "tilt"), (0, "tilt", "pan")):
        if all(len(span) <= 1 and (np.abs(span[:, axis]) > ALIGNED).all() for span in spans):
            words = [f"T_head_zoom's position along the {moved} axis"] * len(shifts)
            words += [f"T_head_zoom's rotation about the {moved} axis"] * len(turns)
            return f"only {moved} moved: ", words, [f"add {other}"]
    words = ["T_head_zoom's position"] * bool(len(shifts)) + ["T_head_zoom's rotation"] * bool(len(turns))
    return "", words, [NEARER]


def _how_it_moved(motions: RigidTransform, turns_base: Array | None) -> tuple[str, Array | None, str, str]:
    """Describe the hand's motions in words, by their axis (3,) where there is only one, its name, and what to add."""
    turns, shifts = motions.rotation.as_rotvec(), motions.translation
    largest = float(np.linalg.norm(turns, axis=1).max())
    moves = float(np.linalg.norm(shifts, axis=1).max())
    if largest < SMALLEST_TURN and moves < SMALLEST_SHIFT:
        return "the hand did not move between the views", None, "", "turn it about two axes (pan and tilt)"
    if largest < SMALLEST_TURN:
        return "the hand shifted but did not turn", None, "", "turn it about two axes"
    _, s, Vt = np.linalg.svd(turns, full_matrices=False)
    if len(s) > 1 and s[1] > PARALLEL_SHARE * s[0]:
        others = float(np.linalg.norm(turns - np.outer(turns @ Vt[0], Vt[0]), axis=1).max())
        moved = (
            f"motions of {np.degrees(largest):.2g} degrees at most, {np.degrees(others):.2g} about other axes than "
            f"{_vector(Vt[0])} of the hand, are too small for their noise"
        )
        return moved, None, "", "turn the hand further, about two axes, or measure more often"
    axis = Vt[0]
    if moves <= max(LONGEST_OFFSET * largest, SMALLEST_SHIFT):
        base = axis if turns_base is None else np.linalg.svd(turns_base, full_matrices=False)[2][0]
        if abs(base[1]) > ALIGNED:
            return "only pan moved", axis, "the pan axis", "add tilt"
        if abs(axis[0]) > ALIGNED:
            return "only tilt moved", axis, "the tilt axis", "add pan"
    moved = f"all motions turn about one axis, {_vector(axis)} in the hand's frame"
    return moved, axis, "that axis", "turn the hand about a second axis"


def _free_axes(basis: Array) -> tuple[Array, Array]:
    """Find the axes of the free rotations, (a, 3), and the directions of free shifts without rotation, (b, 3)."""
    scaled = basis / np.repeat([USELESS_ROTATION, USELESS_POSITION], 3)[:, None]
    scaled = np.linalg.qr(scaled)[0]
    U, s, Vt = np.linalg.svd(scaled[:3])
    rank = int(np.sum(s > np.sqrt(TAKES_PART)))
    shifts = np.linalg.svd((scaled[3:] @ Vt[rank:].T).T)[2][: len(Vt) - rank]
    return U[:, :rank].T, shifts


def _along(what: str, how: str, directions: Array, axis: Array | None, axis_name: str) -> tuple[str, ...]:
    """Name each direction, by the axis of all motions where it is aligned with it, as a vector otherwise."""
    if len(directions) == 3:
        return (what,)
    return tuple(
        f"{what} {how} {axis_name if axis is not None and abs(v @ axis) > ALIGNED else _vector(v) + ' of the hand'}"
        for v in directions
    )


def listed(items: Sequence[str]) -> str:
    """Join items as a sentence does: a, b and c."""
    return " and ".join(filter(None, (", ".join(items[:-1]), items[-1])))


def _vector(v: Array) -> str:
    """Format an axis with its largest component positive."""
    v = v * np.sign(v[np.argmax(np.abs(v))])
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in np.round(v, 2)) + ")"
