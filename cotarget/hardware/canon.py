"""A zoom camera by gphoto2, such as Canon's PowerShots that can be shot from a computer."""

import contextlib
import logging
import math
import threading
from concurrent.futures import Future

from cotarget.errors import DeviceError, StaleFrameError
from cotarget.hardware.gphoto import CameraLink, GphotoLink
from cotarget.hardware.gphoto_desk import Desk
from cotarget.hardware.gphoto_duties import freshness
from cotarget.hardware.gphoto_setup import ZoomSetting
from cotarget.hardware.gphoto_work import Shooting
from cotarget.hwconfig import HardwareZoom
from cotarget.rig import Clock, Frame, ZoomState

log = logging.getLogger(__name__)

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
        self._desk = Desk()
        self._still_turn = threading.Lock()
        link = GphotoLink(config.port, config.model) if link is None else link
        opened: Future[ZoomSetting] = Future()
        work = Shooting(config, clock, link, self._desk)
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
        with self._desk.changed:
            return self._desk.dropped

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame; with ``newer_than`` [s] for one exposed after that time.

        Raises:
            StaleFrameError: no such frame arrived within ``timeout`` [s].
            DeviceError: the camera is gone.
        """
        desk = self._desk
        fresh = freshness(self._config)

        def there() -> bool:
            if desk.gone:
                return True
            new = desk.frame is not None and (newer_than is None or desk.frame.t > newer_than)
            return new and self._clock.now() - desk.arrived <= fresh

        with desk.changed:
            came = desk.changed.wait_for(there, timeout)
            self._check()
            if came and desk.frame is not None:
                return desk.frame
            which = "frame" if newer_than is None else f"frame newer than {newer_than:.3f} s"
            raise StaleFrameError(
                f"no {which} from the zoom camera within {timeout:g} s{desk.trouble and f': {desk.trouble}'}"
            )

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving; return at once the nominal focal length [px] of the position that it will reach.

        Raises:
            DeviceError: it is no focal length, or the camera is gone.
        """
        if not focal_px > 0 or math.isinf(focal_px):
            raise DeviceError(f"the lens cannot go to a focal length of {focal_px} px")
        position, desk = self._lens.position_for(focal_px), self._desk
        with desk.changed:
            self._check()
            if position != desk.wanted or desk.lens_trouble:
                desk.wanted, desk.order = position, desk.order + 1
                desk.standing, desk.lens_trouble, desk.called = False, "", True
                desk.changed.notify_all()
        return self._lens.focal_at(position)

    def state(self) -> ZoomState:
        """The lens's state now: moving until it should have arrived, and its setting was read back.

        Raises:
            DeviceError: the lens did not go where it was sent, or the camera is gone.
        """
        desk = self._desk
        with desk.changed:
            self._check()
            if desk.lens_trouble:
                raise DeviceError(desk.lens_trouble)
            assert desk.motion is not None, "an open camera knows its lens"
            now = self._clock.now()
            moving = not desk.standing or now < desk.motion.arrives
            return ZoomState(self._lens.focal_at(desk.motion.position(now)), moving, now)

    def capture(self) -> Frame:
        """Take a full still.

        Raises:
            ConfigError: stills are of another size than configured.
            DeviceError: the camera took none.
        """
        desk = self._desk
        with self._still_turn:
            future: Future[Frame] = Future()
            with desk.changed:
                self._check()
                desk.still, desk.called = future, True
                desk.changed.notify_all()
            try:
                return future.result(STILL_LIMIT_S)
            except TimeoutError:
                raise DeviceError(f"the zoom camera took no still within {STILL_LIMIT_S:g} s") from None
            finally:
                with desk.changed:
                    if desk.still is future:
                        desk.still = None

    def close(self) -> None:
        """Let the camera go; harmless when that was done before."""
        self._desk.dismiss("the zoom camera is closed")
        self._thread.join(CLOSE_LIMIT_S)
        if self._thread.is_alive():
            log.warning("the zoom camera at '%s' does not answer; it is left as it is", self._config.port)

    def _check(self) -> None:
        if self._desk.gone:
            raise DeviceError(self._desk.gone)

    def _run(self, work: Shooting, opened: "Future[ZoomSetting]") -> None:
        """The camera's thread."""
        try:
            opened.set_result(work.open())
        except Exception as error:
            opened.set_exception(error)
            return
        try:
            while not self._desk.gone:
                self._rest_until(work.work())
        except Exception as error:  # a thread must not die in silence
            log.debug("the driver of the zoom camera failed", exc_info=True)
            self._desk.dismiss(f"the driver of the zoom camera failed: {error!r}")
        finally:
            with contextlib.suppress(Exception):
                work.close()

    def _rest_until(self, due: float) -> None:
        """Wait until something is due, or somebody wants something."""
        desk = self._desk
        with desk.changed:
            desk.changed.wait_for(lambda: desk.called, min(max(due - self._clock.now(), 0.0), threading.TIMEOUT_MAX))
            desk.called = False
