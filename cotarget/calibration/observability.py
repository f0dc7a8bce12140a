"""What motions or views leave undetermined, and what to add, in words.

A normal matrix N (the inverse of a covariance) tells how well every direction of the parameters is known. A direction v
counts as undetermined where its standard deviation is beyond use, more than `LIMITS` say; scaled by these limits, all
parameters have the same unit, and that is an eigenvalue of N below 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from cotarget.geometry import Array

# A start that is wrong by so much still leads every later fit to the optimum, and nobody would call it measured.
USELESS_ROTATION = np.radians(5.0)
USELESS_POSITION = 0.5  # [m]
# A lens parameter wrong by so much moves corners at the edge of a usual image (0.6 focal lengths off its middle) by
# some 50 px, as much as 5 degrees do at a focal length of 600 px.
LIMITS = {
    **dict.fromkeys(("rx", "ry", "rz", "squareness"), USELESS_ROTATION),
    **dict.fromkeys(("tx", "ty", "tz", "axis_offset"), USELESS_POSITION),
    **dict.fromkeys(("fx", "fy", "cx", "cy"), 50.0),  # [px]
    "k1": 0.4,
    "k2": 1.0,
    "p1": 0.1,
    "p2": 0.1,
}
# Noise of the hand's own pose turns axes about and makes a direction look measured that is not. It has to be seen by
# this many times as much as by noise alone; below, the estimate would be drawn towards noise by more than a tenth.
ABOVE_NOISE = 3.0
# Eigenvalues below this share of the largest are rounding.
ROUNDING = 1e-14
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


def _how_it_moved(motions: HandMotions) -> tuple[str, Array | None, str, str]:
    """What the hand did, its only axis and the name of that (None and nothing where there are more), what to add."""
    turns, shifts = motions.turns, motions.shifts
    largest = float(np.linalg.norm(turns, axis=1).max())
    moves = float(np.linalg.norm(shifts, axis=1).max())
    if largest < SMALLEST_TURN and moves < SMALLEST_SHIFT:
        return "the hand did not move between the views", None, "", "turn it about two axes (pan and tilt)"
    if largest < SMALLEST_TURN:
        return "the hand shifted but did not turn", None, "", "turn it about two axes"
    _, s, Vt = np.linalg.svd(turns)
    if len(s) > 1 and s[1] > PARALLEL_SHARE * s[0]:
        advice = "turn the hand further, and about two axes, or measure more often"
        return (
            f"the motions, of {np.degrees(largest):.2g} degrees at most, are too small for their noise",
            None,
            "",
            advice,
        )
    axis = Vt[0]
    if moves <= max(LONGEST_OFFSET * largest, SMALLEST_SHIFT):
        base = axis if motions.turns_base is None else np.linalg.svd(motions.turns_base)[2][0]
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
