"""Draw Steps and runs: frames side by side, one picture for each target, and plots of the aim error over time."""

import math
import textwrap
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from cotarget.files import write_whole
from cotarget.geometry import Array
from cotarget.metrics import Row
from cotarget.pipeline import State, Step
from cotarget.rig import Image

OFFSET, FOCAL = "#1f6f8b", "#777777"  # colours of the curves
ROOM = 1.25  # margin above and below the focal lengths, as a factor


def plot_aim_error(path: Path, rows: Mapping[str, Sequence[Row]]) -> None:
    """Plot the target's offset from the zoom image's centre over time, one panel for each target, into a PNG."""
    with matplotlib.rc_context({"font.size": 9}):
        aim_error_figure(rows).savefig(path, dpi=110)


def aim_error_figure(rows: Mapping[str, Sequence[Row]]) -> Figure:
    """Make the figure of `plot_aim_error`, with the legend outside the panels."""
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


FOUND, FOLLOWED, CROSS, INK, PAPER, ARROW = (
    (190, 190, 0),
    (0, 200, 255),
    (80, 220, 80),
    (40, 40, 40),
    (250, 250, 250),
    (0, 120, 235),
)
STRIP_PX = 36  # height of a caption
SIZE_KNOWN_S = 1.5  # time after which a target's size is known: it may have been clipped, or not seen with wings spread
RECENT_STEPS = 16  # states kept to interpolate the lens at a frame's exposure; more than any latency needs
# Largest deviations for a picture of the close-up: of the focal length (relative), and of the target (over the width).
SETTLED = 0.08
CENTRED = 0.04  # largest distance of a target from the centre that is shown as centred, over the image's width
REASON_SCALE, REASON_LETTER_PX, REASON_LINE_PX, REASON_MARGIN_PX = 0.45, 8, 16, 8  # few letters are wider
BOX_MARGIN_PX = 4  # distance of a drawn box from the target


def write_text(image: Image, text: str, at: Sequence[float] | Array, scale: float = 0.55, *, halo: bool = True) -> None:
    """Write text into an image in dark ink, with a light halo for pictures as a background."""
    u, v = round(at[0]), round(at[1])
    font = cv2.FONT_HERSHEY_SIMPLEX
    for du, dv in ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, 1), (-1, 1), (1, -1)) if halo else ():
        cv2.putText(image, text, (u + du, v + dv), font, scale, PAPER, 1, cv2.LINE_AA)
    cv2.putText(image, text, (u, v), font, scale, INK, 1, cv2.LINE_AA)


def write_picture(path: Path, image: Image) -> None:
    """Write an image as PNG, in one step.

    Raises:
        ConfigError: the file cannot be written.
    """
    write_whole(path, cv2.imencode(".png", image)[1].tobytes())


def captioned(image: Image, text: str) -> Image:
    """Append a caption below an image."""
    strip = np.full((STRIP_PX, image.shape[1], 3), PAPER, np.uint8)
    write_text(strip, text, (10, STRIP_PX - 12), halo=False)
    return np.vstack([image, strip])


def draw_wide(step: Step) -> Image:
    """Draw the fixed camera's frame with every confirmed track's box, the followed one in another colour, (H, W, 3)."""
    image = step.fixed.image.copy()
    for track in step.tracks:
        if not track.confirmed:
            continue
        followed = step.target is not None and track.id == step.target.id
        half = track.size_px / 2 + BOX_MARGIN_PX
        low, high = np.rint(track.center_px - half).astype(int), np.rint(track.center_px + half).astype(int)
        colour = FOLLOWED if followed else FOUND
        cv2.rectangle(image, low.tolist(), high.tolist(), colour, 2 if followed else 1, cv2.LINE_AA)
        write_text(image, f"{track.id}", (high[0] + 3, low[1] + 10))
    return image


def draw_zoom(step: Step) -> Image:
    """Draw the zoom camera's frame with a small cross at its centre."""
    image = step.zoom.image.copy()
    u, v = image.shape[1] // 2, image.shape[0] // 2
    for a, b in (
        ((u - 12, v), (u - 4, v)),
        ((u + 4, v), (u + 12, v)),
        ((u, v - 12), (u, v - 4)),
        ((u, v + 4), (u, v + 12)),
    ):
        cv2.line(image, a, b, CROSS, 1, cv2.LINE_AA)
    return image


def side_by_side(step: Step, title: str) -> Image:
    """Draw one frame of the video: both cameras' frames, with the detection and the state of the pipeline."""
    pan, tilt = np.degrees(step.head.pan), np.degrees(step.head.tilt)
    depth = f"depth {step.aim.depth:5.1f} m" if step.aim is not None else ""
    wide = captioned(
        _explained(draw_wide(step), step.reason), f"{title}   t = {step.fixed.t:5.2f} s   {step.state}   {depth}"
    )
    zoomed = draw_zoom(step)
    if zoomed.shape[0] < step.fixed.image.shape[0]:  # enlarge a small viewfinder frame to the fixed frame's height
        factor = step.fixed.image.shape[0] / zoomed.shape[0]
        zoomed = np.asarray(cv2.resize(zoomed, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC), np.uint8)
    close = captioned(
        zoomed,
        f"zoom view   pan {pan:6.2f}   tilt {tilt:6.2f} deg   focal length {step.lens.focal_px:5.0f} px",
    )
    height = max(wide.shape[0], close.shape[0])
    padded = [
        cv2.copyMakeBorder(i, 0, height - i.shape[0], 0, 0, cv2.BORDER_CONSTANT, value=PAPER) for i in (wide, close)
    ]
    return np.hstack(padded)


def _explained(image: Image, reason: str) -> Image:
    """Write the reason of a state at the bottom of an image, wrapped to its width."""
    lines = textwrap.wrap(reason, max(1, (image.shape[1] - 2 * REASON_MARGIN_PX) // REASON_LETTER_PX))
    for number, line in enumerate(reversed(lines)):
        at = (REASON_MARGIN_PX, image.shape[0] - REASON_MARGIN_PX - number * REASON_LINE_PX)
        write_text(image, line, at, REASON_SCALE)
    return image


class TargetStages:
    """Choose the Steps for the picture of a target: before, centred, and close-up.

    It uses what the pipeline itself knows: the target's place in a zoom frame, and the reported focal length at the
    frame's exposure.
    """

    def __init__(self, shortest_px: float) -> None:
        """Create an empty choice; ``shortest_px`` is the shortest nominal focal length."""
        self._shortest = shortest_px
        self._largest, self._widest, self._since = 0.0, math.inf, math.inf
        self._recent: deque[Step] = deque(maxlen=RECENT_STEPS)
        self.before: Step | None = None
        self.centred: Step | None = None
        self.close: Step | None = None

    def see(self, step: Step) -> None:
        """Consider a Step."""
        self._recent.append(step)
        if self.before is None or (step.target is None and self.centred is None):
            self.before = step
        if step.state is not State.FOLLOWING or step.aim is None or step.target is None:
            return
        focal_px, away = self._focal_of_view(), _off_center(step)
        if self.close is None and away < CENTRED and focal_px < self._widest:
            self._widest, self.centred = focal_px, step
        self._since = min(self._since, step.t)
        if step.t - self._since < SIZE_KNOWN_S:
            return
        size = float(np.max(step.target.box.size_px))
        settled = abs(math.log(focal_px / step.aim.nominal_px)) < SETTLED
        alone = not step.target.shared  # a shared box is as large as all that it covers
        if alone and settled and away < SETTLED and size > self._largest:
            self._largest, self.close = size, step

    def _focal_of_view(self) -> float:
        """Focal length of the newest zoom frame, which is older than the newest state of the lens [px]."""
        t, focal = [s.lens.t for s in self._recent], [s.lens.focal_px for s in self._recent]
        return float(np.interp(self._recent[-1].zoom.t, t, focal))

    def picture(self, title: str) -> Image:
        """Draw both cameras' frames of a target in six panels, as in Figs. 4 to 6."""
        missing = next(s for s in (self.close, self.centred, self.before) if s is not None)
        before, centred, close = self.before or missing, self.centred or missing, self.close or missing
        mask = np.zeros(close.fixed.image.shape[:2], np.uint8) if close.mask is None else close.mask
        rows = [
            (draw_wide(close), f"(a) {title}: wide view and detection"),
            (cv2.cvtColor(mask, cv2.COLOR_GRAY2BGR), "(b) what the detector marked in it"),
            (before.zoom.image, "(c) zoom view before"),
            (draw_zoom(centred), "(d) zoom view, turned to the target"),
            (self._enlarged(close), "(e) the wide view enlarged as much as the close-up"),
            (draw_zoom(close), f"(f) close-up, at {close.lens.focal_px:.0f} px"),
        ]
        panels = [captioned(np.asarray(image, np.uint8), text) for image, text in rows]
        return np.vstack([np.hstack(panels[i : i + 2]) for i in range(0, len(panels), 2)])

    def _enlarged(self, step: Step) -> Image:
        """Enlarge the fixed frame around the target to the close-up's scale (if both lenses are alike when short)."""
        image = step.fixed.image
        if step.target is None:
            return image
        h, w = image.shape[:2]
        part = (
            max(2, round(w * self._shortest / step.lens.focal_px)),
            max(2, round(h * self._shortest / step.lens.focal_px)),
        )
        u, v = step.target.center_px
        cut = cv2.getRectSubPix(image, part, (float(u), float(v)))
        return np.asarray(cv2.resize(cut, (w, h), interpolation=cv2.INTER_NEAREST), np.uint8)


def _off_center(step: Step) -> float:
    """Distance of the target from the centre of a Step's zoom frame, over its width; infinite if it was not found."""
    height, width = step.zoom.image.shape[:2]
    if step.found is None or step.found.t != step.zoom.t:
        return math.inf
    return float(np.linalg.norm(step.found.center_px - (np.array([width, height]) - 1) / 2)) / width


def draw_frames(image: Image, origins_px: Mapping[str, Array]) -> Image:
    """Label a picture of a rig at pan = tilt = 0 with its frames, Gamma and T, as in Fig. 2.

    Args:
        image: picture of the rig.
        origins_px: pixels of the origins of the frames fixed, zoom and base, (2,) each.
    """
    image = image.copy()
    fixed, zoom, base = (np.asarray(origins_px[name]) for name in ("fixed", "zoom", "base"))
    for start, end in ((fixed, zoom), (zoom, base)):
        a, b = np.rint(start).astype(int).tolist(), np.rint(end).astype(int).tolist()
        cv2.arrowedLine(image, a, b, PAPER, 4, cv2.LINE_AA, tipLength=0.08)
        cv2.arrowedLine(image, a, b, ARROW, 2, cv2.LINE_AA, tipLength=0.08)
    write_text(image, "Gamma", (fixed + zoom) / 2 + [-24, 24])
    write_text(image, "T", (zoom + base) / 2 + [16, 12])
    write_text(image, "fixed", fixed + np.array([-44, 20]))
    write_text(image, "zoom0", zoom + np.array([14, -28]))
    write_text(image, "base, head", base + np.array([34, 32]))
    return image
