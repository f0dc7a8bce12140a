"""The fixed camera's detector and tracker on any film: a table of tracks, and the film with the tracks drawn."""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from cotarget.config import TargetConfig
from cotarget.detection import make_detector
from cotarget.errors import CotargetError
from cotarget.files import CsvFile
from cotarget.geometry import Array
from cotarget.rig import Image
from cotarget.tracking.track import Track, settings_for
from cotarget.tracking.tracker import Tracker
from cotarget.video import Film, FilmWriter

COLUMNS = ("frame", "t", "track", "u_px", "v_px", "width_px", "height_px", "score")
# How long a trail is drawn behind a target [s].
TRAIL_S = 1.0
# Colours (BGR) that stay apart on sky, grass and asphalt; a track keeps its own.
COLOURS = ((60, 60, 255), (0, 200, 255), (80, 220, 60), (255, 160, 40), (255, 80, 220), (40, 140, 255), (230, 230, 60))
# A drawn box keeps this distance from the target [px], so that a bird of five pixels is not painted over.
BOX_MARGIN_PX = 4
Progress = Callable[[int, int | None], None]


@dataclass(frozen=True)
class FilmSummary:
    """What was found in a film.

    Attributes:
        frames: how many it has that can be decoded.
        frames_with_target: in how many of them there was a confirmed track.
        tracks: how many tracks were confirmed.
        duration_s: from the first frame to the last [s].
        rate_hz: frames a second, as the film says.
        last_frame: number of the last one, from 0; there are fewer frames where some cannot be decoded.
        shortfall: why there are fewer frames than the film has; None where it is whole, or that cannot be known.
    """

    frames: int
    frames_with_target: int
    tracks: int
    duration_s: float
    rate_hz: float
    last_frame: int
    shortfall: str | None = None


def run_on_film(
    video: Path,
    target: TargetConfig,
    csv_path: Path,
    drawn: Path | None = None,
    progress: Progress | None = None,
    template: Image | None = None,
    keep: bool = False,
) -> FilmSummary:
    """Find and track a target in a film.

    The table has a row for each confirmed track in each frame; in a frame in which the target was not detected
    and its place is the motion filter's prediction, the score is 0, and in one in which several were seen as one, each
    has the score of that. Files appear only when complete. A film that is damaged or cut short is gone through where it
    can be decoded, its frames under the numbers that they have in the whole film, and the summary says so.

    Args:
        video: the film.
        target: what to look for.
        csv_path: the table to write: frame,t,track,u_px,v_px,width_px,height_px,score.
        drawn: the film to write with the tracks drawn, if any.
        progress: told (frames done, frames in all or None) after every frame.
        template: BGR picture of the target, for a target that is found by its colour.
        keep: whether what there is so far is kept where the run ends in an error or is interrupted.

    Raises:
        CotargetError: the film cannot be read, or a file cannot be written.
    """
    for out in (csv_path, drawn):
        if out is not None and out.resolve() == video.resolve():
            raise CotargetError(f"{out}: is the film itself; name another file to write")
        if out is not None and not out.resolve().parent.is_dir():
            raise CotargetError(f"{out}: its folder does not exist; name a file in an existing folder")
    with Film(video) as film, CsvFile(csv_path, COLUMNS, keep=keep, line_end="\n") as table:
        if drawn is None:
            return _run(film, target, table.write, None, progress, template)
        with FilmWriter(drawn, film.rate_hz, keep=keep) as out_film:
            return _run(film, target, table.write, out_film.write, progress, template)


def _run(
    film: Film,
    target: TargetConfig,
    write_row: Callable[[list[str]], object],
    write_image: Callable[[Image], None] | None,
    progress: Progress | None,
    template: Image | None,
) -> FilmSummary:
    """Go through the film once."""
    detector = make_detector(target, film.rate_hz, template)
    tracker = Tracker(settings_for(target), film.size)
    trails = Trails()
    numbers: set[int] = set()
    times = []
    with_target = 0
    for frame in film:
        tracks = [t for t in tracker.update(detector.detect(frame), frame.t) if t.confirmed]
        for track in tracks:
            write_row(_row(film.number, frame.t, track))
        numbers.update(track.id for track in tracks)
        with_target += bool(tracks)
        times.append(frame.t)
        if write_image is not None:
            write_image(trails.draw(frame.image, tracks, frame.t))
        if progress is not None:
            progress(film.number + 1, film.count)
    duration = max(times) - min(times)
    return FilmSummary(
        len(times), with_target, len(numbers), duration, film.rate_hz, film.number, film.shortfall or None
    )


def _row(index: int, t: float, track: Track) -> list[str]:
    """A track's line of the table."""
    numbers = (*track.center_px, *track.size_px)
    score = track.score if track.missed == 0 else 0.0
    return [str(index), f"{t:.4f}", str(track.id), *(f"{x:z.2f}" for x in numbers), f"{score:.3f}"]


class Trails:
    """Draws tracks as boxes with their number and the way they came."""

    def __init__(self) -> None:
        self._trails: dict[int, deque[tuple[float, Array]]] = {}

    def draw(self, image: Image, tracks: Iterable[Track], t: float) -> Image:
        """Draw confirmed tracks onto a copy of an image; a box is thin while its target is only predicted."""
        image = image.copy()
        tracks = [track for track in tracks if track.confirmed]
        for track in tracks:
            self._trails.setdefault(track.id, deque()).append((t, track.center_px))
        alive = {track.id for track in tracks}
        self._trails = {number: trail for number, trail in self._trails.items() if number in alive}
        for track in tracks:
            colour = COLOURS[track.id % len(COLOURS)]
            trail = self._trails[track.id]
            while trail[0][0] < t - TRAIL_S:
                trail.popleft()
            way = np.rint([center for _, center in trail]).astype(np.int32)
            cv2.polylines(image, [way.reshape(-1, 1, 2)], False, colour, 1, cv2.LINE_AA)
            half = track.size_px / 2 + BOX_MARGIN_PX
            low = np.rint(track.center_px - half).astype(int).tolist()
            high = np.rint(track.center_px + half).astype(int).tolist()
            cv2.rectangle(image, low, high, colour, 2 if track.missed == 0 else 1)
            above = low[1] - 5 if low[1] > 18 else high[1] + 15
            cv2.putText(
                image, str(track.id), (max(0, low[0]), above), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA
            )
        return image
