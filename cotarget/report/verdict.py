"""Whether to trust a calibration, in one sentence."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from cotarget.calibration.model import Calibration
from cotarget.report.evidence import Evidence, gather
from cotarget.report.pointing import DEPTHS, AtFocal, between_stops, pointing, sigma_of, uncalibrated_px, undetermined
from cotarget.report.wording import digits, percent

Level = Literal["good", "care", "bad", "unknown"]
LABELS: dict[Level, str] = {
    "good": "It points, and says how well",
    "care": "It points, but read on",
    "bad": "Do not rely on it",
    "unknown": "It does not say how well it points",
}
# Stops whose errors differ by less than this factor are spoken of together.
ALIKE = 1.25
# Shares of the close-up's width by which a target may be off the middle: beyond the first it is worth a word, beyond
# the second it is not in the picture.
FAR_OFF, OUT_OF_SIGHT = 0.05, 0.5
# Corners explained so many times worse than was recorded are other corners; exact ones are rounded to the floor.
CONTRADICTION, RECORDED_FLOOR_PX = 3.0, 1e-3
TOO_CAREFUL = 0.6  # misses below this share of what was predicted are no chance either
MOSTLY = 0.5  # share of the squared error


@dataclass(frozen=True)
class Verdict:
    """The sentence, and how it is meant."""

    text: str
    level: Level


def verdict(calibration: Calibration) -> str:
    """Say in one sentence how well a calibration points, and whether captures kept out of its fit agree."""
    return judge(calibration).text


def judge(
    calibration: Calibration,
    at: tuple[AtFocal, ...] | None = None,
    between: tuple[AtFocal, ...] | None = None,
    evidence: Evidence | None = None,
) -> Verdict:
    """Give the verdict on a calibration.

    Args:
        calibration: of any kind.
        at: what `pointing` gives of its stops, where that is known already.
        between: what it gives of `between_stops`, likewise.
        evidence: what `gather` gives of it, likewise.
    """
    if calibration.T_head_zoom is None:
        return Verdict(_without_head(calibration), "unknown")
    if calibration.covariance is None:
        return _without_covariance(calibration)
    mismatch = _mismatch(calibration)
    if open_ := undetermined(calibration):
        return Verdict(_sentence([*mismatch, f"does not determine the rig: {open_}"]), "bad")
    evidence = gather(calibration) if evidence is None else evidence
    if evidence is not None and _contradicts(calibration, evidence):
        return Verdict(
            "Does not explain the corners that are stored with it: they are not what it was made from.", "bad"
        )
    at = pointing(calibration) if at is None else at
    between = pointing(calibration, between_stops(calibration)) if between is None else between
    if not np.isfinite(at[-1].rms):
        return Verdict("Reaches no point of the wide view with the head: its geometry cannot be right.", "bad")
    width = calibration.zoom.size[0]
    level: Level = "care" if mismatch or calibration.held_out is None else "good"
    parts = [*mismatch, _how_well(at, between)]
    if at[-1].rms_px > FAR_OFF * width:
        level = "bad" if at[-1].rms_px > OUT_OF_SIGHT * width else "care"
        parts.append(f"that is {percent(at[-1].rms_px / width)} of the close-up's width")
    if (longest := uncalibrated_px(calibration)) is not None:
        level = "care" if level == "good" else level
        parts.append(f"the lens goes to {longest:.0f} px by its own account, and nothing is known of it beyond these")
    if calibration.jitter:
        level = "care" if level == "good" else level
        parts.append(_jitter(calibration, at[-1]))
    if evidence is not None and evidence.shape.wrong:
        level = "care" if level == "good" else level
        size = digits(1000 * np.hypot(evidence.shape.within, evidence.shape.out))
        parts.append(f"not counting that the board's corners are {size} mm off where they are believed to be")
    if calibration.held_out is None:
        parts.append("no captures were kept out of the fit to confirm it")
    elif calibration.held_out.ratio < TOO_CAREFUL:
        level = "care" if level == "good" else level
        parts.append(
            f"captures kept out of the fit miss only {digits(calibration.held_out.ratio)} times as far as that"
        )
    elif not mismatch:
        parts.append("captures kept out of the fit agree")
    return Verdict(_sentence(parts), level)


def _sentence(parts: list[str]) -> str:
    text = "; ".join(parts)
    return f"{text[0].upper()}{text[1:]}."


def _contradicts(calibration: Calibration, evidence: Evidence) -> bool:
    """Whether the stored corners are explained far worse than was recorded."""
    r = calibration.residuals
    if r is None:
        return False
    recorded = (r.fixed_rms_px, r.zoom_rms_px, r.stereo_rms_px or 0.0, r.handeye_rms_px or 0.0, RECORDED_FLOOR_PX)
    sigma = max(corners.sigma for corners in evidence.corners.values())
    return np.sqrt(2) * sigma > CONTRADICTION * max(recorded)


def _how_well(at: tuple[AtFocal, ...], between: tuple[AtFocal, ...]) -> str:
    last = at[-1]
    which = "the longest focal length calibrated" if len(at) > 1 else "the one focal length calibrated"
    in_px = f"{digits(last.rms_px)} px at {last.focal_px:.0f} px, {which}"
    text = f"points to {digits(np.degrees(last.rms))} degrees ({in_px})"
    worst = max((*at, *between), key=lambda one: one.rms)
    if worst.rms > ALIKE * last.rms:
        where = f"between its stops, at {worst.focal_px:.0f} px" if worst in between else f"at {worst.focal_px:.0f} px"
        text += f" and to {digits(np.degrees(worst.rms))} degrees ({digits(worst.rms_px)} px) {where}"
    near, far = DEPTHS
    return f"{text}, one standard deviation, all over the wide view from {near:g} to {far:g} m"


def _jitter(calibration: Calibration, last: AtFocal) -> str:
    share = min(2 * calibration.jitter**2 / last.rms**2, 1.0)
    angle = digits(np.degrees(calibration.jitter))
    if share > MOSTLY:
        return f"most of it because the head misses what it reports by {angle} degrees an axis, at every pose anew"
    return f"in it the {angle} degrees by which each axis of the head misses what it reports"


def _mismatch(calibration: Calibration) -> list[str]:
    """That captures kept out of the fit disagree, where they do, which comes before all that it makes wider."""
    held_out = calibration.held_out
    if held_out is None or held_out.widened <= 1:
        return []
    factor = digits(held_out.widened)
    return [
        f"captures kept out of the fit miss {factor} times as far as was predicted, and the uncertainty is widened so"
    ]


def _without_head(calibration: Calibration) -> str:
    parts = ["cannot point, because it was made without a head", *_mismatch(calibration)]
    residuals, covariance = calibration.residuals, calibration.covariance
    if residuals is not None and residuals.stereo_rms_px is not None:
        parts.append(f"the two cameras agree on the corners to {digits(residuals.stereo_rms_px)} px")
    if covariance is not None:
        if open_ := undetermined(calibration):
            parts.append(f"it does not determine the cameras either: {open_}")
        else:
            turn, shift = (
                np.sqrt(sum((sigma_of(calibration, f"T_zoom0_fixed.{kind}{axis}") or 0.0) ** 2 for axis in "xyz"))
                for kind in "rt"
            )
            parts.append(
                f"the offset between them is known to {digits(1000 * shift)} mm and {digits(np.degrees(turn))} degrees"
            )
    return _sentence(parts)


def _without_covariance(calibration: Calibration) -> Verdict:
    method = calibration.provenance.get("method")
    residuals = calibration.residuals
    fits = ""
    if residuals is not None and residuals.handeye_rms_px is not None:
        fits = f"; its corners are explained to {digits(residuals.handeye_rms_px)} px, which tells little of pointing"
    if method == "sequential":
        return Verdict(
            f"Does not say how well it points, because the sequential method gives no uncertainty{fits}.", "unknown"
        )
    if method == "joint":
        return Verdict(
            f"Leaves some of its parameters undetermined, so that it cannot say how well it points{fits}.", "bad"
        )
    return Verdict(f"Does not say how well it points, because it carries no uncertainty{fits}.", "unknown")
