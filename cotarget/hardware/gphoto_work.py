"""One thread's work with a gphoto2 camera: it opens it, does what is most urgent, and finds it again when it was lost.

libgphoto2 is not safe for several threads. The lens comes first and its latest command wins; then stills; and while
there is nothing else to do, frames of the viewfinder.
"""

import logging
import math

from cotarget.errors import ConfigError, CotargetError, DeviceError
from cotarget.hardware.gphoto import LOST, CameraLink, LinkError
from cotarget.hardware.gphoto_desk import Desk
from cotarget.hardware.gphoto_duties import LensDuty, StillDuty, ViewDuty
from cotarget.hardware.gphoto_setup import SHOOTING, ZoomSetting, set_up
from cotarget.hwconfig import HardwareZoom
from cotarget.rig import Clock

log = logging.getLogger(__name__)

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
        desk: where commands come from and results go.
    """

    def __init__(self, config: HardwareZoom, clock: Clock, link: CameraLink, desk: Desk) -> None:
        self._config, self._clock, self._link, self._desk = config, clock, link, desk
        self._lens = LensDuty(config, clock, link, desk)
        self._still = StillDuty(config, clock, link, desk)
        self._view = ViewDuty(config, clock, link, desk)
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
        if self._desk.gone:
            return math.inf
        if not self._connected:
            if now >= self._attempt:
                self._look_again()
            return now if self._connected else self._attempt
        duties = (self._lens, self._still, self._view)
        try:
            due = next((duty for duty in duties if duty.due() <= now), None)
            if due is not None:
                due.run()
        except LinkError as error:
            log.warning("the zoom camera at '%s' is lost: %s", self._config.port, error)
            self._lost_at, self._pause = self._clock.now(), FIRST_PAUSE_S
            self._wait(error)
            self._disconnect()  # takes 5 s where the camera is silent
            return self._attempt
        return min(duty.due() for duty in duties)

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
        with self._desk.changed:
            self._desk.trouble = f"looking for the camera again, {error}"

    def _give_up(self, error: CotargetError | LinkError) -> None:
        why = f"the zoom camera at '{self._config.port}' is gone: {error}"
        log.error("%s", why)
        self._desk.dismiss(why)
