"""What motions or views leave undetermined, and what to add, in words.

`judge_motions` speaks of hand-eye motions, `weak_directions` and `name_directions` of a rig's joint fit. A normal
matrix N (the inverse of a covariance) tells how well every direction of the parameters is known. A direction counts as
undetermined where its standard deviation is beyond use; divided by these limits of use, all parameters have the same
unit, and that is an eigenvalue of N below 1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from scipy.linalg import eigh

from cotarget.errors import CalibrationError
from cotarget.geometry import Array

# A start that is wrong by so much still leads every later fit to the optimum, and nobody would call it measured.
USELESS_ROTATION = np.radians(5.0)
USELESS_POSITION = 0.5  # [m]
# A lens parameter is of no use when it is wrong by so much that corners at the image's edge move by 50 px, about as
# much as 5 degrees do at a focal length of 600 px.
USELESS_PX = 50.0
EDGE_PX = 360.0  # from the middle of a usual image to its edge
USUAL_FOCAL_PX = 600.0
USELESS_SCALE = 0.1  # of an encoder: of 50 degrees, 5 degrees
NO_FOCAL_PX: Mapping[str, float] = MappingProxyType({})
TILT_BOARDS = "tilt the boards against the camera by 20 to 40 degrees, in several directions"
OUTWARD = "show boards out to the image's corners"
BOTH = "show both cameras the same placements, near and far"
NEARER = "move both pan and tilt further, with boards nearer"
# How people call a parameter, and what determines it.
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
    **dict.fromkeys(("pan_zero", "tilt_zero"), ("zero angles", "hold these or T_zoom0_fixed: they say the same")),
}
# Noise of the hand's own pose turns axes about and makes a direction look measured that is not. It has to be seen by
# this many times as much as by noise alone; below, the estimate would be drawn towards noise by more than a tenth.
ABOVE_NOISE = 3.0
# Eigenvalues below this share of the largest are rounding, where boards' poses were eliminated by subtraction.
ROUNDING = 1e-12
# Axes of rotation are one when the second singular value of all rotation vectors is below this share of the first: a
# head that only pans or only tilts leaves two of T's six numbers free.
PARALLEL_SHARE = 0.05
SMALLEST_TURN = np.radians(0.5)  # motions below this say more about noise than about axes
SMALLEST_SHIFT = 1e-3  # [m]; likewise
# A pan-tilt head's axes nearly cross: it shifts by no more than this for every radian [m].
LONGEST_OFFSET = 0.05
ALIGNED = 0.99  # cosine of 8 degrees: directions nearer than that have one name
# A parameter takes part in free directions where they hold this share of it (the diagonal of the projection on them).
TAKES_PART = 0.05


@dataclass(frozen=True, eq=False)
class Observability:
    """What motions determine of a transform.

    Attributes:
        determined: whether nothing is free.
        text: the verdict in words, with what to add.
        free: what is undetermined, in words; empty where all is determined.
        directions: the free directions (w, d) of the transform [rad] and [m], unit vectors, (k, 6).
    """

    determined: bool
    text: str
    free: tuple[str, ...]
    directions: Array


@dataclass(frozen=True, eq=False)
class HandMotions:
    """How the hand moved, as far as words about it need.

    Attributes:
        turns: rotation vectors in the hand's frame [rad], (n, 3).
        shifts: translations in the hand's frame [m], (n, 3).
        turns_base: the rotation vectors in the base's frame, (n, 3); None where only motions are known.
    """

    turns: Array
    shifts: Array
    turns_base: Array | None = None


def spectrum(normal: Array, noise: Array) -> tuple[Array, Array]:
    """Solve N v = u (L^-2 + k^2 N0) v, with L the limits of use, k `ABOVE_NOISE` and N0 what noise alone would show.

    Args:
        normal: N of a transform's (w, d), (6, 6) [1/rad^2, 1/m^2].
        noise: the diagonal of N0, (6,).

    Returns:
        u, ascending, (6,); a direction is undetermined where u < 1. And the directions, (6, 6), one a column.
    """
    bound = 1 / np.repeat([USELESS_ROTATION, USELESS_POSITION], 3) ** 2 + ABOVE_NOISE**2 * noise
    values, vectors = eigh((normal + normal.T) / 2, np.diag(bound))
    return np.asarray(values), np.asarray(vectors)


def judge_motions(normal: Array, noise: Array, motions: HandMotions) -> Observability:
    """Say in words what motions determine of X in A X = X B; see `spectrum` for normal and noise."""
    values, vectors = spectrum(normal, noise)
    basis = vectors[:, values < 1]
    if not basis.shape[1]:
        turn, shift = (np.sqrt(np.linalg.eigvalsh(np.linalg.inv(normal)[s, s])[-1]) for s in (slice(3), slice(3, 6)))
        text = (
            f"determined: the rotation to {np.degrees(turn):.2g} degrees and the position to {1000 * shift:.2g} mm "
            "(one standard deviation of the worst direction)"
        )
        return Observability(True, text, (), np.empty((0, 6)))
    moved, axis, axis_name, advice = _how_it_moved(motions)
    turns, shifts = _free_axes(basis)
    free = (*_along("position", "along", shifts, axis, axis_name), *_along("rotation", "about", turns, axis, axis_name))
    text = f"{moved}: the camera's {_listed(free)} {'is' if len(free) == 1 else 'are'} free; {advice}"
    return Observability(False, text, free, (basis / np.linalg.norm(basis, axis=0)).T)


def weak_directions(
    normal: Array, parameters: Sequence[str], variance: float, focal_px: Mapping[str, float] = NO_FOCAL_PX
) -> Array:
    """Find what a normal matrix leaves undetermined, judged in units that matter.

    Args:
        normal: (n, n), its inverse times the variance being the covariance.
        parameters: names, n of them, as in `Covariance`.
        variance: of one coordinate [px^2]; 0 for what is undetermined however exact the corners are.
        focal_px: of lenses whose focal length is far from 600 px, by the part of the name in front of the point.

    Returns:
        Directions (k, n) in the parameters' units, the least known first. Divided by the parameters' limits of use they
        are orthonormal; the standard deviation of each is larger than it is long.

    Raises:
        CalibrationError: a name is none that is known.
    """
    limits = limits_of_use(parameters, focal_px)
    values, vectors = np.linalg.eigh(normal * np.outer(limits, limits))
    weak = values < max(variance, ROUNDING * values[-1])
    return (vectors[:, weak] * limits[:, None]).T


def name_directions(parameters: Sequence[str], directions: Array, focal_px: Mapping[str, float] = NO_FOCAL_PX) -> str:
    """Say in words what is undetermined, and what to add.

    Args:
        parameters: names, n of them, as in `Covariance`.
        directions: in their units, independent of each other, (k, n); as `weak_directions` gives them.
        focal_px: as there.

    Returns:
        One sentence without a full stop; empty where there are no directions.

    Raises:
        CalibrationError: a name is none that is known.
    """
    if not len(directions):
        return ""
    # The projection on the directions does not depend on which of them span the same space.
    basis = np.linalg.qr((directions / limits_of_use(parameters, focal_px)).T)[0]
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
        if not (reason and owner == "head"):  # then the missing axis is all it takes
            add.append(advice)
    what, add = list(dict.fromkeys(what)), list(dict.fromkeys(add))
    return f"{reason}{_listed(what)} {'is' if len(what) == 1 else 'are'} free; {_listed(add)}"


def limits_of_use(parameters: Sequence[str], focal_px: Mapping[str, float] = NO_FOCAL_PX) -> Array:
    """By how much each parameter must be wrong to be of no use, in its unit, (n,); see `weak_directions`."""
    limits = []
    for name in parameters:
        owner, _, kind = name.rpartition(".")
        f = focal_px.get(owner, USUAL_FOCAL_PX)
        r = EDGE_PX / f
        match kind:
            case "rx" | "ry" | "rz" | "squareness" | "pan_zero" | "tilt_zero":
                limits.append(USELESS_ROTATION)
            case "tx" | "ty" | "tz" | "axis_offset" | "pupil" | "warp_x" | "warp_y":
                limits.append(USELESS_POSITION)
            case "fx" | "fy":
                limits.append(USELESS_PX / r)
            case "cx" | "cy":
                limits.append(USELESS_PX)
            case "k1":
                limits.append(USELESS_PX / (f * r**3))
            case "k2":
                limits.append(USELESS_PX / (f * r**5))
            case "k3":
                limits.append(USELESS_PX / (f * r**7))
            case "p1" | "p2":
                limits.append(USELESS_PX / (3 * f * r**2))
            case "pan_scale" | "tilt_scale":
                limits.append(USELESS_SCALE)
            case _:
                raise CalibrationError(f"'{name}' is no parameter whose observability can be judged")
    return np.array(limits)


def _owner(owner: str) -> str:
    """How people call a block of parameters."""
    if owner.startswith("zoom["):
        return f"the zoom camera's stop {owner[5:-1]}"
    return {"fixed": "the fixed camera", "zoom": "the zoom camera", "head": "the head", "board": "the board"}.get(
        owner, owner
    )


def _still(basis: Array, rows: Sequence[int]) -> Array:
    """Those of the directions that leave some parameters as they are; all where each of them changes these.

    With tilt alone, an axis offset is nothing but a shift of T_head_zoom: that is not to hide why both are free.
    """
    _, s, Vt = np.linalg.svd(basis[list(rows)])
    rank = int(np.sum(s**2 > TAKES_PART))
    return basis @ Vt[rank:].T if rank < len(Vt) else basis


def _name_hand(names: Sequence[str], basis: Array) -> tuple[str, list[str], list[str]]:
    """Why T_head_zoom is free, what of it, and what to add; basis: its rows of all free directions, (m, k)."""
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


def _how_it_moved(motions: HandMotions) -> tuple[str, Array | None, str, str]:
    """What the hand did, its only axis and the name of that (None and nothing where there are more), what to add."""
    turns, shifts = motions.turns, motions.shifts
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
        base = axis if motions.turns_base is None else np.linalg.svd(motions.turns_base, full_matrices=False)[2][0]
        if abs(base[1]) > ALIGNED:
            return "only pan moved", axis, "the pan axis", "add tilt"
        if abs(axis[0]) > ALIGNED:
            return "only tilt moved", axis, "the tilt axis", "add pan"
    moved = f"all motions turn about one axis, {_vector(axis)} in the hand's frame"
    return moved, axis, "that axis", "turn the hand about a second axis"


def _free_axes(basis: Array) -> tuple[Array, Array]:
    """Axes of the free rotations, and directions of the free shifts that need no rotation, (a, 3) and (b, 3)."""
    scaled = basis / np.repeat([USELESS_ROTATION, USELESS_POSITION], 3)[:, None]
    scaled = np.linalg.qr(scaled)[0]
    U, s, Vt = np.linalg.svd(scaled[:3])
    rank = int(np.sum(s > np.sqrt(TAKES_PART)))
    shifts = np.linalg.svd((scaled[3:] @ Vt[rank:].T).T)[2][: len(Vt) - rank]
    return U[:, :rank].T, shifts


def _along(what: str, how: str, directions: Array, axis: Array | None, axis_name: str) -> tuple[str, ...]:
    """Name each direction: as the axis of all motions where it is that, as a vector otherwise."""
    if len(directions) == 3:
        return (what,)
    return tuple(
        f"{what} {how} {axis_name if axis is not None and abs(v @ axis) > ALIGNED else _vector(v) + ' of the hand'}"
        for v in directions
    )


def _listed(items: Sequence[str]) -> str:
    """Join as people do: a, b and c."""
    return " and ".join(filter(None, (", ".join(items[:-1]), items[-1])))


def _vector(v: Array) -> str:
    """Write an axis with its largest component positive."""
    v = v * np.sign(v[np.argmax(np.abs(v))])
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in np.round(v, 2)) + ")"
