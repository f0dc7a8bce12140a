"""How the report's pictures look, and the pictures of what the corners say."""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cotarget.report.evidence import CAMERAS, Corners, Evidence, averaged, counts, head_poses
from cotarget.report.lenscurves import LensCurves
from cotarget.report.wording import digits

INK, BLUE, ORANGE, RED, GREY, PALE = "#22303c", "#1f6f8b", "#c8702a", "#b5403a", "#8a97a3", "#e3e8ec"
WIDTH = 8.6  # inches: the page's column
PNG_DPI = 170
HEAT = "viridis"
NAMES = {"fixed": "fixed camera", "zoom": "zoom camera"}
STYLE = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": PALE,
    "grid.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "svg.hashsalt": "cotarget",
}
# A typical arrow is drawn so long, as a share of the image's width.
ARROW_SHARE = 0.02
NICE = (1, 2, 5)
HISTOGRAM_SIGMAS = 5.0
BINS = 60


@contextmanager
def styled(height: float, width: float = WIDTH) -> Iterator[Figure]:
    """Give an empty figure [inches]; everything drawn in the context has the report's style."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def as_bytes(figure: Figure, kind: str, dpi: int = PNG_DPI) -> bytes:
    """Render a figure as "png" or "svg"; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    metadata = {"Date": None, "Creator": None} if kind == "svg" else {"Software": None}
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=metadata)
        figure.set_layout_engine("none")  # it is laid out now, also for the next time
    return buffer.getvalue()


def as_image(ax: Any, size: tuple[int, int]) -> None:
    """Make axes look like an image of that size (width, height) [px]."""
    width, height = size
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    ax.grid(visible=False)
    ax.set_xticks([0, width // 2, width])
    ax.set_yticks([0, height // 2, height])
    for spine in ax.spines.values():
        spine.set_visible(True)


def magnification(corners: Corners) -> float:
    """A round factor at which a typical residual is an arrow that is seen."""
    if not corners.sigma:
        return 1.0
    wanted = ARROW_SHARE * corners.size[0] / corners.sigma
    power = 10 ** np.floor(np.log10(wanted))
    return float(max(n * power for n in NICE if n * power <= wanted))


def residual_figure(evidence: Evidence) -> Figure:
    """Draw every corner's residual as an arrow, and their averages over cells, for both cameras."""
    shown = [name for name in CAMERAS if len(evidence.corners[name].seen_px)]
    with styled(2.9 * len(shown)) as figure:
        for row, name in zip(figure.subplots(len(shown), 2, squeeze=False), shown, strict=True):
            corners = evidence.corners[name]
            factor = magnification(corners)
            as_image(row[0], corners.size)
            _arrows(row[0], corners.seen_px, corners.residuals, factor, np.linalg.norm(corners.residuals, axis=-1))
            row[0].set_title(f"{NAMES[name]}: every corner, ×{factor:g}")
            cells = averaged(corners)
            factor = magnification(corners) * 4
            as_image(row[1], corners.size)
            row[1].scatter(*corners.seen_px.T, s=1.5, color=PALE, lw=0)
            for those, colour in ((~cells.beyond_chance, GREY), (cells.beyond_chance, RED)):
                middles, means = cells.middles[those], cells.means[those]
                row[1].quiver(
                    *middles.T,
                    *(factor * means).T,
                    color=colour,
                    angles="xy",
                    scale_units="xy",
                    scale=1,
                    width=0.004,
                    in_layout=False,  # an arrow out of the image shall not push it aside
                )
            row[1].set_title(f"{NAMES[name]}: averages, ×{factor:g}")
        return figure


def _arrows(ax: Any, at: Any, residuals: Any, factor: float, lengths: Any) -> None:
    order = np.argsort(lengths)
    drawn = ax.quiver(
        *at[order].T,
        *(factor * residuals[order]).T,
        lengths[order],
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.0014,
        cmap="viridis_r",
        alpha=0.75,
        clim=(0, np.percentile(lengths, 99) if len(lengths) else 1),
        in_layout=False,
    )
    ax.figure.colorbar(drawn, ax=ax, label="length [px]", shrink=0.8, pad=0.02)


def histogram_figure(evidence: Evidence) -> Figure:
    """Draw the residuals' coordinates against the Gaussian of their standard deviation."""
    shown = [name for name in CAMERAS if len(evidence.corners[name].residuals)]
    with styled(2.6) as figure:
        for ax, name in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
            corners = evidence.corners[name]
            reach = HISTOGRAM_SIGMAS * corners.sigma
            edges = np.linspace(-reach, reach, BINS + 1)
            x = np.linspace(-reach, reach, 400)
            gauss = np.exp(-(x**2) / 2 / corners.sigma**2) / (corners.sigma * np.sqrt(2 * np.pi))
            width, number = edges[1] - edges[0], len(corners.residuals)
            for k, (label, colour) in enumerate((("across (u)", BLUE), ("down (v)", ORANGE))):
                ax.hist(
                    np.clip(corners.residuals[:, k], -reach, reach),
                    edges,
                    histtype="stepfilled" if k == 0 else "step",
                    color=colour,
                    alpha=0.45 if k == 0 else 1.0,
                    lw=1.3,
                    label=label,
                )
            ax.plot(x, gauss * number * width, color=INK, lw=1.2, label=f"Gaussian, {digits(corners.sigma)} px")
            ax.set(title=NAMES[name], xlabel="residual [px]", ylabel="corners", xlim=(-reach, reach))
            ax.legend(fontsize=8, loc="upper right", handlelength=1.2)
        return figure


def coverage_figure(evidence: Evidence) -> Figure:
    """Draw where corners were seen in both images, every single one over counts."""
    shown = [name for name in CAMERAS if len(evidence.corners[name].seen_px)]
    with styled(3.3) as figure:
        for ax, name in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
            corners = evidence.corners[name]
            as_image(ax, corners.size)
            number = counts(corners)
            width, height = corners.size
            drawn = ax.imshow(
                np.where(number > 0, number, np.nan),
                cmap="Blues",
                vmin=0,
                extent=(-0.5, width - 0.5, height - 0.5, -0.5),
            )
            ax.set_facecolor("#f6d9d5")
            ax.scatter(*corners.seen_px.T, s=0.8, color=INK, lw=0, alpha=0.5)
            ax.set_title(NAMES[name])
            figure.colorbar(drawn, ax=ax, orientation="horizontal", label="corners in a cell", shrink=0.8, pad=0.03)
        return figure


def situation_figure(evidence: Evidence, nominal_px: tuple[float, ...], has_head: bool) -> Figure:
    """Draw how far the boards were and how they were turned, the head's poses, and the views of every stop."""
    several = len(nominal_px) > 1
    with styled(2.7) as figure:
        axes = figure.subplots(1, 2 + has_head + several, squeeze=False)[0].tolist()
        ax = axes.pop(0)
        edges = np.geomspace(evidence.distances.min() * 0.98, evidence.distances.max() * 1.02, 11)
        ax.hist(evidence.distances, edges, color=BLUE, alpha=0.8)
        ax.set(title="distance of the boards", xlabel="[m]", ylabel="placements", xscale="log")
        ticks = np.unique([float(f"{t:.2g}") for t in np.geomspace(edges[0], edges[-1], 4)])
        ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
        ax.minorticks_off()
        ax = axes.pop(0)
        ax.hist(np.degrees(evidence.leanings), np.arange(0, 91, 7.5), color=BLUE, alpha=0.8)
        ax.set(title="turned from facing", xlabel="[degrees]", ylabel="placements", xlim=(0, 90))
        if has_head:
            ax = axes.pop(0)
            ax.scatter(*np.degrees(head_poses(evidence.views)).T, s=12, color=ORANGE, alpha=0.7, lw=0)
            ax.set(title="head poses", xlabel="pan [degrees]", ylabel="tilt [degrees]")
            ax.axis("equal")
        if several:
            ax = axes.pop(0)
            ax.bar(range(len(nominal_px)), evidence.per_stop, color=BLUE, alpha=0.8)
            ax.set_xticks(range(len(nominal_px)), [f"{n:.0f}" for n in nominal_px], rotation=45)
            ax.set(title="views of each stop", xlabel="nominal focal length [px]", ylabel="views")
        return figure


def lens_figure(curves: LensCurves) -> Figure:
    """Draw the zoom lens over its focal lengths, one standard deviation about every curve."""
    panels = (
        ("true over nominal focal length", "", {"ratio_x": "across", "ratio_y": "down"}),
        ("principal point from its mean", "[px]", {"cx": "across", "cy": "down"}),
        ("distortion of the image, κ₁", "", {"kappa1": ""}),
        ("entrance pupil", "[mm]", {"pupil_mm": ""}),
    )
    with styled(5.0) as figure:
        for ax, (title, unit, names) in zip(figure.subplots(2, 2, sharex=True).flat, panels, strict=True):
            for (name, label), colour in zip(names.items(), (BLUE, ORANGE), strict=False):
                shift = curves.at_stops[name].mean() if name in ("cx", "cy") else 0.0
                y = curves.values[name] - shift
                text = f"{label} ({digits(shift, 4)} px)" if shift else label
                ax.plot(curves.nominal_px, y, color=colour, lw=1.5, label=text)
                if name in curves.sigmas:
                    s = curves.sigmas[name]
                    ax.fill_between(curves.nominal_px, y - s, y + s, color=colour, alpha=0.2, lw=0)
                stops = np.array(curves.stops_px)
                ax.plot(stops, curves.at_stops[name] - shift, "o", ms=4, color=colour)
            ax.set(title=title, ylabel=unit, xscale="log")
            ax.ticklabel_format(axis="y", useOffset=False)
            focal_ticks(ax, curves.stops_px)
            if len(names) > 1:
                ax.legend(fontsize=8)
        figure.supxlabel("nominal focal length [px]", fontsize=9)
        return figure


def focal_ticks(ax: Any, stops_px: Sequence[float]) -> None:
    """Mark the stops themselves on a logarithmic axis, as many as there is room for."""
    shown = stops_px if len(stops_px) <= 7 else stops_px[:: -(-len(stops_px) // 6)]
    ax.set_xticks(shown, [f"{n:.0f}" for n in shown])
    ax.minorticks_off()
