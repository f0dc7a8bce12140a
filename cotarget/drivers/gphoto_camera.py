"""A zoom camera by gphoto2, such as Canon's PowerShots that can be shot from a computer.

What the thread of a gphoto2 camera shares with those who use the camera.

What a gphoto2 camera does: move its lens, take stills, show frames. Each knows when it is due, and does one step.

All of it happens on the camera's one thread. Errors after which the connection is good for nothing are passed on as
LinkError; being busy is waited for.

Makes an opened gphoto2 camera ready: in shooting mode, with the configured settings, and a lens that can be sent.

One thread's work with a gphoto2 camera: it opens it, does what is most urgent, and finds it again when it was lost.

libgphoto2 is not safe for several threads. The lens comes first and its latest command wins; then stills; and while
there is nothing else to do, frames of the viewfinder.
"""

import contextlib
import logging
import math
import threading
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import TypeVar

from cotarget.config import HardwareZoom
from cotarget.drivers.gphoto import (
    BAD_PARAMETERS,
    CAMERA_BUSY,
    LOST,
    CameraLink,
    GphotoLink,
    LinkError,
    Setting,
    shortened,
)
from cotarget.drivers.lens import LensMotion, LensTable
from cotarget.drivers.mjpeg import JpegDecoder
from cotarget.errors import ConfigError, CotargetError, DeviceError, StaleFrameError
from cotarget.rig import Clock, Frame, Image, ZoomState


@dataclass
class SharedState:
    """What the camera's thread shares with others, who hold ``changed`` to look at it or to change it.

    Attributes:
        changed: told of every change.
        frame: the newest of the viewfinder.
        arrived: when it did [s].
        wanted: the position that the lens is to have.
        order: counts the lens's commands.
        standing: whether the lens has taken the last of them.
        motion: where the lens is; None before the camera is open.
        lens_trouble: why the lens does not do what it was told; empty if it does.
        called: whether the camera's thread has something new to do.
        still: who waits for a still.
        trouble: what keeps frames from coming; empty while they come.
        dropped: frames that were broken, late or of another size.
        gone: why the camera cannot be used any more; empty while it can.
    """

    changed: threading.Condition = field(default_factory=threading.Condition)
    frame: Frame | None = None
    arrived: float = -math.inf
    wanted: int = 0
    order: int = 0
    standing: bool = True
    motion: LensMotion | None = None
    lens_trouble: str = ""
    called: bool = False
    still: "Future[Frame] | None" = None
    trouble: str = ""
    dropped: int = 0
    gone: str = ""

    def dismiss(self, why: str) -> None:
        """Let everybody know that the camera cannot be used any more."""
        with self.changed:
            self.gone, self.called = self.gone or why, True
            still, self.still = self.still, None
            self.changed.notify_all()
        if still is not None and not still.done():
            still.set_exception(DeviceError(why))


# --- gphoto_setup ---

log = logging.getLogger(__name__)
# gphoto2's names: what switches a camera to shooting, and where its stills go. They stay out of its card, because a
# still in memory is sent at once, and so that a card does not fill up.
SHOOTING, TARGET, MEMORY = "capture", "capturetarget", "Internal RAM"
# A busy camera is told apart from a wrong value by its ranges, which are checked before: both come back as -2.
BUSY = frozenset({BAD_PARAMETERS, CAMERA_BUSY})
BUSY_PAUSE_S, BUSY_PATIENCE_S = 0.1, 3.0
LATEST = 2**31  # date that libgphoto2 can tell [s since 1970]
T = TypeVar("T")


@dataclass(frozen=True)
class ZoomSetting:
    """The setting that moves the lens.

    Attributes:
        name: gphoto2's.
        lens: what its positions mean.
        values: how each position is written.
    """

    name: str
    lens: LensTable
    values: Mapping[int, str | float]


def patiently(clock: Clock, call: Callable[[], T]) -> T:
    """Do a call again for a while, as long as the camera is busy."""
    deadline = clock.now() + BUSY_PATIENCE_S
    while True:
        try:
            return call()
        except LinkError as error:
            if error.code not in BUSY or clock.now() >= deadline:
                raise
        clock.sleep_until(clock.now() + BUSY_PAUSE_S)


def set_up(link: CameraLink, config: HardwareZoom, clock: Clock, camera: str) -> ZoomSetting:
    """Bring an opened camera to where it follows.

    Args:
        link: open.
        config: what is wanted.
        clock: the rig's.
        camera: its name, for messages.

    Raises:
        ConfigError: the camera has no such setting or value, or cannot be zoomed as configured.
        LinkError: a call failed.
    """
    if SHOOTING in link.names():
        patiently(clock, lambda: link.put(SHOOTING, 1))
    names = link.names()  # PowerShots show their lens only when they shoot
    # Even where it shows memory already: what was never set it shows so, and has PowerShots use the card.
    own = TARGET not in names or TARGET in config.settings
    if not own and MEMORY in patiently(clock, lambda: link.get(TARGET)).choices:
        patiently(clock, lambda: link.put(TARGET, MEMORY))
    for name, value in config.settings.items():
        _apply(link, clock, camera, names, name, value)
    return _zoom_setting(link, config, clock, camera, names)


def _apply(link: CameraLink, clock: Clock, camera: str, names: Collection[str], name: str, value: str) -> None:
    if name not in names:
        known = shortened(names, name)
        raise ConfigError(f"hardware.zoom.settings: the {camera} has no setting '{name}'; valid here: {known}")
    setting = patiently(clock, lambda: link.get(name))
    _check(setting, f"hardware.zoom.settings.{name}", value)
    patiently(clock, lambda: link.put(name, value))
    got = patiently(clock, lambda: link.get(name)).value
    if setting.kind == "date":  # it goes on
        return
    if got != value and not (isinstance(got, float) and got == float(value)):
        log.warning("the %s took '%s' for its setting '%s' as '%s'", camera, value, name, got)


def _check(setting: Setting, where: str, value: str) -> None:
    """Refuse a value that a setting cannot have."""
    if setting.readonly:
        raise ConfigError(f"{where}: this camera's can only be read; it is '{setting.value}'")
    if setting.kind == "choice" and value not in setting.choices:
        raise ConfigError(f"{where}: '{value}' is not one of: {shortened(setting.choices, value)}")
    if setting.kind == "switch" and value not in ("0", "1"):
        raise ConfigError(f"{where}: '{value}' is not one of: 0, 1")
    if setting.kind == "range":
        number = _number(value)
        if number is None or not setting.low <= number <= setting.high:
            raise ConfigError(f"{where}: '{value}' is not within {setting.low:g} to {setting.high:g}")
    if setting.kind == "date" and not (value.isascii() and value.isdigit() and int(value) < LATEST):
        raise ConfigError(f"{where}: '{value}' is no time in whole seconds since 1970")


def _zoom_setting(
    link: CameraLink, config: HardwareZoom, clock: Clock, camera: str, names: Collection[str]
) -> ZoomSetting:
    """What moves the lens, checked against the table of its focal lengths."""
    name, (first, last) = config.zoom_key, (config.lens[0][0], config.lens[-1][0])
    if name not in names:
        known = shortened(names, name)
        raise ConfigError(
            f"hardware.zoom: the {camera} has no setting '{name}'; it cannot be zoomed; its settings are: {known}"
        )
    setting = patiently(clock, lambda: link.get(name))
    values = _positions(setting)
    if not values:
        raise ConfigError(
            f"hardware.zoom.zoom_key: '{name}' of the {camera} is neither a range nor a list of positions, "
            f"but '{setting.value}'"
        )
    if setting.readonly:
        raise ConfigError(f"hardware.zoom.zoom_key: '{name}' of the {camera} can only be read; it cannot be zoomed")
    if first < min(values) or last > max(values):
        raise ConfigError(
            f"hardware.zoom.lens: positions {first} to {last} exceed those of the {camera}'s '{name}', "
            f"{min(values)} to {max(values)}"
        )
    inside = tuple(sorted(position for position in values if first <= position <= last))
    if len(inside) < 2:
        raise ConfigError(f"hardware.zoom.lens: the {camera} cannot be sent to positions between {first} and {last}")
    return ZoomSetting(name, LensTable(config.lens, inside, config.pitch_mm), values)


def _positions(setting: Setting) -> dict[int, str | float]:
    """Where a setting can send a lens, and how that is written; empty where it is no lens's."""
    if setting.kind == "range":
        step = setting.step if setting.step > 0 else 1.0
        count = int((setting.high - setting.low) / step) + 1
        return {round(setting.low + i * step): setting.low + i * step for i in range(count)}
    numbers = {choice: _number(choice) for choice in setting.choices}
    return {round(number): choice for choice, number in numbers.items() if number is not None}


def position_in(setting: Setting) -> float | None:
    """The lens's position that a setting shows [1]; None where it shows none."""
    return _number(setting.value)


def _number(value: str | float) -> float | None:
    try:
        return float(value)
    except ValueError:
        return None


# --- gphoto_duties ---

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


class LensJob:
    """Sends the lens where the latest command wants it, and reads back whether it went."""

    def __init__(self, config: HardwareZoom, clock: Clock, link: CameraLink, shared: SharedState) -> None:
        self._config, self._clock, self._link, self._shared = config, clock, link, shared
        self._zoom: ZoomSetting | None = None
        self._order = -1  # being carried out
        self._sent, self._tries, self._due, self._deadline = False, 0, 0.0, 0.0
        self._patience = Patience(clock)

    def begin(self, zoom: ZoomSetting, first: bool) -> None:
        """Look where a camera just opened has its lens; it is sent back to where it was before the camera was lost."""
        self._zoom, self._order, shared = zoom, -1, self._shared
        reading = position_in(patiently(self._clock, lambda: self._link.get(zoom.name)))
        position = zoom.lens.positions[0] if reading is None else reading
        now = self._clock.now()
        with shared.changed:
            if first:
                shared.wanted = min(zoom.lens.positions, key=lambda each: abs(each - position))
            shared.motion = LensMotion(position, position, now, self._config.lens_speed)
            shared.standing = reading == shared.wanted
            self._order = shared.order if shared.standing else -1

    def due(self) -> float:
        """When there is something to do [s]."""
        with self._shared.changed:
            if self._shared.lens_trouble or (self._shared.standing and self._order == self._shared.order):
                return math.inf
            return self._due if self._order == self._shared.order else -math.inf

    def run(self) -> None:
        """Send or verify."""
        with self._shared.changed:
            order, wanted = self._shared.order, self._shared.wanted
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
        with self._shared.changed:
            assert self._shared.motion is not None, "the camera is not open"
            self._shared.motion = motion = self._shared.motion.toward(wanted, start)
        self._sent, self._tries = True, self._tries + 1
        self._due = now = self._clock.now()
        self._deadline = max(motion.arrives, now) + VERIFY_S

    def _verify(self, zoom: ZoomSetting, wanted: int) -> None:
        reading = position_in(self._link.get(zoom.name))
        if reading == wanted:
            with self._shared.changed:
                self._shared.standing = self._shared.order == self._order
        elif self._clock.now() < self._deadline:
            self._due = self._clock.now() + VERIFY_PAUSE_S
        elif self._tries < LENS_TRIES:
            self._sent, self._due = False, self._clock.now()
        else:
            shown = "nothing" if reading is None else f"{reading:g}"
            self._give_up(wanted, f"its setting '{zoom.name}' reads {shown}")

    def _give_up(self, wanted: int, why: str) -> None:
        with self._shared.changed:
            if self._shared.order == self._order:  # a newer command deserves its own chance
                self._shared.lens_trouble = f"the zoom camera's lens did not go to position {wanted}: {why}"
                self._shared.changed.notify_all()


class StillJob:
    """Takes a still for whoever waits for one."""

    def __init__(self, config: HardwareZoom, clock: Clock, link: CameraLink, shared: SharedState) -> None:
        self._config, self._clock, self._link, self._shared = config, clock, link, shared
        self._future: Future[Frame] | None = None
        self._due = -math.inf
        self._patience = Patience(clock)
        self._decoder = JpegDecoder()

    def due(self) -> float:
        """When there is something to do [s]."""
        with self._shared.changed:
            if self._shared.still is None:
                return math.inf
            return self._due if self._shared.still is self._future else -math.inf

    def run(self) -> None:
        """Take it."""
        with self._shared.changed:
            future = self._shared.still
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
        with self._shared.changed:
            if self._shared.still is future:
                self._shared.still = None
        if isinstance(result, Frame):
            future.set_result(result)
        else:
            future.set_exception(result)


class ViewJob:
    """Fetches frames of the viewfinder and publishes the newest."""

    def __init__(self, config: HardwareZoom, clock: Clock, link: CameraLink, shared: SharedState) -> None:
        self._config, self._clock, self._link, self._shared = config, clock, link, shared
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
            with self._shared.changed:
                self._shared.trouble = str(error)
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
        with self._shared.changed:
            self._shared.dropped += 1
            self._shared.trouble = trouble

    def _publish(self, data: bytes, image: Image, arrived: float) -> None:
        self._data, self._renewed = data, arrived
        with self._shared.changed:
            self._shared.frame, self._shared.arrived = Frame(image, arrived - self._config.latency_s), arrived
            self._shared.trouble = ""
            self._shared.changed.notify_all()


def freshness(config: HardwareZoom) -> float:
    """For how long a frame is the newest [s]."""
    return max(FRESH_S, FRESH_FRAMES / config.rate_hz)


def size_of(image: Image) -> tuple[int, int]:
    """(width, height) [px]."""
    return image.shape[1], image.shape[0]


# --- gphoto_work ---

# A camera on USB that another program left in the middle of something answers at the second attempt.
USB_TRIES = 2
# A lost camera is looked for after this pause, doubled each time, until this long after the loss.
FIRST_PAUSE_S, RECONNECT_S = 0.1, 5.0


class Shooting:
    """The camera's work; all methods are called from one thread.

    Args:
        config: the camera's.
        clock: the rig's.
        link: to the camera, not open yet.
        shared: where commands come from and results go.
    """

    def __init__(self, config: HardwareZoom, clock: Clock, link: CameraLink, shared: SharedState) -> None:
        self._config, self._clock, self._link, self._shared = config, clock, link, shared
        self._lens = LensJob(config, clock, link, shared)
        self._still = StillJob(config, clock, link, shared)
        self._view = ViewJob(config, clock, link, shared)
        self._connected = False
        self._lost_at = self._attempt = 0.0
        self._pause = FIRST_PAUSE_S

    def open(self) -> ZoomSetting:
        """Open the camera, and see that it is as configured.

        Raises:
            ConfigError: it is another camera than configured.
            DeviceError: it does not answer, or not as it should.
        """
        tries = USB_TRIES if self._config.port.startswith("usb:") else 1
        for left in reversed(range(tries)):
            try:
                return self._connect(first=True)
            except LinkError as error:
                if not left or error.code not in LOST:
                    raise DeviceError(f"the camera at '{self._config.port}' cannot be used: {error}") from error
                self._clock.sleep_until(self._clock.now() + FIRST_PAUSE_S)
            except CotargetError:
                raise
            except Exception as error:  # a user can do nothing with a traceback
                log.debug("opening the zoom camera failed", exc_info=True)
                raise DeviceError(f"the camera at '{self._config.port}' cannot be used: {error!r}") from error
        raise AssertionError("the last attempt succeeds or fails")

    def close(self) -> None:
        """Let the camera leave shooting, if it still answers, and disconnect."""
        if self._connected:
            try:
                if SHOOTING in self._link.names():
                    self._link.put(SHOOTING, 0)
            except LinkError as error:
                log.debug("the camera may still be in shooting mode: %s", error)
        self._disconnect()

    def work(self) -> float:
        """Do the most urgent thing that is due; return when something is due again [s]."""
        now = self._clock.now()
        if self._shared.gone:
            return math.inf
        if not self._connected:
            if now >= self._attempt:
                self._look_again()
            return now if self._connected else self._attempt
        jobs = (self._lens, self._still, self._view)
        try:
            due = next((job for job in jobs if job.due() <= now), None)
            if due is not None:
                due.run()
        except LinkError as error:
            log.warning("the zoom camera at '%s' is lost: %s", self._config.port, error)
            self._lost_at, self._pause = self._clock.now(), FIRST_PAUSE_S
            self._wait(error)
            self._disconnect()  # takes 5 s where the camera is silent
            return self._attempt
        return min(job.due() for job in jobs)

    def _connect(self, first: bool) -> ZoomSetting:
        """Open the link and everything behind it; what fails leaves it closed."""
        try:
            camera = self._link.open()
            zoom = set_up(self._link, self._config, self._clock, camera)
            self._lens.begin(zoom, first)
            self._view.begin()
        except BaseException:
            self._disconnect()
            raise
        self._connected = True
        return zoom

    def _disconnect(self) -> None:
        self._connected = False
        try:
            self._link.close()
        except LinkError as error:
            log.debug("closing the camera: %s", error)

    def _look_again(self) -> None:
        """Try to find a lost camera."""
        try:
            self._connect(first=False)
        except (LinkError, DeviceError) as error:
            if self._clock.now() >= self._lost_at + RECONNECT_S:
                self._give_up(error)
            else:
                self._wait(error)
        except ConfigError as error:  # it came back as another one
            self._give_up(error)
        else:
            log.info("the zoom camera at '%s' is back", self._config.port)

    def _wait(self, error: Exception) -> None:
        self._attempt, self._pause = self._clock.now() + self._pause, 2 * self._pause
        with self._shared.changed:
            self._shared.trouble = f"looking for the camera again, {error}"

    def _give_up(self, error: CotargetError | LinkError) -> None:
        why = f"the zoom camera at '{self._config.port}' is gone: {error}"
        log.error("%s", why)
        self._shared.dismiss(why)


# Opening takes 1 to 2 s; a camera that brings its lens out, or is busy, some more.
OPEN_LIMIT_S = 30.0
# A still with focusing, flash and a slow line.
STILL_LIMIT_S = 30.0
# Leaving takes two round trips; libgphoto2 waits 2.5 s for each where a camera is silent, and a program that ends
# because of that shall not hang.
CLOSE_LIMIT_S = 3.0


class GphotoCamera:
    """A camera whose lens, viewfinder and stills gphoto2 drives, on a thread of its own.

    A frame's time is when its last byte came, less ``latency_s``: however the camera makes the driver wait, that is
    what a latency measured at bring-up contains. A still's time is the middle of the call that takes it, its transfer
    apart where the camera sends it apart: the shutter opens somewhere within, so the error is at most half that time.
    Frames that took too long to come to be dated so are dropped. While a still is taken the viewfinder is blind, and
    `read` waits.

    The lens's position between commands is the driver's own estimate from ``lens_speed`` and ``command_delay_s``. A
    camera that is lost is looked for again for some seconds, and its lens sent back; then it is gone, and every call
    says so.

    Args:
        config: which camera, and what is known of it.
        clock: the rig's, in real time.
        link: to the camera, not open yet; None for gphoto2.

    Raises:
        ConfigError: the camera is another than configured, or gphoto2 is not installed.
        DeviceError: it is not there, or does not answer.
    """

    def __init__(self, config: HardwareZoom, clock: Clock, link: CameraLink | None = None) -> None:
        self._config, self._clock = config, clock
        self._shared = SharedState()
        self._still_turn = threading.Lock()
        link = GphotoLink(config.port, config.model) if link is None else link
        opened: Future[ZoomSetting] = Future()
        work = Shooting(config, clock, link, self._shared)
        self._thread = threading.Thread(target=self._run, args=(work, opened), name="zoom camera", daemon=True)
        self._thread.start()
        try:
            self._lens = opened.result(OPEN_LIMIT_S).lens
        except TimeoutError:
            self.close()
            raise DeviceError(f"the camera at '{config.port}' did not open within {OPEN_LIMIT_S:g} s") from None
        except BaseException:
            self.close()
            raise

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the viewfinder's frames [px]."""
        return self._config.size

    @property
    def still_size(self) -> tuple[int, int]:
        """(width, height) of full stills [px]."""
        return self._config.still_size

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest nominal focal length [px] of the viewfinder's frames."""
        return self._lens.focal_range

    @property
    def dropped(self) -> int:
        """How many frames were broken, late or of another size, and therefore not handed out."""
        with self._shared.changed:
            return self._shared.dropped

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame; with ``newer_than`` [s] for one exposed after that time.

        Raises:
            StaleFrameError: no such frame arrived within ``timeout`` [s].
            DeviceError: the camera is gone.
        """
        shared = self._shared
        fresh = freshness(self._config)

        def there() -> bool:
            if shared.gone:
                return True
            new = shared.frame is not None and (newer_than is None or shared.frame.t > newer_than)
            return new and self._clock.now() - shared.arrived <= fresh

        with shared.changed:
            came = shared.changed.wait_for(there, timeout)
            self._check()
            if came and shared.frame is not None:
                return shared.frame
            which = "frame" if newer_than is None else f"frame newer than {newer_than:.3f} s"
            raise StaleFrameError(
                f"no {which} from the zoom camera within {timeout:g} s{shared.trouble and f': {shared.trouble}'}"
            )

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving; return at once the nominal focal length [px] of the position that it will reach.

        Raises:
            DeviceError: it is no focal length, or the camera is gone.
        """
        if not focal_px > 0 or math.isinf(focal_px):
            raise DeviceError(f"the lens cannot go to a focal length of {focal_px} px")
        position, shared = self._lens.position_for(focal_px), self._shared
        with shared.changed:
            self._check()
            if position != shared.wanted or shared.lens_trouble:
                shared.wanted, shared.order = position, shared.order + 1
                shared.standing, shared.lens_trouble, shared.called = False, "", True
                shared.changed.notify_all()
        return self._lens.focal_at(position)

    def state(self) -> ZoomState:
        """The lens's state now: moving until it should have arrived, and its setting was read back.

        Raises:
            DeviceError: the lens did not go where it was sent, or the camera is gone.
        """
        shared = self._shared
        with shared.changed:
            self._check()
            if shared.lens_trouble:
                raise DeviceError(shared.lens_trouble)
            assert shared.motion is not None, "an open camera knows its lens"
            now = self._clock.now()
            moving = not shared.standing or now < shared.motion.arrives
            return ZoomState(self._lens.focal_at(shared.motion.position(now)), moving, now)

    def capture(self) -> Frame:
        """Take a full still.

        Raises:
            ConfigError: stills are of another size than configured.
            DeviceError: the camera took none.
        """
        shared = self._shared
        with self._still_turn:
            future: Future[Frame] = Future()
            with shared.changed:
                self._check()
                shared.still, shared.called = future, True
                shared.changed.notify_all()
            try:
                return future.result(STILL_LIMIT_S)
            except TimeoutError:
                raise DeviceError(f"the zoom camera took no still within {STILL_LIMIT_S:g} s") from None
            finally:
                with shared.changed:
                    if shared.still is future:
                        shared.still = None

    def close(self) -> None:
        """Let the camera go; harmless when that was done before."""
        self._shared.dismiss("the zoom camera is closed")
        self._thread.join(CLOSE_LIMIT_S)
        if self._thread.is_alive():
            log.warning("the zoom camera at '%s' does not answer; it is left as it is", self._config.port)

    def _check(self) -> None:
        if self._shared.gone:
            raise DeviceError(self._shared.gone)

    def _run(self, work: Shooting, opened: "Future[ZoomSetting]") -> None:
        """The camera's thread."""
        try:
            opened.set_result(work.open())
        except Exception as error:
            opened.set_exception(error)
            return
        try:
            while not self._shared.gone:
                self._rest_until(work.work())
        except Exception as error:  # a thread must not die in silence
            log.debug("the driver of the zoom camera failed", exc_info=True)
            self._shared.dismiss(f"the driver of the zoom camera failed: {error!r}")
        finally:
            with contextlib.suppress(Exception):
                work.close()

    def _rest_until(self, due: float) -> None:
        """Wait until something is due, or somebody wants something."""
        shared = self._shared
        with shared.changed:
            shared.changed.wait_for(
                lambda: shared.called, min(max(due - self._clock.now(), 0.0), threading.TIMEOUT_MAX)
            )
            shared.called = False
