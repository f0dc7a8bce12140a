"""Plots of a run, by matplotlib."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from cotarget.metrics import Row

OFFSET, FOCAL = "#1f6f8b", "#777777"  # colours of the curves
ROOM = 1.25  # above and below the focal lengths, as a factor


def plot_aim_error(path: Path, rows: Mapping[str, Sequence[Row]]) -> None:
    """Draw the target's offset from the centre of the zoom image over time, one panel a target, into a PNG."""
    with matplotlib.rc_context({"font.size": 9}):
        aim_error_figure(rows).savefig(path, dpi=110)


def aim_error_figure(rows: Mapping[str, Sequence[Row]]) -> Figure:
    """The same as a figure, with the legend beside the panels and not on them."""
    focals = [end(row.focal_px for run in rows.values() for row in run) for end in (min, max)]
    figure = Figure(figsize=(8, 2.4 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    for ax, (name, run) in zip(np.atleast_1d(figure.subplots(len(rows), 1)), rows.items(), strict=True):
        t = np.array([row.t_s for row in run])
        offset = np.array([100 * row.tpo_px / row.width_px if row.inside else np.nan for row in run])
        ax.plot(t, offset, lw=1.2, color=OFFSET, label="offset from the centre of the zoom image")
        out = np.array([not row.in_frame and row.in_wide for row in run])
        ax.fill_between(
            t, 0, 50, where=out, color="#d9534f", alpha=0.15, lw=0, label="in the wide view, not in the close-up"
        )
        ax.set(ylim=(0, 50), xlim=(t[0], t[-1]), ylabel="offset [% of width]", title=name)
        zoom = ax.twinx()
        zoom.semilogy(t, [row.focal_px for row in run], lw=1.0, ls="--", color=FOCAL, label="focal length")
        zoom.set_ylim(focals[0] / ROOM, focals[1] * ROOM)
        zoom.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        zoom.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        zoom.yaxis.set_minor_locator(NullLocator())
        zoom.set_ylabel("focal length [px]", color=FOCAL)
    ax.set_xlabel("time [s]")
    drawn = [handle for axes in (ax, zoom) for handle in axes.get_legend_handles_labels()[0]]
    figure.legend(handles=drawn, loc="outside upper center", ncols=len(drawn), frameon=False)
    return figure
