"""What to do to make a calibration better, told by its own figures."""

from collections.abc import Iterator

import numpy as np

from cotarget.calibration.model import Calibration
from cotarget.calibration.observability import BOTH, NEARER, OUTWARD, TILT_BOARDS
from cotarget.calibration.plan import distance
from cotarget.report.evidence import CAMERAS, BoardShape, Evidence, averaged, empty_places, head_poses
from cotarget.report.figures import NAMES
from cotarget.report.pointing import (
    JITTER_GROUP,
    MORE_PLACEMENTS,
    AtFocal,
    Contribution,
    corner_errors,
    placements,
    uncalibrated_px,
    undetermined,
    what_stays,
    with_more_placements,
)
from cotarget.report.wording import count, digits, listed, percent

ACTIONS = {
    "the fixed camera's lens": f"in the fixed camera's view, {OUTWARD}, and {TILT_BOARDS}",
    "the zoom camera's lens": f"in the zoom camera's view, {OUTWARD}, and {TILT_BOARDS}",
    "the zoom lens's pupil": "show boards near and far at the long focal lengths",
    "the offset between the cameras": BOTH,
    "the zoom camera's place on the head": NEARER,
    "the head's axes": NEARER,
    "the encoders": "calibrate with --encoders, and move both pan and tilt from end to end",
}
WORTH_SAYING = 0.1  # share of the squared error
MUCH_WORSE = 3.0  # than in the middle
PATTERN = 0.1  # share of averages beyond chance, ten times what chance gives or more
FAR_SHARE, FEW_FAR = 0.5, 0.25  # farther than half-way on the plan's scale; fewer placements than this are few
LEAST_TURN = np.radians(10.0)  # of each axis of the head, over all poses
TURNED, FEW_TURNED = np.radians(20.0), 1 / 3  # boards that tell the focal length, and fewer than this are few
FEWEST_AT_STOP = 6  # views
FEWEST_SHARED = 5  # placements seen by both cameras, so that some can be kept out
MANY_REJECTED, MANY_WRONG = 0.2, 0.01  # of the images, of the corners


def advice(
    calibration: Calibration,
    at: tuple[AtFocal, ...],
    between: tuple[AtFocal, ...],
    parts: tuple[Contribution, ...],
    evidence: Evidence | None,
) -> list[str]:
    """Say what would help most, in that order; empty where nothing stands out."""
    items = [*_disagreement(calibration), *_missing(calibration), *_unconfirmed(calibration)]
    items += [*_largest_part(at, parts), *_between_stops(at, between), *_worst_corner(calibration, at)]
    if evidence is not None:
        items += [*_images(calibration, evidence), *_patterns(evidence), *_situation(calibration, evidence)]
        items += _more_of_the_same(calibration, at)
    return items


def _missing(calibration: Calibration) -> Iterator[str]:
    """What is not there at all."""
    if open_ := undetermined(calibration):
        yield f"Add what is missing: {open_}."
    if calibration.T_head_zoom is None:
        yield "Calibrate on a rig whose head moves: two cameras alone cannot be pointed."
    if calibration.provenance.get("method") == "sequential":
        yield "Calibrate again by the joint method, from the same captures: it points better and says how well."
    elif calibration.covariance is None:
        yield "Add captures until the method can tell an uncertainty: more placements, near and far, in both cameras."


def _disagreement(calibration: Calibration) -> Iterator[str]:
    """What captures kept out of the fit find wrong."""
    held_out = calibration.held_out
    if held_out is not None and held_out.widened > 1:
        yield (
            f"Captures kept out miss {digits(held_out.widened)} times as far as they should, so that something is not "
            "as the model has it: a board that is bent or not printed to scale, a mount that gives way, a lens that "
            "moved between captures. More captures will not mend that."
        )


def _unconfirmed(calibration: Calibration) -> Iterator[str]:
    """What is missing so that captures could be kept out."""
    if calibration.held_out is None and calibration.covariance is not None and calibration.provenance.get("folds"):
        shared = [{v.board for v in calibration.views if v.camera == camera} for camera in CAMERAS]
        number = len(shared[0] & shared[1])
        yield (
            f"Show both cameras {FEWEST_SHARED} placements or more ({number} so far), so that some can be kept out of "
            "the fit and confirm it."
        )


def _largest_part(at: tuple[AtFocal, ...], parts: tuple[Contribution, ...]) -> Iterator[str]:
    """Where the error comes from."""
    total = at[-1].rms if at else 0.0
    if not total > 0:
        return
    for part in parts[:2]:
        share = 1 - (part.left / total) ** 2
        if not share > WORTH_SAYING:
            return
        gain = f"the error would be {_degrees(part.left)} instead of {_degrees(total)} degrees"
        if part.group == JITTER_GROUP:
            yield (
                f"The head itself makes {percent(share)} of the squared error; without its jitter {gain}. Look for "
                "play in the gears, cables that pull, a mount that gives way, and wait longer after a move; more "
                "captures will not help."
            )
        else:
            action = ACTIONS.get(part.group, BOTH)
            yield f"Were {part.group} known exactly, {gain}: {action}."


def _between_stops(at: tuple[AtFocal, ...], between: tuple[AtFocal, ...]) -> Iterator[str]:
    """Where the zoom lens is interpolated too far."""
    worst = max(between, key=lambda one: one.rms, default=None)
    if worst is not None and worst.rms > MUCH_WORSE * max(stop.rms for stop in at):
        yield (
            f"Between the zoom lens's stops it is only interpolated: at {worst.nominal_px:.0f} px by the lens's own "
            f"account the error is {_degrees(worst.rms)} degrees. Add a stop there."
        )


def _worst_corner(calibration: Calibration, at: tuple[AtFocal, ...]) -> Iterator[str]:
    """Where in the wide view pointing is much worse than in its middle."""
    if not at:
        return
    middle, corners = corner_errors(calibration, at[-1].nominal_px)
    name, error = max(corners.items(), key=lambda item: item[1], default=("", 0.0))
    if error > MUCH_WORSE * middle:
        yield (
            f"In the {name} corner of the wide view the error is {_degrees(error)} degrees, {digits(error / middle)} "
            "times that in the middle: hold boards there, as far out as they are still seen."
        )


def _images(calibration: Calibration, evidence: Evidence) -> Iterator[str]:
    """Images and corners that were left out."""
    residuals = calibration.residuals
    if residuals is None:
        return
    used, rejected = residuals.fixed_views + residuals.zoom_views, len(residuals.rejected)
    if rejected > MANY_REJECTED * (used + rejected):
        yield f"{rejected} of {used + rejected} images were not used; the reasons are above."
    corners = sum(len(evidence.corners[name].seen_px) for name in CAMERAS)
    if residuals.outliers > MANY_WRONG * corners:
        yield (
            f"{count(residuals.outliers, 'corner')} of {corners + residuals.outliers} were left out as wrong: look for "
            "blur, glare, and a board that is not flat."
        )


def board_in_words(shape: BoardShape) -> str:
    """Say how far the board's corners are off."""
    number = int(shape.beyond_chance.sum())
    if not number:
        return "The board's corners are where they are believed to be, as far as noise lets see."
    return (
        f"{number} of the board's {len(shape.beyond_chance)} corners are off by more than chance makes them: of all "
        f"corners {digits(1000 * shape.within)} mm within the board and {digits(1000 * shape.out)} mm out of it (rms)."
    )


def _patterns(evidence: Evidence) -> Iterator[str]:
    """What the residuals have in common."""
    if evidence.shape.wrong:
        yield (
            f"{board_in_words(evidence.shape)} Measure the board, and mount it on something flat: what is predicted "
            "here does not count it."
        )
    for name in CAMERAS:
        cells = averaged(evidence.corners[name])
        known, beyond = int(np.isfinite(cells.means[:, 0]).sum()), int(cells.beyond_chance.sum())
        if beyond > PATTERN * known:
            yield (
                f"The {NAMES[name]}'s residuals keep a pattern: {beyond} of {known} averages are larger than chance "
                "makes them. The lens may bend the image as its model cannot, or the board is bent."
            )


def _situation(calibration: Calibration, evidence: Evidence) -> Iterator[str]:
    """Where boards were not, and how the head did not move."""
    for name in CAMERAS:
        places = empty_places(evidence.corners[name])
        if places:
            yield (
                f"Hold boards where the {NAMES[name]} saw none: at the {listed(places)} of its image. What is "
                "predicted there is an extrapolation."
            )
    number = len(evidence.distances)
    turned = int(np.count_nonzero(evidence.leanings >= TURNED))
    if turned < FEW_TURNED * number:
        yield f"Only {turned} of {count(number, 'placement')} were turned by 20 degrees or more: {TILT_BOARDS}."
    if calibration.T_head_zoom is None or calibration.board is None:
        return
    limit = distance(calibration.board, calibration.fixed, FAR_SHARE)
    far = int(np.count_nonzero(evidence.distances > limit))
    if far < FEW_FAR * number:
        yield (
            f"Only {far} of {count(number, 'placement')} are farther than {digits(limit)} m: add far ones, which tell "
            "the directions of the cameras best."
        )
    poses = head_poses(evidence.views)
    for axis, turn in zip(("pan", "tilt"), np.ptp(poses, axis=0) if len(poses) else (), strict=False):
        if turn < LEAST_TURN:
            yield f"The head's {axis} changed by {digits(np.degrees(turn))} degrees in all: {NEARER}."
    for nominal, views in zip(calibration.zoom.nominal_px, evidence.per_stop, strict=True):
        if views < FEWEST_AT_STOP:
            yield f"The stop at {nominal:.0f} px has {count(views, 'view')}: add some, {FEWEST_AT_STOP} at least."
    if (longest := uncalibrated_px(calibration)) is not None:
        yield (
            f"The lens goes to {longest:.0f} px by its own account, but was calibrated to "
            f"{calibration.zoom.nominal_px[-1]:.0f} px: no part of a board was seen beyond. Hold boards far away "
            "where the head reaches, with squares that still show several corners there."
        )
    zooms = any(view.focal_px is not None for view in evidence.views if view.camera == "zoom")
    if zooms and len(calibration.zoom.stops) == 1:
        yield (
            f"Only one focal length was calibrated, {calibration.zoom.nominal_px[0]:.0f} px by the lens's own account. "
            "If the lens zooms, capture boards at several: the longest is where an error shows most, and nothing here "
            "speaks of it."
        )


def _more_of_the_same(calibration: Calibration, at: tuple[AtFocal, ...]) -> Iterator[str]:
    """What more placements of the same kind would bring."""
    total = at[-1].rms if at else 0.0
    if not total > 0:
        return
    number = placements(calibration)
    text = (
        f"{MORE_PLACEMENTS} more placements of the same kind as these {number} would bring the error from "
        f"{_degrees(total)} to {_degrees(with_more_placements(calibration, at[-1]))} degrees"
    )
    stays2 = what_stays(calibration, at[-1]) ** 2
    if 4 * stays2 < total**2:
        more = int(np.ceil(number * ((total**2 - stays2) / (total**2 / 4 - stays2) - 1)))
        yield f"{text}; {more} more would halve it."
    else:
        yield f"{text}; no number of them would halve it, because the head's jitter stays."


def _degrees(angle: float) -> str:
    return digits(float(np.degrees(angle)))
