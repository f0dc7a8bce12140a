"""Draw Steps and runs: frames side by side, one picture for each target, and plots of the aim error over time."""

import itertools
import math
import textwrap
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from cotarget.config import Polygon
from cotarget.files import write_atomically
from cotarget.geometry import Array
from cotarget.metrics import Row
from cotarget.pipeline import State, Step, outline_px
from cotarget.rig import Image

OFFSET, FOCAL = "#1f6f8b", "#777777"  # colours of the curves
FOCAL_MARGIN = 1.25  # factor between the focal lengths and the ends of their axis


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
        offset = np.array([100 * row.closeup.tpo_px / row.width_px if row.closeup.inside else np.nan for row in run])
        ax.plot(t, offset, lw=1.2, color=OFFSET, label="offset from the centre of the zoom image")
        out = np.array([not row.closeup.in_frame and row.in_wide for row in run])
        missed = "seen by the fixed camera, not in the close-up"
        ax.fill_between(t, 0, 50, where=out, color="#d9534f", alpha=0.15, lw=0, label=missed)
        ax.set(ylim=(0, 50), xlim=(t[0], t[-1]), ylabel="offset [% of width]", title=name)
        zoom = ax.twinx()
        zoom.semilogy(t, [row.focal_px for row in run], lw=1.0, ls="--", color=FOCAL, label="focal length")
        zoom.set_ylim(focals[0] / FOCAL_MARGIN, focals[1] * FOCAL_MARGIN)
        zoom.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        zoom.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        zoom.yaxis.set_minor_locator(NullLocator())
        zoom.set_ylabel("focal length [px]", color=FOCAL)
    ax.set_xlabel("time [s]")
    drawn = [handle for axes in (ax, zoom) for handle in axes.get_legend_handles_labels()[0]]
    figure.legend(handles=drawn, loc="outside upper center", ncols=len(drawn), frameon=False)
    return figure


# Colours (BGR): boxes of tracks and of the followed one, cross, text, and what is behind them; arrows; ignored regions.
FOUND, FOLLOWED, CROSS = (230, 230, 0), (0, 200, 255), (80, 220, 80)
INK, PAPER, DARK, ARROW, DIM = (40, 40, 40), (250, 250, 250), (20, 20, 20), (0, 120, 235), (130, 130, 130)
FULL_WIDTH_PX = 640  # lines, letters and captions grow with images wider than this; the lengths below are at this width
FULL_HEIGHT_PX = 480  # smaller images are enlarged to this height in a film
LETTER_SCALE = 0.55  # OpenCV's scale of the font
STRIP_PX = 36  # height of a caption
MARGIN_PX = 10  # of texts to the border
LINE_PX = 19  # distance of lines of text
PLATE = 0.65  # opacity of the dark plate behind a text
SIZE_KNOWN_S = 1.5  # time after which a target's size is known: it may have been clipped, or not seen with wings spread
RECENT_STEPS = 16  # states kept to interpolate the lens at a frame's exposure; more than any latency needs
# Largest deviations for a picture of the close-up: of the focal length (relative), and of the target (over the width).
SETTLED = 0.08
CENTRED = 0.04  # largest distance of a target from the centre that is shown as centred, over the image's width
BOX_MARGIN_PX = 4  # distance of a drawn box from the target


def write_text(
    image: Image, text: str, at: Sequence[float] | Array, colour: tuple[int, int, int] = PAPER, *, outlined: bool = True
) -> None:
    """Write text into an image, in letters that grow with the image.

    Args:
        image: the image, which is changed.
        text: the text.
        at: lower left corner of the text [px].
        colour: colour of the letters, BGR.
        outlined: whether they have a dark outline, to be legible on any background.
    """
    scale, font = _scale_of(image), cv2.FONT_HERSHEY_SIMPLEX
    u, v = round(at[0]), round(at[1])
    reach = range(-round(scale), round(scale) + 1) if outlined else ()
    for du, dv in itertools.product(reach, reach):
        cv2.putText(image, text, (u + du, v + dv), font, scale * LETTER_SCALE, DARK, 1, cv2.LINE_AA)
    cv2.putText(image, text, (u, v), font, scale * LETTER_SCALE, colour, 1, cv2.LINE_AA)


def _scale_of(image: Image) -> float:
    """Return the scale of lines and letters in an image."""
    return max(1.0, image.shape[1] / FULL_WIDTH_PX)


def _width_of(text: str, scale: float) -> int:
    """Return the width of a text [px]."""
    return int(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale * LETTER_SCALE, 1)[0][0])


def draw_box(
    image: Image, center_px: Array, size_px: Array, colour: tuple[int, int, int], label: str, *, bold: bool = True
) -> None:
    """Draw a labelled box around a target, which stays visible.

    Args:
        image: the image, which is changed.
        center_px: centre of the target (u, v), (2,).
        size_px: width and height of the target, (2,).
        colour: colour of the line, BGR; a dark line is around it.
        label: text above the box, or below it at the image's top.
        bold: whether the line is bold; it grows outwards.
    """
    scale = _scale_of(image)
    line = round(2 * scale) if bold else 1
    half = size_px / 2 + BOX_MARGIN_PX * scale
    low, high = np.rint(center_px - half).astype(int), np.rint(center_px + half).astype(int)
    for away in range(line + 1):
        cv2.rectangle(image, (low - away).tolist(), (high + away).tolist(), colour if away < line else DARK, 1)
    room = LINE_PX * scale
    above = low[1] - 6 * scale if low[1] > room else high[1] + room
    left = min(max(0, low[0]), image.shape[1] - _width_of(label, scale) - 2)
    write_text(image, label, (left, above), colour)


def draw_ignored(image: Image, ignored: Iterable[Polygon]) -> None:
    """Outline regions in which nothing is detected with a dim line; the image is changed."""
    line, outlines = round(_scale_of(image)), [outline_px(each, image) for each in ignored]
    for colour, width in ((DARK, 2 * line), (DIM, line)):
        cv2.polylines(image, outlines, True, colour, width, cv2.LINE_AA)


def write_picture(path: Path, image: Image) -> None:
    """Write an image as PNG, which appears under its name when complete.

    Raises:
        ConfigError: the file cannot be written.
    """
    write_atomically(path, cv2.imencode(".png", image)[1].tobytes())


def captioned(image: Image, text: str) -> Image:
    """Append a caption below an image, in letters that let it fit."""
    scale = _scale_of(image)
    height, margin = round(STRIP_PX * scale), MARGIN_PX * scale
    fitted = scale * min(1.0, (image.shape[1] - 2 * margin) / max(1, _width_of(text, scale)))
    strip = np.full((height, image.shape[1], 3), PAPER, np.uint8)
    at = round(margin), round(height - 12 * scale)
    cv2.putText(strip, text, at, cv2.FONT_HERSHEY_SIMPLEX, fitted * LETTER_SCALE, INK, 1, cv2.LINE_AA)
    return np.vstack([image, strip])


def draw_wide(step: Step, factor: float = 1.0) -> Image:
    """Draw the fixed camera's frame, enlarged by a factor, with boxes of reported tracks; the followed one differs."""
    image = _enlarged(step.fixed.image, factor)
    draw_ignored(image, step.ignored)
    for track in step.tracks:
        if track.reported:
            followed = step.target is not None and track.id == step.target.id
            center = factor * (track.center_px + 0.5) - 0.5
            draw_box(
                image, center, factor * track.whole_px, FOLLOWED if followed else FOUND, f"{track.id}", bold=followed
            )
    return image


def _enlarged(image: Image, factor: float) -> Image:
    """Copy an image, enlarged by a factor."""
    if factor == 1:
        return image.copy()
    return np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC), np.uint8)


def draw_zoom(step: Step, factor: float = 1.0) -> Image:
    """Draw the zoom camera's frame, enlarged by a factor, with a small cross at its centre."""
    image = _enlarged(step.zoom.image, factor)
    line = max(1, round(_scale_of(image)))
    u, v, near, far = image.shape[1] // 2, image.shape[0] // 2, 4 * line, 12 * line
    for colour, width in ((DARK, 3 * line), (CROSS, line)):
        for du, dv in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            a, b = ((u + du * away, v + dv * away) for away in (near, far))
            cv2.line(image, a, b, colour, width, cv2.LINE_AA)
    return image


def side_by_side(step: Step, title: str, t: float) -> Image:
    """Draw a frame of a film: both cameras' frames with tracks, state, and the time ``t`` since the film began [s]."""
    heights = step.fixed.image.shape[0], step.zoom.image.shape[0]
    fixed, zoom = (max(FULL_HEIGHT_PX, *heights) / height for height in heights)
    depth = f"   depth {step.aim.depth:.1f} m" if step.aim is not None else ""
    left = f"fixed camera: {title}   t = {t:.2f} s   {step.state}{depth}"
    pan, tilt = np.degrees(step.head.pan), np.degrees(step.head.tilt)
    right = f"close-up   pan {pan:6.2f}   tilt {tilt:6.2f} deg   focal length {step.lens.focal_px:5.0f} px"
    panels = [captioned(_explained(draw_wide(step, fixed), step.reason), left), captioned(draw_zoom(step, zoom), right)]
    height = max(panel.shape[0] for panel in panels)  # the caption of a wider image is higher
    padded = [cv2.copyMakeBorder(i, 0, height - i.shape[0], 0, 0, cv2.BORDER_CONSTANT, value=PAPER) for i in panels]
    return np.hstack(padded)


def _explained(image: Image, reason: str) -> Image:
    """Write the reason of a state on a dark plate at the bottom of an image, wrapped to its width."""
    if not reason:
        return image
    scale = _scale_of(image)
    margin, line = MARGIN_PX * scale, LINE_PX * scale
    widest = image.shape[1] - 2 * margin
    lines = textwrap.wrap(reason, max(1, int(len(reason) * widest / max(1, _width_of(reason, scale)))))
    while len(lines) > 1 and max(_width_of(each, scale) for each in lines) > widest:  # letters differ in width
        lines = textwrap.wrap(reason, max(map(len, lines)) - 1)
    top = max(0, round(image.shape[0] - len(lines) * line - margin))
    image[top:] = cv2.addWeighted(image[top:], 1 - PLATE, np.full_like(image[top:], DARK), PLATE, 0)
    for number, each in enumerate(lines, start=1):
        write_text(image, each, (margin, top + number * line), outlined=False)
    return image


class TargetStages:
    """Choose the Steps for the picture of a target, by what the pipeline knows: before, centred, and close-up.

    Args:
        shortest_px: shortest nominal focal length of the zoom camera.
    """

    def __init__(self, shortest_px: float) -> None:
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
        """Interpolate the focal length at the newest zoom frame, which is older than the lens's newest state [px]."""
        t, focal = [s.lens.t for s in self._recent], [s.lens.focal_px for s in self._recent]
        return float(np.interp(self._recent[-1].zoom.t, t, focal))

    def picture(self, title: str) -> Image:
        """Draw both cameras' frames of a target in six panels, as in Figs. 4 to 6."""
        missing = next(s for s in (self.close, self.centred, self.before) if s is not None)
        before, centred, close = self.before or missing, self.centred or missing, self.close or missing
        mask = np.zeros(close.fixed.image.shape[:2], np.uint8) if close.mask is None else close.mask
        rows = [
            (draw_wide(close), f"(a) {title}: fixed camera and detection"),
            (cv2.cvtColor(mask, cv2.COLOR_GRAY2BGR), "(b) what the detector marked in it"),
            (before.zoom.image, "(c) zoom camera before"),
            (draw_zoom(centred), "(d) zoom camera, turned to the target"),
            (self._magnified(close), "(e) the fixed camera enlarged as much as the close-up"),
            (draw_zoom(close), f"(f) close-up, at {close.lens.focal_px:.0f} px"),
        ]
        panels = [captioned(np.asarray(image, np.uint8), text) for image, text in rows]
        return np.vstack([np.hstack(panels[i : i + 2]) for i in range(0, len(panels), 2)])

    def _magnified(self, step: Step) -> Image:
        """Enlarge the fixed frame around the target to the close-up's scale, if both shortest lenses are equal."""
        image = step.fixed.image
        if step.target is None:
            return image
        h, w = image.shape[:2]
        part = [max(2, round(side * self._shortest / step.lens.focal_px)) for side in (w, h)]
        u, v = step.target.center_px
        cut = cv2.getRectSubPix(image, part, (float(u), float(v)))
        return np.asarray(cv2.resize(cut, (w, h), interpolation=cv2.INTER_NEAREST), np.uint8)


def _off_center(step: Step) -> float:
    """Return the target's distance from the centre of a zoom frame, over its width; infinite if it was not found."""
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
