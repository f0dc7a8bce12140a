"""The paper's method of following, for comparison: one open-loop command from the fixed view at a time; its pictures.

As in its Table 1: detect, depth from the size, pan and tilt by the shortcut, focal length for the wanted size, command
head and lens. Nothing is predicted, filtered or corrected by the zoom view, and no policy limits the lens. The next
command comes when head and lens stand again, and the first target is kept until it disappears. The paper leaves two
things open, which are this project's: the calibration, and the association of connected components over time
(`Tracker`).
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import TargetProfile
from cotarget.control.controller import reach_of
from cotarget.control.selection import TargetSelector
from cotarget.detection import Detector
from cotarget.drawing import PAPER, captioned
from cotarget.errors import UnreachableError
from cotarget.pipeline import FollowSettings, FrameSource, State, Step, follow
from cotarget.rig import Image, Rig
from cotarget.targeting import Aim, Method, WantedSize, aim, depth_of, point_at
from cotarget.tracking.track import Track, tracking_settings
from cotarget.tracking.tracker import Tracker

METHOD: Method = "paper-table"  # depth as in Table 1


@dataclass(frozen=True)
class Task:
    """What to follow, with what, and for how long: the arguments of `follow`."""

    rig: Rig
    calibration: Calibration
    target: TargetProfile
    detector: Detector
    seconds: float
    settings: FollowSettings


Follow = Callable[[Task], Iterator[Step]]  # Steps and errors are those of `follow`


def follow_as_this_project(task: Task, selector: TargetSelector | None = None) -> Iterator[Step]:
    """Follow a target by `follow`, by default the first that comes."""
    return follow(
        task.rig,
        task.calibration,
        task.target,
        task.detector,
        selector=selector,
        seconds=task.seconds,
        settings=task.settings,
    )


def follow_as_the_paper(task: Task) -> Iterator[Step]:
    """Follow a target by the paper's method.

    Of the settings only the command delay is used. It distinguishes a head that has stopped from one that has not
    started.
    """
    rig, target = task.rig, task.target
    calibration = task.calibration.for_streams(rig.fixed.size, rig.zoom.size)
    eyes, tracker = FrameSource(rig.fixed, rig.zoom, rig.clock), Tracker(tracking_settings(target), rig.fixed.size)
    head = rig.head.state()
    commanded = (head.pan, head.tilt, rig.zoom.zoom(rig.zoom.focal_range[0]))
    mine: Track | None = None
    index, sent, begun = 0, 0, rig.clock.now()  # time at which the last command takes effect [s]
    end = begun + task.seconds
    while rig.clock.now() < end:
        frame = eyes.read_fixed()
        detections = task.detector.detect(frame)
        tracks = tracker.update(detections.boxes, frame.t)
        zoom = eyes.read_zoom()
        mine = _first(tracks, mine)
        head, lens, now, found = rig.head.state(), rig.zoom.state(), rig.clock.now(), None
        if mine is not None and not mine.missed and now >= begun and not head.moving and not lens.moving:
            found = _aim(calibration, target, mine, rig)
        if found is not None:
            commanded = (*rig.head.move(found.pan, found.tilt), rig.zoom.zoom(found.nominal_px))
            begun, sent = now + rig.spec.head.delay_s + eyes.interval, sent + 1
        yield Step(
            index=index,
            t=now,
            state=State.SEARCHING if mine is None else State.FOLLOWING,
            reason="",
            fixed=frame,
            zoom=zoom,
            mask=detections.mask,
            detections=tuple(detections.boxes),
            tracks=tuple(tracks),
            target=mine,
            aim=found,
            commanded=commanded,
            head=head,
            lens=lens,
            head_commands=sent,
            lens_commands=sent,
        )
        index += 1


def _first(tracks: list[Track], before: Track | None) -> Track | None:
    """Keep the followed track until it disappears, then select the eldest."""
    confirmed = {track.id: track for track in tracks if track.confirmed}
    if before is not None and before.id in confirmed:
        return confirmed[before.id]
    return confirmed[min(confirmed)] if confirmed else None


def _aim(calibration: Calibration, target: TargetProfile, track: Track, rig: Rig) -> Aim | None:
    """Aim by the track's last box alone; None where the shortcut has no reachable solution."""
    vertical = target.is_vertical()
    size_px, center_px = float(track.box.size_px[int(vertical)]), track.box.center_px
    try:
        x_fixed = point_at(calibration, center_px, depth_of(calibration, target, size_px, center_px))
        wanted_size = WantedSize(target.size, target.wanted_px, vertical)
        return aim(calibration, x_fixed, reach_of(rig), wanted_size=wanted_size, method=METHOD)
    except UnreachableError:
        return None


WAYS: Mapping[str, Follow] = {"this project": follow_as_this_project, "as the paper": follow_as_the_paper}
OURS = "this project"


def picture_name(figure: str, way: str) -> str:
    """Name the picture of a figure by one of `WAYS`, without suffix; this project's has the figure's name."""
    return figure if way == OURS else f"{figure}_{way.replace(' ', '_')}"


# Pictures in the layout of the paper's figures: rows of panels with captions below

WIDTH_PX = 480  # width of a panel, less than a camera's image: averaged noise takes less disk space
GAP_PX = 6  # gap right of a panel
Panel = tuple[Image, str]


def laid_out(rows: Iterable[Sequence[Panel]]) -> bytes:
    """Arrange rows of captioned panels, all of one aspect ratio and equally many per row, as one PNG."""
    return cv2.imencode(".png", np.vstack([np.hstack([_panel(*each) for each in row]) for row in rows]))[1].tobytes()


def _panel(image: Image, caption: str) -> Image:
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    size = WIDTH_PX, round(WIDTH_PX * image.shape[0] / image.shape[1])
    panel = captioned(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8), caption)
    return np.asarray(cv2.copyMakeBorder(panel, 0, 0, 0, GAP_PX, cv2.BORDER_CONSTANT, value=PAPER), np.uint8)
