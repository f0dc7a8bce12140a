"""The zoom camera through libgphoto2, such as a Canon PowerShot that takes remote commands.

libgphoto2 is not safe for several threads. One thread therefore owns the camera: `Shooting` opens it, does the most
urgent job, and opens it again after a loss. The lens comes first and its latest command wins; then come stills; then
viewfinder frames. `SharedState` carries commands and results between that thread and the callers of `GphotoCamera`.
Errors that end the connection are passed on as LinkError; a busy camera is asked again.

Measurements and faults of the library: docs/design-notes.md.
"""

import contextlib
import itertools
import logging
import math
import threading
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Annotated, TypeVar

from cotarget.drivers.frame_buffer import BufferedCamera, FrameBuffer
from cotarget.drivers.gphoto import (
    BAD_PARAMETERS,
    CAMERA_BUSY,
    LOST,
    GphotoLink,
    LinkError,
    Setting,
    closest,
)
from cotarget.drivers.lens import LensMotion, LensPositions
from cotarget.drivers.mjpeg import DamagedError, decode_jpeg
from cotarget.errors import ConfigError, CotargetError, DeviceError
from cotarget.plugins import place_of
from cotarget.rig import Clock, Frame, ZoomSpec, ZoomState
from cotarget.schema import Check, Needed, NotNegative, Positive, Size, model

log = logging.getLogger(__name__)
# Positions of the S5 IS's lens and their focal lengths [mm], as measured by the CHDK project.
S5_IS_LENS = ((0, 6.0), (11, 6.4), (41, 12.1), (64, 21.3), (86, 41.6), (105, 61.4), (128, 72.0))


def _lens_table(lens: tuple[tuple[int, float], ...]) -> tuple[tuple[int, float], ...]:
    if len(lens) < 2 or any(b[0] <= a[0] or b[1] <= a[1] for a, b in itertools.pairwise(lens)):
        raise ValueError("needs two or more [position, mm], both of them increasing")
    return lens


@model
class GphotoSettings:
    """The zoom camera, by gphoto2.

    Attributes:
        port: "usb:", "usb:BUS,DEVICE" or "ptpip:host:port:port", as gphoto2 writes them.
        model: gphoto2's name of the model; empty for the camera that is found at the port.
        settings: further settings to make when the camera is opened, by gphoto2's names.
        zoom_key: gphoto2's name of the setting that moves the lens.
        lens: some lens positions and their nominal focal lengths, both increasing; between them the logarithm of the
            focal length is interpolated.
        lens_speed: lens positions per second; the end of a movement is computed from it, as the camera reports none.
        size: size of the viewfinder's frames [px].
        still_size: size of full stills [px].
        pitch_mm: nominal size of a pixel of the viewfinder's frames [mm].
        rate_hz: highest number of viewfinder frames per second.
        latency_s: time from light to a frame, as measured [s].
        command_delay_s: time from a command to the start of the lens's motion [s].
    """

    port: Annotated[str, Needed("usb:")] = ""
    model: str = ""
    settings: Mapping[str, str] = field(default_factory=dict)
    zoom_key: str = "zoom"
    lens: Annotated[tuple[Annotated[tuple[int, Positive], "[position, mm]"], ...], Check(_lens_table)] = S5_IS_LENS
    lens_speed: Positive = 60.0
    size: Size = (320, 240)
    still_size: Size = (3264, 2448)
    pitch_mm: Positive = 0.01794
    rate_hz: Positive = 15.0
    latency_s: NotNegative = 0.1
    command_delay_s: NotNegative = 0.05

    @property
    def spec(self) -> ZoomSpec:
        """Describe the camera; the lens may have fewer positions than its table."""
        shortest, longest = (mm / self.pitch_mm for _, mm in (self.lens[0], self.lens[-1]))
        return ZoomSpec(
            size=self.size,
            rate_hz=self.rate_hz,
            latency_s=self.latency_s,
            focal_range=(shortest, longest),
            pitch_mm=self.pitch_mm,
            still_size=self.still_size,
            delay_s=self.command_delay_s,
        )


@dataclass
class SharedState:
    """Commands to the camera's thread and its results; hold ``changed``, notified at every change, to use them."""

    frames: FrameBuffer  # of the viewfinder; its lock is apart from ``changed``
    changed: threading.Condition = field(default_factory=threading.Condition)
    wanted: float = 0  # commanded lens position
    order: int = 0  # sequence number of the lens command
    standing: bool = True  # whether the lens has reached the last command
    motion: LensMotion | None = None  # estimated; None before the camera is open
    lens_trouble: str = ""  # why the lens does not follow its command; empty if it does
    called: bool = False  # whether the camera's thread has a new command
    still: "Future[Frame] | None" = None  # that a caller waits for

    @property
    def gone(self) -> str:
        """Why the camera cannot be used any more; empty while it can."""
        return self.frames.gone

    def dismiss(self, why: str) -> None:
        """Mark the camera as unusable, and end every wait for it."""
        self.frames.fail(why)
        with self.changed:
            self.called = True
            still, self.still = self.still, None
            self.changed.notify_all()
        if still is not None and not still.done():
            still.set_exception(DeviceError(why))


# Setup of an opened camera

# gphoto2's names of the settings for shooting mode and for the destination of stills. Stills go to memory: they are
# sent at once, and the card does not fill up.
SHOOTING, TARGET, MEMORY = "capture", "capturetarget", "Internal RAM"
# -2 means busy or a wrong value; values are checked against the setting's range before, so that here it means busy.
BUSY = frozenset({BAD_PARAMETERS, CAMERA_BUSY})
BUSY_PAUSE_S, BUSY_PATIENCE_S = 0.1, 3.0
LATEST = 2**31  # first date that libgphoto2 cannot express [s since 1970]
T = TypeVar("T")


@dataclass(frozen=True)
class ZoomSetting:
    """The camera setting that moves the lens: its name, focal lengths, and the value for each position."""

    name: str
    lens: LensPositions
    values: Mapping[float, str | float]


def patiently(clock: Clock, call: Callable[[], T]) -> T:
    """Repeat a call for `BUSY_PATIENCE_S` while the camera is busy."""
    deadline = clock.now() + BUSY_PATIENCE_S
    while True:
        try:
            return call()
        except LinkError as error:
            if error.code not in BUSY or clock.now() >= deadline:
                raise
        clock.sleep_until(clock.now() + BUSY_PAUSE_S)


def set_up(link: GphotoLink, config: GphotoSettings, clock: Clock, camera: str) -> ZoomSetting:
    """Switch an opened camera to shooting mode and apply the configured settings; ``camera`` names it in messages.

    Raises:
        ConfigError: the camera has no such setting or value, or cannot be zoomed as configured.
        LinkError: a call failed.
    """
    if SHOOTING in link.names():
        patiently(clock, lambda: link.put(SHOOTING, 1))
    names = link.names()  # PowerShots list their lens setting only in shooting mode
    # Set even where the setting reads memory already: PowerShots show memory and use the card until it is set.
    own = TARGET not in names or TARGET in config.settings
    if not own and MEMORY in patiently(clock, lambda: link.get(TARGET)).choices:
        patiently(clock, lambda: link.put(TARGET, MEMORY))
    for name, value in config.settings.items():
        _apply(link, clock, camera, names, name, value)
    return _zoom_setting(link, config, clock, camera, names)


def _apply(link: GphotoLink, clock: Clock, camera: str, names: Collection[str], name: str, value: str) -> None:
    if name not in names:
        known = closest(names, name)
        raise ConfigError(f"hardware.zoom.settings: the {camera} has no setting '{name}'; valid here: {known}")
    setting = patiently(clock, lambda: link.get(name))
    _check(setting, f"hardware.zoom.settings.{name}", value)
    patiently(clock, lambda: link.put(name, value))
    got = patiently(clock, lambda: link.get(name)).value
    if setting.kind == "date":  # the camera's clock advances
        return
    if got != value and not (isinstance(got, float) and got == float(value)):
        log.warning("the %s took '%s' for its setting '%s' as '%s'", camera, value, name, got)


def _check(setting: Setting, where: str, value: str) -> None:
    """Refuse a value that a setting does not take."""
    if setting.readonly:
        raise ConfigError(f"{where}: this camera's can only be read; it is '{setting.value}'")
    if setting.choices and value not in setting.choices:
        raise ConfigError(f"{where}: '{value}' is not one of: {closest(setting.choices, value)}")
    if setting.kind == "range":
        number = _number(value)
        if number is None or not setting.low <= number <= setting.high:
            raise ConfigError(f"{where}: '{value}' is not within {setting.low:g} to {setting.high:g}")
    if setting.kind == "date" and not (value.isascii() and value.isdigit() and int(value) < LATEST):
        raise ConfigError(f"{where}: '{value}' is no time in whole seconds since 1970")


def _zoom_setting(
    link: GphotoLink, config: GphotoSettings, clock: Clock, camera: str, names: Collection[str]
) -> ZoomSetting:
    """Find the setting that moves the lens, and check it against the configured lens table."""
    name, (first, last) = config.zoom_key, (config.lens[0][0], config.lens[-1][0])
    if name not in names:
        known = closest(names, name)
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
    return ZoomSetting(name, LensPositions(config.lens, inside, config.pitch_mm), values)


def _positions(setting: Setting) -> dict[float, str | float]:
    """List a setting's lens positions and the value that selects each; empty if the setting moves no lens."""
    if setting.kind == "range":
        step = setting.step if setting.step > 0 else 1.0
        count = int((setting.high - setting.low) / step) + 1
        return {round(setting.low + i * step): setting.low + i * step for i in range(count)}
    numbers = {choice: _number(choice) for choice in setting.choices}
    return {round(number): choice for choice, number in numbers.items() if number is not None}


def _number(value: str | float) -> float | None:
    """Parse a setting's value; None where it is no number."""
    try:
        return float(value)
    except ValueError:
        return None


# Jobs of the camera's thread: each says when it is due, and does one step

# A lens that does not read as commanded is read again until `VERIFY_S` after it should stand, and then sent again [s].
VERIFY_PAUSE_S, VERIFY_S, LENS_TRIES = 0.1, 1.0, 2
# A viewfinder without a new frame returns the last one again. It is asked again after a short pause, so that the new
# frame's arrival time is right; after `REPEAT_LIMIT_S` without a new frame, only once a frame period [s].
REPEAT_PAUSE_S, REPEAT_LIMIT_S = 0.005, 1.0
# Time limit for the first frame [s]: the lens may extend when the viewfinder is switched on.
FIRST_FRAME_S = 10.0
# A frame is current for this time [s], or this number of frame periods where that is longer. Without a current frame
# `read` waits, and the pipeline stops the head, which must happen within half a second of the fault. A frame that took
# longer to arrive may be older than this, and is dropped.
FRESH_S, FRESH_FRAMES = 0.2, 2.0


class Patience:
    """Time limit for a camera that stays busy."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._since: float | None = None

    def reset(self) -> None:
        """Note that the camera has done what was requested."""
        self._since = None

    def next_try(self, error: LinkError) -> float | None:
        """Return when to try again [s]; None after `BUSY_PATIENCE_S`. Raises the error if the connection is lost."""
        if error.code in LOST:
            raise error
        now = self._clock.now()
        self._since = now if self._since is None else self._since
        return now + BUSY_PAUSE_S if now < self._since + BUSY_PATIENCE_S else None


class LensJob:
    """Send the lens to the latest command, and verify that it went there."""

    def __init__(self, config: GphotoSettings, clock: Clock, link: GphotoLink, shared: SharedState) -> None:
        self._config, self._clock, self._link, self._shared = config, clock, link, shared
        self._zoom: ZoomSetting | None = None
        self._order = -1  # the command being carried out
        self._sent, self._tries, self._due, self._deadline = False, 0, 0.0, 0.0
        self._patience = Patience(clock)

    def begin(self, zoom: ZoomSetting, first: bool) -> None:
        """Take a camera's lens position as the command when first opened; after a loss send the lens back."""
        self._zoom, self._order, shared = zoom, -1, self._shared
        reading = _number(patiently(self._clock, lambda: self._link.get(zoom.name)).value)
        position = zoom.lens.positions[0] if reading is None else reading
        now = self._clock.now()
        with shared.changed:
            if first:
                shared.wanted = min(zoom.lens.positions, key=lambda each: abs(each - position))
            shared.motion = LensMotion(position, position, now, self._config.lens_speed)
            shared.standing = reading == shared.wanted
            self._order = shared.order if shared.standing else -1

    def due(self) -> float:
        """Return when the next step is due [s]."""
        with self._shared.changed:
            if self._shared.lens_trouble or (self._shared.standing and self._order == self._shared.order):
                return math.inf
            return self._due if self._order == self._shared.order else -math.inf

    def run(self) -> None:
        """Send the command, or verify the last one."""
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

    def _send(self, zoom: ZoomSetting, wanted: float) -> None:
        start = self._clock.now() + self._config.command_delay_s
        self._link.put(zoom.name, zoom.values[wanted])
        with self._shared.changed:
            assert self._shared.motion is not None, "the camera is not open"
            self._shared.motion = motion = self._shared.motion.toward(wanted, start)
        self._sent, self._tries = True, self._tries + 1
        self._due = now = self._clock.now()
        self._deadline = max(motion.arrives, now) + VERIFY_S

    def _verify(self, zoom: ZoomSetting, wanted: float) -> None:
        reading = _number(self._link.get(zoom.name).value)
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

    def _give_up(self, wanted: float, why: str) -> None:
        with self._shared.changed:
            if self._shared.order == self._order:  # the failure does not concern a newer command
                self._shared.lens_trouble = f"the zoom camera's lens did not go to position {wanted}: {why}"
                self._shared.changed.notify_all()


class StillJob:
    """Take a still for the caller that waits for one."""

    def __init__(self, config: GphotoSettings, clock: Clock, link: GphotoLink, shared: SharedState) -> None:
        self._config, self._clock, self._link, self._shared = config, clock, link, shared
        self._future: Future[Frame] | None = None
        self._due = -math.inf
        self._patience = Patience(clock)

    def due(self) -> float:
        """Return when the next attempt is due [s]."""
        with self._shared.changed:
            if self._shared.still is None:
                return math.inf
            return self._due if self._shared.still is self._future else -math.inf

    def run(self) -> None:
        """Try to take the still."""
        with self._shared.changed:
            future = self._shared.still
        if future is None:  # the caller has given up
            return
        if future is not self._future:
            self._future = future
            self._patience.reset()
        try:
            self._finish(future, self._take())
        except LinkError as error:
            if error.code in LOST:
                self._finish(future, DeviceError(f"the zoom camera was lost while it took a still: {error}"))
            if (due := self._patience.next_try(error)) is None:
                self._finish(future, DeviceError(f"the zoom camera takes no still: {error}"))
            else:
                self._due = due
        except (ConfigError, DeviceError) as error:
            self._finish(future, error)

    def _take(self) -> Frame:
        begin = self._clock.now()
        still = self._link.shoot()
        end = self._clock.now()
        try:
            image = decode_jpeg(self._link.fetch(still))
        except DamagedError:
            reason = f"the zoom camera's still '{still[1]}' is damaged, or no JPEG; set it to take JPEGs"
            raise DeviceError(reason) from None
        size, wanted = (image.shape[1], image.shape[0]), self._config.still_size
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
    """Fetch viewfinder frames and publish the newest."""

    def __init__(self, config: GphotoSettings, clock: Clock, link: GphotoLink, frames: FrameBuffer) -> None:
        self._config, self._clock, self._link, self._frames = config, clock, link, frames
        self._due = -math.inf
        self._patience = Patience(clock)

    def begin(self) -> None:
        """Wait for the first frame of a camera just opened, and check its size."""
        deadline = self._clock.now() + FIRST_FRAME_S
        while True:
            data = patiently(self._clock, self._link.preview)
            arrived = self._clock.now()
            try:
                height, width, _ = self._frames.decode(data).shape
                break
            except DamagedError:
                if arrived > deadline:
                    reason = f"the camera at '{self._config.port}' shows no frame of its viewfinder"
                    raise DeviceError(reason) from None
            self._clock.sleep_until(arrived + BUSY_PAUSE_S)
        wanted = self._config.size
        if (width, height) != wanted:
            raise ConfigError(
                f"hardware.zoom.size: the viewfinder's frames are {width} x {height}, not {wanted[0]} x {wanted[1]}; "
                f"write size = [{width}, {height}], and pitch_mm for it"
            )
        self._due = arrived + 1 / self._config.rate_hz
        self._frames.opened()
        self._frames.put(data, arrived)

    def due(self) -> float:
        """Return when the next frame is to be fetched [s]."""
        return self._due

    def run(self) -> None:
        """Fetch a frame; publish it if it is new."""
        begin = self._clock.now()
        try:
            data = self._link.preview()
        except LinkError as error:
            due = self._patience.next_try(error)
            if due is None:
                raise
            self._frames.remark(str(error))
            self._due = due
            return
        arrived, period = self._clock.now(), 1 / self._config.rate_hz
        self._patience.reset()
        if self._frames.put(data, arrived, took=arrived - begin):
            self._due = max(self._due + period, begin)
        else:
            self._due = arrived + (REPEAT_PAUSE_S if self._frames.waited_s < REPEAT_LIMIT_S else period)


def freshness(config: GphotoSettings) -> float:
    """Return for how long a frame counts as the newest [s]."""
    return max(FRESH_S, FRESH_FRAMES / config.rate_hz)


# The camera's thread

# A camera on USB that another program left in the middle of an exchange answers at the second attempt.
USB_TRIES = 2
# A lost camera is opened again after this pause, doubled each time, until `RECONNECT_S` after the loss [s].
FIRST_PAUSE_S, RECONNECT_S = 0.1, 5.0


class Shooting:
    """Open the camera and run its jobs; all methods are called from one thread."""

    def __init__(self, config: GphotoSettings, clock: Clock, link: GphotoLink, shared: SharedState) -> None:
        self._config, self._clock, self._link, self._shared = config, clock, link, shared
        self._lens = LensJob(config, clock, link, shared)
        self._still = StillJob(config, clock, link, shared)
        self._view = ViewJob(config, clock, link, shared.frames)
        self._connected = False
        self._lost_at = self._attempt = 0.0
        self._pause = FIRST_PAUSE_S

    def open(self) -> ZoomSetting:
        """Open the camera and check it against the configuration."""
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
            except Exception as error:  # the user gets one line; the traceback goes to the debug log
                log.debug("opening the zoom camera failed", exc_info=True)
                raise DeviceError(f"the camera at '{self._config.port}' cannot be used: {error!r}") from error
        raise AssertionError("the last attempt succeeds or fails")

    def close(self) -> None:
        """Leave shooting mode, if the camera still answers, and disconnect."""
        if self._connected:
            try:
                if SHOOTING in self._link.names():
                    self._link.put(SHOOTING, 0)
            except LinkError as error:
                log.debug("the camera may still be in shooting mode: %s", error)
        self._disconnect()

    def work(self) -> float:
        """Do one step of the most urgent job that is due; return when the next one is due [s]."""
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
            self._disconnect()  # takes 5 s if the camera is silent
            return self._attempt
        return min(job.due() for job in jobs)

    def _connect(self, first: bool) -> ZoomSetting:
        """Open the camera and begin its jobs; disconnect if anything fails."""
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
        """Try to open a lost camera again."""
        try:
            self._connect(first=False)
        except (LinkError, DeviceError) as error:
            if self._clock.now() >= self._lost_at + RECONNECT_S:
                self._give_up(error)
            else:
                self._wait(error)
        except ConfigError as error:  # another camera is at the port now
            self._give_up(error)
        else:
            log.info("the zoom camera at '%s' is back", self._config.port)

    def _wait(self, error: Exception) -> None:
        self._attempt, self._pause = self._clock.now() + self._pause, 2 * self._pause
        self._shared.frames.lose(error)

    def _give_up(self, error: CotargetError | LinkError) -> None:
        why = f"the zoom camera at '{self._config.port}' is gone: {error}"
        log.error("%s", why)
        self._shared.dismiss(why)


# The zoom camera

# Time limit for opening [s]: it takes 1 to 2 s, longer if the lens extends or the camera is busy.
OPEN_LIMIT_S = 30.0
# Time limit for a still, with focusing, flash and a slow line [s].
STILL_LIMIT_S = 30.0
# Time limit for disconnecting [s]. It takes two round trips, and libgphoto2 waits 2.5 s for each where the camera is
# silent; a program that ends for that reason must not hang.
CLOSE_LIMIT_S = 3.0


class GphotoCamera(BufferedCamera):
    """The zoom camera: lens, viewfinder and stills through libgphoto2, on a thread of its own.

    A frame's time is the arrival of its last byte, less ``latency_s``, which is measured in the same way at bring-up. A
    still's time is the middle of the call that takes it, without its transfer where the camera sends it separately; the
    error is at most half that call. Frames that took too long to arrive are dropped. While a still is taken no
    viewfinder frames come, and `read` waits.

    The lens position between commands is an estimate from ``lens_speed`` and ``command_delay_s``. A lost camera is
    opened again for up to `RECONNECT_S` and its lens sent back; after that every call raises.

    Args:
        config: port, model, settings, sizes and lens of the camera.
        clock: the rig's clock, in real time.
        link: to the camera, not open yet; None for libgphoto2.

    Raises:
        ConfigError: the camera differs from the configuration, or gphoto2 is not installed.
        DeviceError: the camera is not there, or does not answer.
    """

    Settings = GphotoSettings

    @staticmethod
    def probe(settings: GphotoSettings) -> str:
        """Detect the camera without opening it; describe it in one line. See `GphotoLink.look`."""
        return GphotoLink(settings.port, settings.model).look()

    def __init__(self, config: GphotoSettings, clock: Clock, link: GphotoLink | None = None) -> None:
        self._config, self._clock = config, clock
        self._name = f"the zoom camera at '{config.port}'"
        self._frames = FrameBuffer(self._name, clock, config.size, config.latency_s, freshness(config))
        self._shared = SharedState(self._frames)
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
    def still_size(self) -> tuple[int, int]:
        """(width, height) of full stills [px]."""
        return self._config.still_size

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest nominal focal length [px] of viewfinder frames."""
        return self._lens.focal_range

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving; return at once the nominal focal length [px] of the position that it will reach.

        Raises:
            DeviceError: the focal length is not positive and finite, or the camera is gone.
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
        """Return the lens state now: moving until it should have arrived and its setting reads the command.

        Raises:
            DeviceError: the lens did not reach its command, or the camera is gone.
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
            ConfigError: stills have another size than configured.
            DeviceError: the camera took no still, or is gone.
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
        """End the thread and release the camera; may be called again."""
        self._shared.dismiss(f"{self._name} is closed")
        self._thread.join(CLOSE_LIMIT_S)
        if self._thread.is_alive():
            log.warning("%s does not answer; it is left as it is", self._name)

    def _check(self) -> None:
        if self._shared.gone:
            raise DeviceError(self._shared.gone)

    def _run(self, work: Shooting, opened: "Future[ZoomSetting]") -> None:
        """Run the camera's thread."""
        try:
            opened.set_result(work.open())
        except Exception as error:
            opened.set_exception(error)
            return
        try:
            while not self._shared.gone:
                self._rest_until(work.work())
        except Exception as error:  # callers must learn that the thread has ended
            log.debug("the driver of the zoom camera failed", exc_info=True)
            self._shared.dismiss(f"the driver of {self._name} failed: {error!r} ({place_of(error)})")
        finally:
            with contextlib.suppress(Exception):
                work.close()

    def _rest_until(self, due: float) -> None:
        """Wait until a job is due, or a caller has a command."""
        shared = self._shared
        with shared.changed:
            shared.changed.wait_for(
                lambda: shared.called, min(max(due - self._clock.now(), 0.0), threading.TIMEOUT_MAX)
            )
            shared.called = False
