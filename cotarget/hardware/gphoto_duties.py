"""What a gphoto2 camera does: move its lens, take stills, show frames. Each knows when it is due, and does one step.

All of it happens on the camera's one thread. Errors after which the connection is good for nothing are passed on as
LinkError; being busy is waited for.
"""

import math
from concurrent.futures import Future

from cotarget.errors import ConfigError, DeviceError
from cotarget.hardware.gphoto import LOST, CameraLink, LinkError
from cotarget.hardware.gphoto_desk import Desk
from cotarget.hardware.gphoto_setup import BUSY_PATIENCE_S, BUSY_PAUSE_S, ZoomSetting, patiently, position_in
from cotarget.hardware.jpeg import JpegDecoder
from cotarget.hardware.lens import LensMotion
from cotarget.hwconfig import HardwareZoom
from cotarget.rig import Clock, Frame, Image

# A lens whose setting reads otherwise is looked at again until this long after it should stand, and then sent again.
VERIFY_PAUSE_S, VERIFY_S, LENS_TRIES = 0.1, 1.0, 2
# A viewfinder that has no new frame yet gives the last one again. It is asked again soon, so that the new one is dated
# when it appears; but not so often for ever.
REPEAT_PAUSE_S, REPEAT_LIMIT_S = 0.005, 1.0
# A lens that comes out when the viewfinder is switched on takes its time until the first frame.
FIRST_FRAME_S = 10.0
# A frame is the newest for this long, or this many frames, whichever is longer; after that the viewfinder is blind.
# Whoever follows waits for a frame then and lets the head come to rest, which it shall within half a second of the
# fault. A frame that took longer to come is as old as that perhaps, and not handed out at all.
FRESH_S, FRESH_FRAMES = 0.2, 2.0


class Patience:
    """How long a camera has been busy."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._since: float | None = None

    def reset(self) -> None:
        """The camera did what it was asked."""
        self._since = None

    def next_try(self, error: LinkError) -> float | None:
        """When to try again [s]; None if it has been busy for too long. Passes on what no waiting cures."""
        if error.code in LOST:
            raise error
        now = self._clock.now()
        self._since = now if self._since is None else self._since
        return now + BUSY_PAUSE_S if now < self._since + BUSY_PATIENCE_S else None


class LensDuty:
    """Sends the lens where the latest command wants it, and reads back whether it went."""

    def __init__(self, config: HardwareZoom, clock: Clock, link: CameraLink, desk: Desk) -> None:
        self._config, self._clock, self._link, self._desk = config, clock, link, desk
        self._zoom: ZoomSetting | None = None
        self._order = -1  # being carried out
        self._sent, self._tries, self._due, self._deadline = False, 0, 0.0, 0.0
        self._patience = Patience(clock)

    def begin(self, zoom: ZoomSetting, first: bool) -> None:
        """Look where a camera just opened has its lens; it is sent back to where it was before the camera was lost."""
        self._zoom, self._order, desk = zoom, -1, self._desk
        reading = position_in(patiently(self._clock, lambda: self._link.get(zoom.name)))
        position = zoom.lens.positions[0] if reading is None else reading
        now = self._clock.now()
        with desk.changed:
            if first:
                desk.wanted = min(zoom.lens.positions, key=lambda each: abs(each - position))
            desk.motion = LensMotion(position, position, now, self._config.lens_speed)
            desk.standing = reading == desk.wanted
            self._order = desk.order if desk.standing else -1

    def due(self) -> float:
        """When there is something to do [s]."""
        with self._desk.changed:
            if self._desk.lens_trouble or (self._desk.standing and self._order == self._desk.order):
                return math.inf
            return self._due if self._order == self._desk.order else -math.inf

    def run(self) -> None:
        """Send or verify."""
        with self._desk.changed:
            order, wanted = self._desk.order, self._desk.wanted
        if order != self._order:
            self._order, self._sent, self._tries = order, False, 0
            self._patience.reset()
        assert self._zoom is not None, "the camera is not open"
        try:
            (self._verify if self._sent else self._send)(self._zoom, wanted)
            self._patience.reset()
        except LinkError as error:
            due = self._patience.next_try(error)
            if due is None:
                self._give_up(wanted, str(error))
            else:
                self._due = due

    def _send(self, zoom: ZoomSetting, wanted: int) -> None:
        start = self._clock.now() + self._config.command_delay_s
        self._link.put(zoom.name, zoom.values[wanted])
        with self._desk.changed:
            assert self._desk.motion is not None, "the camera is not open"
            self._desk.motion = motion = self._desk.motion.toward(wanted, start)
        self._sent, self._tries = True, self._tries + 1
        self._due = now = self._clock.now()
        self._deadline = max(motion.arrives, now) + VERIFY_S

    def _verify(self, zoom: ZoomSetting, wanted: int) -> None:
        reading = position_in(self._link.get(zoom.name))
        if reading == wanted:
            with self._desk.changed:
                self._desk.standing = self._desk.order == self._order
        elif self._clock.now() < self._deadline:
            self._due = self._clock.now() + VERIFY_PAUSE_S
        elif self._tries < LENS_TRIES:
            self._sent, self._due = False, self._clock.now()
        else:
            shown = "nothing" if reading is None else f"{reading:g}"
            self._give_up(wanted, f"its setting '{zoom.name}' reads {shown}")

    def _give_up(self, wanted: int, why: str) -> None:
        with self._desk.changed:
            if self._desk.order == self._order:  # a newer command deserves its own chance
                self._desk.lens_trouble = f"the zoom camera's lens did not go to position {wanted}: {why}"
                self._desk.changed.notify_all()


class StillDuty:
    """Takes a still for whoever waits for one."""

    def __init__(self, config: HardwareZoom, clock: Clock, link: CameraLink, desk: Desk) -> None:
        self._config, self._clock, self._link, self._desk = config, clock, link, desk
        self._future: Future[Frame] | None = None
        self._due = -math.inf
        self._patience = Patience(clock)
        self._decoder = JpegDecoder()

    def due(self) -> float:
        """When there is something to do [s]."""
        with self._desk.changed:
            if self._desk.still is None:
                return math.inf
            return self._due if self._desk.still is self._future else -math.inf

    def run(self) -> None:
        """Take it."""
        with self._desk.changed:
            future = self._desk.still
        if future is None:  # nobody waits any more
            return
        if future is not self._future:
            self._future = future
            self._patience.reset()
        try:
            frame = self._take()
        except LinkError as error:
            try:
                due = self._patience.next_try(error)
            except LinkError:
                self._finish(future, DeviceError(f"the zoom camera was lost while it took a still: {error}"))
                raise
            if due is None:
                self._finish(future, DeviceError(f"the zoom camera takes no still: {error}"))
            else:
                self._due = due
        except (ConfigError, DeviceError) as error:
            self._finish(future, error)
        else:
            self._finish(future, frame)

    def _take(self) -> Frame:
        begin = self._clock.now()
        still = self._link.shoot()
        end = self._clock.now()
        image = self._decoder.decode(self._link.fetch(still))
        if image is None:
            raise DeviceError(f"the zoom camera's still '{still[1]}' is damaged, or no JPEG; set it to take JPEGs")
        size, wanted = size_of(image), self._config.still_size
        if size != wanted:
            raise ConfigError(
                f"hardware.zoom.still_size: stills are {size[0]} x {size[1]}, not {wanted[0]} x {wanted[1]}; "
                f"write still_size = [{size[0]}, {size[1]}]"
            )
        return Frame(image, (begin + end) / 2)

    def _finish(self, future: "Future[Frame]", result: Frame | Exception) -> None:
        with self._desk.changed:
            if self._desk.still is future:
                self._desk.still = None
        if isinstance(result, Frame):
            future.set_result(result)
        else:
            future.set_exception(result)


class ViewDuty:
    """Fetches frames of the viewfinder and publishes the newest."""

    def __init__(self, config: HardwareZoom, clock: Clock, link: CameraLink, desk: Desk) -> None:
        self._config, self._clock, self._link, self._desk = config, clock, link, desk
        self._due = -math.inf
        self._data, self._renewed = b"", -math.inf
        self._patience = Patience(clock)
        self._decoder = JpegDecoder()

    def begin(self) -> None:
        """Wait for the first frame of a camera that was just opened.

        Raises:
            ConfigError: it is of another size than configured.
            DeviceError: there is none.
        """
        deadline = self._clock.now() + FIRST_FRAME_S
        while True:
            data = patiently(self._clock, self._link.preview)
            arrived = self._clock.now()
            image = self._decoder.decode(data)
            if image is not None:
                break
            if arrived > deadline:
                raise DeviceError(f"the camera at '{self._config.port}' shows no frame of its viewfinder")
            self._clock.sleep_until(arrived + BUSY_PAUSE_S)
        (width, height), wanted = size_of(image), self._config.size
        if (width, height) != wanted:
            raise ConfigError(
                f"hardware.zoom.size: the viewfinder's frames are {width} x {height}, not {wanted[0]} x {wanted[1]}; "
                f"write size = [{width}, {height}], and pitch_mm for it"
            )
        self._due = arrived + 1 / self._config.rate_hz
        self._publish(data, image, arrived)

    def due(self) -> float:
        """When the next frame is to be fetched [s]."""
        return self._due

    def run(self) -> None:
        """Fetch a frame; one that the camera showed before is not a frame."""
        begin = self._clock.now()
        try:
            data = self._link.preview()
        except LinkError as error:
            due = self._patience.next_try(error)
            if due is None:
                raise
            with self._desk.changed:
                self._desk.trouble = str(error)
            self._due = due
            return
        arrived = self._clock.now()
        took, late = arrived - begin, arrived - begin > freshness(self._config)
        self._patience.reset()
        period = 1 / self._config.rate_hz
        if data == self._data:
            self._due = arrived + (REPEAT_PAUSE_S if arrived < self._renewed + REPEAT_LIMIT_S else period)
            return
        self._due = max(self._due + period, begin)
        image = self._decoder.decode(data)
        if image is not None and size_of(image) == self._config.size and not late:
            self._publish(data, image, arrived)
            return
        if image is None:
            trouble = "its frames are broken"
        elif size_of(image) != self._config.size:
            trouble = "its frames are {} x {} now".format(*size_of(image))
        else:
            trouble = f"its frames take {took:.2g} s to come"
            self._data = data  # or it would be taken for a new one if it came once more, in time
        with self._desk.changed:
            self._desk.dropped += 1
            self._desk.trouble = trouble

    def _publish(self, data: bytes, image: Image, arrived: float) -> None:
        self._data, self._renewed = data, arrived
        with self._desk.changed:
            self._desk.frame, self._desk.arrived = Frame(image, arrived - self._config.latency_s), arrived
            self._desk.trouble = ""
            self._desk.changed.notify_all()


def freshness(config: HardwareZoom) -> float:
    """For how long a frame is the newest [s]."""
    return max(FRESH_S, FRESH_FRAMES / config.rate_hz)


def size_of(image: Image) -> tuple[int, int]:
    """(width, height) [px]."""
    return image.shape[1], image.shape[0]
