"""Run the fixed camera's detector and tracker on a film; write a table of tracks, and the film with tracks drawn."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from cotarget.config import TargetProfile
from cotarget.detection import make_detector
from cotarget.drawing import draw_box
from cotarget.errors import CotargetError
from cotarget.files import CsvFile
from cotarget.geometry import Array
from cotarget.parallel import Progress
from cotarget.rig import Image
from cotarget.tracking.track import Track, tracking_settings
from cotarget.tracking.tracker import Tracker
from cotarget.video import Film, FilmWriter

COLUMNS = ("frame", "t", "track", "u_px", "v_px", "width_px", "height_px", "score")
TRAIL_S = 1.0  # length of the trail that is drawn behind a target [s]
# Colours (BGR) that are distinct on sky, grass and asphalt; a track keeps its own.
COLOURS = ((60, 60, 255), (0, 200, 255), (80, 220, 60), (255, 160, 40), (255, 80, 220), (40, 140, 255), (230, 230, 60))


@dataclass(frozen=True)
class FilmSummary:
    """Summary of the tracks in a film.

    Attributes:
        frames: number of frames that can be decoded.
        frames_with_target: number of these with a confirmed track.
        tracks: number of confirmed tracks.
        duration_s: time from the first frame to the last [s].
        rate_hz: frame rate that the film states [Hz].
        last_frame: number of the last frame, from 0; there are fewer frames if some cannot be decoded.
        shortfall: why frames are missing; None if the film is whole, or if that cannot be known.
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
    target: TargetProfile,
    csv_path: Path,
    drawn: Path | None = None,
    progress: Progress | None = None,
    keep: bool = False,
) -> FilmSummary:
    """Detect and track a target in a film.

    The table has a row for each confirmed track in each frame; the score is 0 where the target was not detected and its
    place is predicted. Files appear only when complete. A damaged film is processed as far as it can be decoded; its
    frames keep the numbers that they have in the whole film, and the summary says what is missing.

    Args:
        video: the film.
        target: target profile.
        csv_path: table to write, with `COLUMNS`.
        drawn: film to write with the tracks drawn; None for none.
        progress: called after every frame with (frames done, frames in all or None, what).
        keep: whether to keep the results so far if the run ends in an error.

    Raises:
        CotargetError: the film cannot be read, or a file cannot be written.
    """
    for out in (csv_path, drawn):
        if out is not None and out.resolve() == video.resolve():
            raise CotargetError(f"{out}: is the film itself; name another file to write")
    with Film(video) as film, CsvFile(csv_path, COLUMNS, keep=keep, line_end="\n") as table:
        if drawn is None:
            return _run(film, target, table.write, None, progress)
        with FilmWriter(drawn, film.rate_hz, keep=keep) as out_film:
            return _run(film, target, table.write, out_film.write, progress)


def _run(
    film: Film,
    target: TargetProfile,
    write_row: Callable[[list[str]], object],
    write_image: Callable[[Image, float], None] | None,
    progress: Progress | None,
) -> FilmSummary:
    detector = make_detector(target, film.rate_hz)
    tracker = Tracker(tracking_settings(target), film.size)
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
            write_image(trails.draw(frame.image, tracks, frame.t), frame.t)
        if progress is not None:
            progress(film.number + 1, film.count, "detecting")
    return FilmSummary(
        frames=len(times),
        frames_with_target=with_target,
        tracks=len(numbers),
        duration_s=max(times) - min(times),
        rate_hz=film.rate_hz,
        last_frame=film.number,
        shortfall=film.shortfall or None,
    )


def _row(index: int, t: float, track: Track) -> list[str]:
    numbers = (*track.center_px, *track.size_px)
    score = track.score if track.missed == 0 else 0.0
    return [str(index), f"{t:.4f}", str(track.id), *(f"{x:z.2f}" for x in numbers), f"{score:.3f}"]


class Trails:
    """Draw tracks as boxes with their id and their trail."""

    def __init__(self) -> None:
        self._trails: dict[int, list[tuple[float, Array]]] = {}

    def draw(self, image: Image, tracks: Sequence[Track], t: float) -> Image:
        """Draw tracks on a copy of an image; a box is thin while its target is only predicted."""
        image = image.copy()
        self._trails = {
            track.id: [at for at in self._trails.get(track.id, []) if at[0] >= t - TRAIL_S] + [(t, track.center_px)]
            for track in tracks
        }
        for track in tracks:
            colour, trail = COLOURS[track.id % len(COLOURS)], self._trails[track.id]
            way = np.rint([center for _, center in trail]).astype(np.int32)
            cv2.polylines(image, [way.reshape(-1, 1, 2)], False, colour, 1, cv2.LINE_AA)
            draw_box(image, track.center_px, track.size_px, colour, str(track.id), bold=track.missed == 0)
        return image
