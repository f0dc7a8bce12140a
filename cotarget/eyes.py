"""Looking through both cameras: what can be acted on, and what is wrong with it, in words.

The wide camera sets the pace, and without it nothing can be done. The zoom camera may be blind for a moment, because
its lens moves, its line is slow or it is lost and found again: the wide view is followed all the same.
"""

import math

import numpy as np

from cotarget.errors import DeviceError, StaleFrameError
from cotarget.rig import Camera, Clock, Frame, Image
from cotarget.safety.devices import FUTURE_S

# Longer than this nobody waits for a zoom frame that is not there yet, but for the first [s].
ZOOM_WAIT_S = 2e-3
# Frames of the wide camera that repeat, or whose times jump, may do so for that long [s]. Nobody steers by them, and
# a head that moves is halted meanwhile, by the watchdog; so often they are asked for anew [s].
REPEATED_S, AGAIN_S = 0.5, 5e-3
# So long a camera waits for a frame by itself [s]; if none has come by then, none will.
PATIENCE_S = 1.0
# A zoom camera that gives the same frame for so long shows nothing new [s] ...
BLIND_S = 0.5
# ... and after so long it is gone [s]: longer than a driver that has lost its camera looks for it, which is 5 s.
GONE_S = 10.0
# Pictures of a live camera differ by their noise; one that stays the same to the last bit for so long is old [s].
FROZEN_S = 1.0
ROWS = 16  # every so many rows of a picture are compared first; where one differs, it is another picture


class Eyes:
    """The newest frames of both cameras.

    Args:
        fixed: the wide camera.
        zoom: the zoom camera.
        clock: the rig's.

    Attributes:
        interval: from the wide frame before to the newest [s]; inf for the first.
        close_is_new: whether the newest zoom frame shows what was not seen before: another time, and another picture,
            but where the wide view has not changed either since that picture came first.
    """

    def __init__(self, fixed: Camera, zoom: Camera, clock: Clock) -> None:
        self._fixed, self._zoom, self._clock = fixed, zoom, clock
        self._wide: Frame | None = None
        self._close: Frame | None = None
        # By the times of wide frames:
        self._now = self._picture_t = self._close_t = self._shown_t = -math.inf
        self._why_blind = self._why_late = ""
        self._looked_t = -math.inf  # by the rig's clock
        self.interval, self.close_is_new = math.inf, False

    def look_wide(self) -> Frame:
        """Wait for the next wide frame; those that repeat or cannot be true are passed over for a while.

        Raises:
            StaleFrameError: there is none, or for too long none that is newer, and not from later than now.
            DeviceError: it is of another size.
        """
        self._why_late, until, timeout = "", math.inf, PATIENCE_S
        while True:
            try:
                return self._next_wide(timeout, until)
            except StaleFrameError as error:
                now = self._clock.now()
                if not self._why_late:
                    until = now + REPEATED_S
                if self._wide is None or now - self._looked_t >= PATIENCE_S or not now < until:
                    raise
                self._why_late = str(error)
                self._clock.sleep_until(now + AGAIN_S)
                timeout = until - now

    def _next_wide(self, timeout: float, until: float) -> Frame:
        """The next wide frame, by a time. Raises as `look_wide` does, but at once."""
        before = self._wide
        frame = self._fixed.read(None if before is None else before.t, timeout)
        _check_size(frame, self._fixed, "fixed")
        if not frame.t > self._now:
            after = "" if before is None else f" after one of {before.t:.3f} s"
            raise StaleFrameError(
                f"the fixed camera gave a frame of {frame.t:.3f} s{after}: its frames repeat, or its clock has jumped"
            )
        now = self._clock.now()
        if (ahead := frame.t - now) > FUTURE_S:
            raise StaleFrameError(f"the fixed camera's frame is from {ahead:.2f} s in the future; mind the clock")
        if now > until:  # its times have jumped back, and have now come up with the last one
            raise StaleFrameError(self._why_late)
        if before is None or not _same(frame.image, before.image):
            self._picture_t = frame.t
        self.interval = frame.t - self._now
        self._wide, self._now, self._looked_t = frame, frame.t, now
        return frame

    def look_close(self) -> Frame:
        """The newest zoom frame, which may be an old one; the first is waited for.

        Raises:
            StaleFrameError: there has been none at all, or no new one for so long that there will be none.
            DeviceError: it is of another size.
        """
        before, self._why_blind = self._close, ""
        try:
            frame = self._zoom.read() if before is None else self._zoom.read(timeout=ZOOM_WAIT_S)
        except StaleFrameError as error:
            if before is None:
                raise
            frame, self._why_blind = before, str(error)
        is_later = before is None or frame.t > before.t
        if is_later:
            _check_size(frame, self._zoom, "zoom")
            self._close, self._close_t = frame, self._now
            if before is None or not _same(frame.image, before.image):
                self._shown_t = self._now
        self.close_is_new = is_later and not self._picture_t > self._shown_t
        if before is None or is_later:
            return frame
        if self._now - self._close_t > GONE_S:
            raise StaleFrameError(self._blindness())
        return before

    def troubles(self) -> list[str]:
        """What is wrong with the newest frames."""
        found = []
        if self._why_late:
            found.append(f"{self._why_late}; this one is {self.interval:.2f} s after the last")
        if (same := self._now - self._picture_t) > FROZEN_S:
            found.append(f"the fixed camera has shown the same picture for {same:.1f} s")
        if self._why_blind or self._now - self._close_t > BLIND_S:
            found.append(self._blindness())
        elif (same := self._picture_t - self._shown_t) > FROZEN_S:
            found.append(f"the zoom camera has shown the same picture for {same:.1f} s")
        return found

    def _blindness(self) -> str:
        """For how long the zoom camera has shown nothing new, and why, where it says so."""
        why = self._why_blind and f": {self._why_blind}"
        return f"the zoom camera has shown nothing new for {self._now - self._close_t:.1f} s{why}"


def _check_size(frame: Frame, camera: Camera, name: str) -> None:
    """Refuse a frame of another size: the calibration would put everything in it elsewhere.

    Raises:
        DeviceError: it is.
    """
    height, width = frame.image.shape[:2]
    if (width, height) != camera.size:
        was_width, was_height = camera.size
        raise DeviceError(
            f"the {name} camera gave a frame of {width}x{height}, and not of {was_width}x{was_height}: set it back, or "
            "open the rig anew"
        )


def _same(a: Image, b: Image) -> bool:
    """Whether two pictures of a camera are the same to the last bit."""
    return a is b or (np.array_equal(a[::ROWS], b[::ROWS]) and np.array_equal(a, b))
