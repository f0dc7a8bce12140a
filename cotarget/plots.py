"""Plots of a run, by matplotlib."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cotarget.metrics import Row


def plot_aim_error(path: Path, rows: Mapping[str, Sequence[Row]]) -> None:
    """Draw the target's offset from the centre of the zoom image over time, one panel a target, into a PNG."""
    with matplotlib.rc_context({"font.size": 9}):
        figure = Figure(figsize=(8, 2.4 * len(rows)), layout="constrained")
        FigureCanvasAgg(figure)
        for ax, (name, run) in zip(np.atleast_1d(figure.subplots(len(rows), 1)), rows.items(), strict=True):
            t = np.array([row.t_s for row in run])
            offset = np.array([100 * row.tpo_px / row.width_px if row.inside else np.nan for row in run])
            ax.plot(t, offset, lw=1.2, color="#1f6f8b")
            out = np.array([not row.in_frame and row.in_wide for row in run])
            ax.fill_between(t, 0, 50, where=out, color="#d9534f", alpha=0.15, lw=0, label="not in the close-up")
            ax.set(ylim=(0, 50), xlim=(t[0], t[-1]), ylabel="offset [% of width]", title=name)
            zoom = ax.twinx()
            zoom.semilogy(t, [row.focal_px for row in run], lw=0.8, color="#999999")
            zoom.set_ylabel("focal length [px]", color="#777777")
            ax.legend(loc="upper center", frameon=False)
        ax.set_xlabel("time [s]")
        figure.savefig(path, dpi=110)
