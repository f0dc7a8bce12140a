"""Recorded view of the fixed camera: frames and detections of a scene, computed once and used for several runs.

They depend neither on the zoom camera's pose nor on latencies. A world opened on a recorded view renders the zoom
camera only, or nothing in open-loop runs.
"""

import os
import weakref
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from tempfile import TemporaryFile

import numpy as np

from cotarget.config import RigConfig, TargetProfile
from cotarget.detection import Detections, make_detector
from cotarget.evaluation import microseconds
from cotarget.rig import Camera, Detection, Frame, Image
from cotarget.sim.truth import CameraName
from cotarget.sim.world import SimWorld

WIDE: tuple[CameraName] = ("fixed",)
CLOSE: tuple[CameraName] = ("zoom",)


class Shelf:
    """Images in an unlinked temporary file, which is deleted with the last reference.

    They are stored uncompressed: 20 s of images and masks take 600 MB, and compressing them would take longer than the
    run.
    """

    def __init__(self) -> None:
        """Create the file."""
        self._file = TemporaryFile(prefix="cotarget-")  # noqa: SIM115  closed below
        weakref.finalize(self, self._file.close)

    def put(self, image: Image | None) -> "Kept | None":
        """Store an image; None gives None."""
        if image is None:
            return None
        offset = self._file.tell()
        self._file.write(np.ascontiguousarray(image).data)
        self._file.flush()
        return Kept(self, offset, image.shape)

    def take(self, offset: int, shape: tuple[int, ...]) -> Image:
        """Read an image of a shape at an offset; the caller owns it."""
        image = np.empty(shape, dtype=np.uint8)
        read = os.preadv(self._file.fileno(), [image.data], offset)
        assert read == image.nbytes, "it was written whole"
        return image


@dataclass(frozen=True)
class Kept:
    """Stored image: its file, offset and shape."""

    shelf: Shelf = field(repr=False)
    offset: int
    shape: tuple[int, ...]

    def image(self) -> Image:
        """Read the image; the caller owns it."""
        return self.shelf.take(self.offset, self.shape)


@dataclass(frozen=True)
class Seen:
    """One frame."""

    detections: tuple[Detection, ...]  # detections in the frame
    picture: Kept | None = None  # its image; None where nothing was rendered
    mask: Kept | None = None  # the detector's foreground mask; None where there is none


@dataclass(frozen=True)
class WideView:
    """Frames of one run by time."""

    frames: Mapping[int, Seen] = field(repr=False)  # frames by microseconds
    pictures: bool  # whether the images are stored

    def at(self, t: float) -> Seen:
        """Give the frame of a time [s]."""
        return self.frames[microseconds(t)]


def record(config: RigConfig, target: TargetProfile, seconds: float) -> WideView:
    """Read the fixed camera alone for some seconds, and run the target's detector on each frame."""
    frames: dict[int, Seen] = {}
    detector, shelf = make_detector(target, config.sim.fixed.rate_hz), Shelf()
    with SimWorld(config, rendered=WIDE).rig as rig:
        t: float | None = None
        while t is None or t < seconds:
            frame = rig.fixed.read(newer_than=t)
            t, found = frame.t, detector.detect(frame)
            frames[microseconds(t)] = Seen(tuple(found.boxes), shelf.put(frame.image), shelf.put(found.mask))
    return WideView(frames, pictures=True)


def open_on(view: WideView, config: RigConfig, *, closed_loop: bool) -> tuple[SimWorld, "RecordedDetector"]:
    """Open a world with the recorded frames, and the detector that gives the recorded detections.

    The recording is of the same world, with any latencies. The zoom camera is rendered in closed loop only.
    """
    assert view.pictures or not closed_loop, "the zoom view is searched for what the wide view shows"
    world = SimWorld(config, rendered=CLOSE if closed_loop else ())
    if view.pictures:  # a body's centre is estimated from image and mask in open loop too
        world.rig = replace(world.rig, fixed=_RecordedCamera(world.rig.fixed, view))
    return world, RecordedDetector(view)


class RecordedDetector:
    """Detector that gives the recorded detections of a frame."""

    def __init__(self, view: WideView) -> None:
        self._view = view

    def detect(self, frame: Frame, held: object = ()) -> Detections:
        """Give the recorded detections, best first."""
        seen = self._view.at(frame.t)
        return Detections(seen.detections, lambda: None if seen.mask is None else seen.mask.image())


class _RecordedCamera:
    """Camera with the simulated camera's timing and the recorded images."""

    def __init__(self, camera: Camera, view: WideView) -> None:
        self._camera, self._view = camera, view

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._camera.size

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Read the recorded frame at the time of the simulated camera's."""
        t = self._camera.read(newer_than, timeout).t
        picture = self._view.at(t).picture
        assert picture is not None, "pictures were kept"
        return Frame(picture.image(), t)
