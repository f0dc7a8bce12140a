"""Pictures of the predicted pointing error: over the wide view, over depth and over focal length."""

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from cotarget.calibration.model import Calibration
from cotarget.calibration.uncertainty import predicted_pointing
from cotarget.geometry import Array
from cotarget.report.figures import BLUE, HEAT, INK, ORANGE, as_image, focal_ticks, styled
from cotarget.report.pointing import DEPTHS, AtFocal, sample_depths
from cotarget.report.wording import digits

MAP_DEPTHS = 3
GRID = (29, 22)  # samples across and down the map
CONTOUR_SHARES = (0.15, 0.4, 0.65, 0.9)  # of the view, over all depths, inside each contour
TICKS = 5
LOG_RATIO = 8.0  # from where on colours go by the logarithm
CURVE_REACH = 3.0  # the curve goes so many times nearer and farther than targets are
CURVE_POINTS = 60


def map_figure(calibration: Calibration, at: AtFocal) -> Figure:
    """Draw the predicted error over the wide view at three depths, in degrees and in px at the longest focal length."""
    width, height = calibration.fixed.size
    u, v = np.linspace(0, width - 1, GRID[0]), np.linspace(0, height - 1, GRID[1])
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    depths = sample_depths(MAP_DEPTHS)
    errors = np.degrees(predicted_pointing(calibration, pixels[None], depths[:, None, None], nominal_px=at.nominal_px))
    limits = float(np.nanmin(errors)) * 0.99, float(np.nanmax(errors)) * 1.01
    norm = (LogNorm if limits[1] > LOG_RATIO * limits[0] else Normalize)(*limits)
    levels = np.unique([float(digits(level)) for level in np.nanquantile(errors, CONTOUR_SHARES)])
    with styled(3.3) as figure:
        axes = figure.subplots(1, MAP_DEPTHS, sharey=True)
        for ax, depth, error in zip(axes, depths, errors, strict=True):
            as_image(ax, (width, height))
            drawn = ax.imshow(
                error,
                norm=norm,
                cmap=HEAT,
                interpolation="bilinear",
                extent=(-0.5, width - 0.5, height - 0.5, -0.5),
            )
            inside = levels[(levels > np.nanmin(error)) & (levels < np.nanmax(error))]
            if len(inside):
                lines = ax.contour(u, v, error, inside, colors="white", linewidths=0.8)
                ax.clabel(lines, fontsize=7.5, fmt=digits)
            ax.set_title(f"{depth:.0f} m")
        bar = figure.colorbar(drawn, ax=axes, orientation="horizontal", shrink=0.75, aspect=45, pad=0.06)
        ticks = _steps(*limits, TICKS)
        two_lines = [f"{digits(t)}°\n{digits(np.radians(t) * at.focal_px)} px" for t in ticks]
        bar.set_ticks(ticks.tolist(), labels=two_lines)
        bar.ax.minorticks_off()
        bar.set_label(f"predicted error, one standard deviation; px at a focal length of {at.focal_px:.0f} px")
        return figure


def _steps(low: float, high: float, number: int) -> Array:
    """Values between two others, evenly, or over their logarithm where they are far apart."""
    return (np.geomspace if high > LOG_RATIO * low else np.linspace)(low, high, number)


def _pixels(focal_px: float) -> tuple[Any, Any]:
    """Between degrees and px."""
    return (lambda d: np.radians(d) * focal_px, lambda p: np.degrees(p / focal_px))


def depth_figure(calibration: Calibration, at: AtFocal, boards: Array | None) -> Figure:
    """Draw the predicted error over depth at the wide view's middle and corners; boards are their distances [m]."""
    depths = np.geomspace(DEPTHS[0] / CURVE_REACH, DEPTHS[1] * CURVE_REACH, CURVE_POINTS)
    width, height = calibration.fixed.size
    corners = np.array([(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)], dtype=float)
    with styled(3.0) as figure:
        ax = figure.subplots()
        middle = calibration.fixed.image_center_px
        for pixels, label, colour in (
            (middle[None], "middle of the wide view", BLUE),
            (corners, "its worst corner", ORANGE),
        ):
            error = predicted_pointing(calibration, pixels[None], depths[:, None], nominal_px=at.nominal_px)
            worst = np.fmax.reduce(error, axis=1)  # nan only where no corner is reached
            ax.plot(depths, np.degrees(worst), color=colour, lw=1.6, label=label)
        ax.set_ylim(bottom=0)
        ax.axvspan(*DEPTHS, color=BLUE, alpha=0.06, lw=0, label="range of the verdict")
        boards = np.empty(0) if boards is None else boards[(boards > depths[0]) & (boards < depths[-1])]
        if len(boards):
            ax.plot(boards, np.zeros(len(boards)), "|", color=INK, ms=12, clip_on=False, label="boards")
        ax.set(xscale="log", xlabel="depth [m]", ylabel="predicted error [degrees]", xlim=(depths[0], depths[-1]))
        ticks = [t for t in (1, 2, 5, 10, 20, 50, 100) if depths[0] <= t <= depths[-1]]
        ax.set_xticks(ticks, [str(t) for t in ticks])
        ax.minorticks_off()
        px = ax.secondary_yaxis("right", functions=_pixels(at.focal_px))
        px.set_ylabel(f"[px] at {at.focal_px:.0f} px")
        ax.legend(ncols=2, fontsize=8)
        return figure


def focal_figure(stops: tuple[AtFocal, ...], between: tuple[AtFocal, ...]) -> Figure:
    """Draw the predicted error over focal length, rms over the wide view and the depths, in degrees and in px."""
    curve = sorted((*stops, *between), key=lambda at: at.nominal_px)
    with styled(2.7) as figure:
        for ax, unit in zip(figure.subplots(1, 2), ("degrees", "px in the zoom image"), strict=True):
            for those, look in ((curve, "-"), (stops, "o")):
                y = [np.degrees(at.rms) if unit == "degrees" else at.rms_px for at in those]
                ax.plot([at.nominal_px for at in those], y, look, color=BLUE, lw=1.6, ms=4)
            ax.set(xscale="log", xlabel="nominal focal length [px]", ylabel=f"[{unit}]", title="predicted error")
            ax.set_ylim(bottom=0)
            focal_ticks(ax, [stop.nominal_px for stop in stops])
        return figure
