"""What the wide camera sees of a scene, rendered and searched once, so that it can be followed many times over.

Its frames and what is found in them depend neither on where the zoom camera looks nor on how late they come. A world
opened on such a view renders the zoom camera only, and nothing at all where nobody looks through it.
"""

import os
import weakref
from collections.abc import Mapping
from dataclasses import dataclass, field
from tempfile import TemporaryFile

import numpy as np

from cotarget.config import RigConfig, TargetConfig
from cotarget.detection import Detection, make_detector
from cotarget.evaluation import microseconds
from cotarget.rig import Camera, Frame, Image
from cotarget.sim.truth import CameraName
from cotarget.sim.world import SimWorld

WIDE: tuple[CameraName] = ("fixed",)
CLOSE: tuple[CameraName] = ("zoom",)


class Shelf:
    """Images in a file that no folder lists, and that is gone with the last one who knows it.

    They are kept as they are: 20 s of pictures and masks take 600 MB, and compressing them would take longer than
    following.
    """

    def __init__(self) -> None:
        """Make the file."""
        self._file = TemporaryFile(prefix="cotarget-")  # noqa: SIM115  closed below
        weakref.finalize(self, self._file.close)

    def put(self, image: Image | None) -> "Kept | None":
        """Keep an image; nothing where there is none."""
        if image is None:
            return None
        offset = self._file.tell()
        self._file.write(np.ascontiguousarray(image).data)
        self._file.flush()
        return Kept(self, offset, image.shape)

    def take(self, offset: int, shape: tuple[int, ...]) -> Image:
        """An image of that shape from there, the caller's own."""
        image = np.empty(shape, dtype=np.uint8)
        read = os.preadv(self._file.fileno(), [image.data], offset)
        assert read == image.nbytes, "it was written whole"
        return image


@dataclass(frozen=True)
class Kept:
    """An image on a shelf, and where."""

    shelf: Shelf = field(repr=False)
    offset: int
    shape: tuple[int, ...]

    def image(self) -> Image:
        """The image, the caller's own."""
        return self.shelf.take(self.offset, self.shape)


@dataclass(frozen=True)
class Seen:
    """One frame.

    Attributes:
        detections: in it.
        picture: of it; None where nothing was rendered.
        mask: the detector's foreground, likewise.
    """

    detections: tuple[Detection, ...]
    picture: Kept | None = None
    mask: Kept | None = None


@dataclass(frozen=True)
class WideView:
    """The frames of one run by their times.

    Attributes:
        frames: by microseconds.
        pictures: whether they are there.
    """

    frames: Mapping[int, Seen] = field(repr=False)
    pictures: bool

    def at(self, t: float) -> Seen:
        """The frame of a time [s]."""
        return self.frames[microseconds(t)]


def record(config: RigConfig, target: TargetConfig, seconds: float) -> WideView:
    """Look through the wide camera alone, and search each frame.

    Args:
        config: the rig and its world.
        target: what is looked for.
        seconds: for how long [s].
    """
    frames: dict[int, Seen] = {}
    detector, shelf = make_detector(target, config.rate_hz), Shelf()
    with SimWorld(config, rendered=WIDE).rig as rig:
        t: float | None = None
        while t is None or t < seconds:
            frame = rig.fixed.read(newer_than=t)
            t, found = frame.t, tuple(detector.detect(frame))
            frames[microseconds(t)] = Seen(found, shelf.put(frame.image), shelf.put(detector.mask))
    return WideView(frames, pictures=True)


def open_on(view: WideView, config: RigConfig, *, closed_loop: bool) -> tuple[SimWorld, "RecordedDetector"]:
    """A world whose wide frames are those recorded, and the detector that finds in them what was found.

    Args:
        view: of the same world, whatever its latencies.
        config: the rig and its world.
        closed_loop: whether the zoom camera is rendered.
    """
    assert view.pictures or not closed_loop, "the zoom view is searched for what the wide view shows"
    world = SimWorld(config, rendered=CLOSE if closed_loop else ())
    if view.pictures:  # the middle of a body is told by its outline, whoever looks at the zoom view
        world.rig.fixed = _RecordedCamera(world.rig.fixed, view)
    return world, RecordedDetector(view)


class RecordedDetector:
    """Finds in a frame what was found in it before."""

    def __init__(self, view: WideView) -> None:
        self._view = view
        self.mask: Image | None = None

    def detect(self, frame: Frame) -> list[Detection]:
        """What was found, best first."""
        seen = self._view.at(frame.t)
        self.mask = None if seen.mask is None else seen.mask.image()
        return list(seen.detections)


class _RecordedCamera:
    """A camera that delivers when the simulated one does, and what was recorded."""

    def __init__(self, camera: Camera, view: WideView) -> None:
        self._camera, self._view = camera, view

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._camera.size

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """As the simulated camera."""
        t = self._camera.read(newer_than, timeout).t
        picture = self._view.at(t).picture
        assert picture is not None, "pictures were kept"
        return Frame(picture.image(), t)
