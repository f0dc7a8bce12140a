"""Run the fixed camera's detector and tracker on films; write tables of tracks, and films with the tracks drawn.

`run_on_folder` scores a folder of films by labels, and shows the worst mistakes on a contact sheet.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cotarget.config import Polygon, TargetProfile
from cotarget.detection import make_detector
from cotarget.drawing import BOX_MARGIN_PX, draw_box, draw_ignored, write_picture, write_text
from cotarget.errors import ConfigError, CotargetError
from cotarget.files import CsvFile
from cotarget.geometry import Array, within_image
from cotarget.parallel import Progress
from cotarget.pipeline import CameraRun
from cotarget.rig import Image
from cotarget.track_metrics import (
    LEARNING_FRAMES,
    Criterion,
    Label,
    Mistake,
    match_frames,
    mistakes,
    pooled,
    read_labels,
    read_tracks,
    score_tracks,
)
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
    ignored: Sequence[Polygon] = (),
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
        ignored: regions in which nothing is detected, see `cotarget.config.FollowConfig`.

    Raises:
        CotargetError: the film cannot be read, or a file cannot be written.
    """
    for out in (csv_path, drawn):
        if out is not None and out.resolve() == video.resolve():
            raise CotargetError(f"{out}: is the film itself; name another file to write")
    with Film(video) as film, CsvFile(csv_path, COLUMNS, keep=keep, line_end="\n") as table:
        if drawn is None:
            return _run(film, target, ignored, table.write, None, progress)
        with FilmWriter(drawn, film.rate_hz, keep=keep) as out_film:
            return _run(film, target, ignored, table.write, out_film.write, progress)


def _run(
    film: Film,
    target: TargetProfile,
    ignored: Sequence[Polygon],
    write_row: Callable[[list[str]], object],
    write_image: Callable[[Image, float], None] | None,
    progress: Progress | None,
) -> FilmSummary:
    camera = CameraRun(make_detector(target, film.rate_hz), Tracker(tracking_settings(target), film.size), ignored)
    trails = Trails(ignored)
    numbers: set[int] = set()
    times = []
    with_target = 0
    for frame in film:
        camera.track(frame)
        tracks = [track for track in camera.tracks if track.reported]
        for track in tracks:
            write_row(_row(film.number, frame.t, track, film.size))
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


def _row(index: int, t: float, track: Track, size: tuple[int, int]) -> list[str]:
    center, extent = within_image(track.center_px, track.whole_px, size)
    numbers = (*center, *extent)
    score = track.score if track.missed == 0 else 0.0
    return [str(index), f"{t:.4f}", str(track.id), *(f"{x:z.2f}" for x in numbers), f"{score:.3g}"]


class Trails:
    """Draw tracks as boxes with their id and their trail, and the outlines of ignored regions."""

    def __init__(self, ignored: Sequence[Polygon] = ()) -> None:
        self._ignored = ignored
        self._trails: dict[int, list[tuple[float, Array]]] = {}

    def draw(self, image: Image, tracks: Sequence[Track], t: float) -> Image:
        """Draw tracks on a copy of an image; a box is thin while its target is only predicted."""
        image = image.copy()
        draw_ignored(image, self._ignored)
        self._trails = {
            track.id: [at for at in self._trails.get(track.id, []) if at[0] >= t - TRAIL_S] + [(t, track.center_px)]
            for track in tracks
        }
        for track in tracks:
            colour = COLOURS[track.id % len(COLOURS)]
            way = np.array([center for _, center in self._trails[track.id]])
            beside = (np.abs(way - track.center_px) > track.whole_px / 2 + BOX_MARGIN_PX).any(axis=1)
            way = way[beside]  # a small target stays visible
            cv2.polylines(image, [np.rint(way).astype(np.int32).reshape(-1, 1, 2)], False, colour, 1, cv2.LINE_AA)
            draw_box(image, track.center_px, track.whole_px, colour, str(track.id), bold=track.missed == 0)
        return image


# Labels


def labels_of_film(video: Path, file: Path) -> dict[int, list[Label]]:
    """Read a film's labels by frame number, see `read_labels`.

    Raises:
        CotargetError: film or labels cannot be read, or most boxes are outside the picture.
    """
    labels = read_labels(file)
    with Film(video) as film:
        width, height = film.size
        next(iter(film))  # one that cannot be decoded is refused now
    centers = np.reshape([label.center_px for boxes in labels.values() for label in boxes], (-1, 2))
    outside = int(((centers < 0) | (centers >= (width, height))).any(axis=1).sum())
    if outside > len(centers) / 2:
        raise ConfigError(
            f"{file}: {outside} of {len(centers)} boxes are outside {video}'s picture of {width}x{height} px; "
            "give the labels of this film, in its pixels"
        )
    return labels


# Folders of films

FILMS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm")
LABEL_FILES = (".csv", ".txt")
# Tiles of the contact sheet: side [px], number in a row, and most tiles of a kind.
TILE_PX, ACROSS, MOST_TILES = 200, 6, 30
CUTOUT = 3.0  # side of what a tile shows over the box's larger side
LEAST_CUTOUT_PX = 60.0
MISSED, FALSE = (80, 220, 60), (60, 60, 255)


def labelled_films(folder: Path, labels: Path) -> list[tuple[Path, Path]]:
    """Pair the films of a folder with the files of labels of the same name, by name.

    Raises:
        ConfigError: there is no film, two have one name, or a film has no labels.
    """
    pairs: list[tuple[Path, Path]] = []
    named: dict[str, Path] = {}
    for film in sorted(folder.iterdir()):
        if film.suffix.lower() not in FILMS or film.name.startswith("."):  # a hidden file is an unfinished copy
            continue
        if named.setdefault(film.stem, film) != film:
            raise ConfigError(f"{film}: has the name of {named[film.stem].name}; their tables would be one")
        files = [labels / f"{film.stem}{suffix}" for suffix in LABEL_FILES]
        found = next((file for file in files if file.is_file()), None)
        if found is None:
            raise ConfigError(f"{film}: has no labels; give {files[0]}, or {files[1].name} of the MOT-challenge")
        pairs.append((film, found))
    if not pairs:
        raise ConfigError(f"{folder}: holds no film; give a folder with {', '.join(FILMS)}")
    return pairs


def run_on_folder(
    films: Sequence[tuple[Path, Path]],
    target: TargetProfile,
    tables: Path,
    sheet: Path | None,
    criterion: Criterion,
    progress: Progress,
    ignored: Sequence[Polygon] = (),
) -> dict[str, Any]:
    """Detect and track a target in films and score the tracks.

    Args:
        films: films and their files of labels, see `labelled_films`.
        target: target profile.
        tables: folder of the tables of tracks, one for each film.
        sheet: picture to write, with the longest misses (green) and false tracks (red); None for none.
        criterion: when a track is on a label.
        progress: called before every film with (films done, films in all, what).
        ignored: regions of all films in which nothing is detected.

    Returns:
        "pooled": scores over all films but those whose labels are all beyond their ends; "films": summary and score of
        each film, by its name.

    Raises:
        CotargetError: a film or its labels cannot be read, or a file cannot be written.
    """
    results, scores, tiles, minutes = {}, [], [], 0.0
    labels = [labels_of_film(*pair) for pair in films]  # an error before the long work, not after it
    for i, ((film, _), boxes) in enumerate(zip(films, labels, strict=True)):
        progress(i, len(films), film.stem)
        table = tables / f"{film.stem}.csv"
        summary = run_on_film(film, target, table, keep=True, ignored=ignored)
        tracks, frames = read_tracks(table), summary.last_frame + 1
        score = score_tracks(tracks, boxes, summary.rate_hz, frames, criterion=criterion)
        if not boxes or min(boxes) < frames:  # otherwise no labelled frame is in the film
            scores.append(score)
            minutes += frames / summary.rate_hz / 60
        results[film.stem] = dataclasses.asdict(summary) | dataclasses.asdict(score)
        matches = [each for each in match_frames(tracks, boxes, criterion) if LEARNING_FRAMES <= each.frame < frames]
        tiles += [(film, mistake) for mistake in mistakes(matches)]
    if sheet is not None:
        write_picture(sheet, contact_sheet(tiles))
    return {"pooled": pooled(scores, minutes), "films": results}


def contact_sheet(found: Sequence[tuple[Path, Mistake]]) -> Image:
    """Draw the longest runs of missed targets and then of false tracks, as cutouts of their films."""
    chosen: list[tuple[Path, Mistake]] = []
    for kind in ("missed", "false"):
        of_kind = sorted((each for each in found if each[1].kind == kind), key=lambda each: -each[1].frames)
        chosen += of_kind[:MOST_TILES]
    tiles: dict[int, Image] = {}
    for path in {film for film, _ in chosen}:
        wanted = {i: mistake for i, (film, mistake) in enumerate(chosen) if film == path}
        last = max(mistake.frame for mistake in wanted.values())
        with Film(path) as film:
            for frame in film:
                tiles |= {i: _tile(frame.image, path, m) for i, m in wanted.items() if m.frame == film.number}
                if film.number >= last:
                    break
    rows = -(-len(chosen) // ACROSS) or 1
    picture = np.full((rows * TILE_PX, ACROSS * TILE_PX, 3), 255, np.uint8)
    for i, tile in tiles.items():
        v, u = divmod(i, ACROSS)
        picture[v * TILE_PX : (v + 1) * TILE_PX, u * TILE_PX : (u + 1) * TILE_PX] = tile
    return picture


def _tile(image: Image, film: Path, mistake: Mistake) -> Image:
    """Cut out a mistake, with its box, the film's name, the frame, and the number of frames of its run."""
    side = max(CUTOUT * mistake.box.larger_side_px, LEAST_CUTOUT_PX)
    scale = TILE_PX / side
    # Centres of pixels are whole numbers: the middle of the cutout is half a pixel before its middle column.
    shift = (TILE_PX - 1) / 2 - scale * mistake.box.center_px
    tile = cv2.warpAffine(image, np.column_stack([scale * np.eye(2), shift]), (TILE_PX, TILE_PX))
    colour = MISSED if mistake.kind == "missed" else FALSE
    draw_box(tile, np.full(2, (TILE_PX - 1) / 2), scale * mistake.box.size_px, colour, "")
    write_text(tile, film.stem, (4, 16))
    write_text(tile, f"{mistake.kind} {mistake.frame} ({mistake.frames})", (4, TILE_PX - 6))
    return np.asarray(tile, dtype=np.uint8)
