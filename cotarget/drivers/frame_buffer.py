"""The newest frame of a camera that is read on a thread of its own.

A consumer that reads a stream itself falls behind: unread frames wait in buffers and grow old. A camera's thread
therefore takes every frame and puts it into a `FrameBuffer`, which keeps the newest. Its frames may be JPEGs, or what
else the buffer's `decode` takes, and are decoded only when they are read, so that a slow consumer decodes only the
frames that it uses.

A camera driver opens its stream, calls `opened`, and then `put` for each frame. `keep_open` does this again whenever
the stream ends. Callers get errors from `read`.
"""

import logging
import threading
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cotarget.drivers.mjpeg import DamagedError, StreamDecoder
from cotarget.errors import DeviceError, StaleFrameError
from cotarget.plugins import place_of
from cotarget.rig import Clock, Frame, Image

log = logging.getLogger(__name__)

# Pauses before a stream is opened again: shortest, after a stream that worked; longest; after a refusal, because
# repeated logins may lock the user out [s].
SHORTEST_PAUSE_S, LONGEST_PAUSE_S, REFUSED_PAUSE_S = 0.05, 0.4, 2.0
# Error messages name a camera's silence as the cause from this time without anything received on [s].
QUIET_S = 0.2
# Time limit for the thread to end [s]; only a connection being made, or a slow device, delays it.
JOIN_S = 10.0


class BusyError(DeviceError):
    """The camera has no capacity at the moment; try again later."""


class StreamRefusedError(DeviceError):
    """The camera refuses this stream."""


class LoginError(StreamRefusedError):
    """The camera refuses the user or the password."""


@dataclass(frozen=True)
class FrameCounts:
    """Frame counts of a camera."""

    frames: int = 0  # new frames
    skipped: int = 0  # new frames that were not read before the next one came
    repeated: int = 0  # frames equal to the one before
    refused: int = 0  # damaged, cut short or late frames; damage inside of a JPEG is only seen when it is read
    reconnects: int = 0  # number of times that the stream was opened again


@dataclass(eq=False)
class _Newest:
    """The newest frame: as it came, and decoded once it has been read."""

    data: Any
    t: float
    arrived: float
    before: float  # arrival of the frame before [s]
    number: int
    image: Image | None = None
    read: bool = False


class FrameBuffer:
    """Hand the newest frame from a camera's thread to its callers, with what went wrong.

    Args:
        name: the camera's name in messages, such as "the fixed camera".
        clock: the rig's clock.
        size: expected (width, height) of the frames [px].
        latency_s: from the exposure of a frame to its arrival [s].
        fresh_s: for how long a frame counts as the newest after its arrival [s]; one that took longer to arrive is
            refused.

    Attributes:
        decode: makes the image of what `put` takes in place of an image, by default of a JPEG; raises DamagedError.
    """

    def __init__(self, name: str, clock: Clock, size: tuple[int, int], latency_s: float, fresh_s: float) -> None:
        self.name, self._clock, self.size = name, clock, size
        self.latency_s, self._fresh_s = latency_s, fresh_s
        self.decode: Callable[[Any], Image] = StreamDecoder().decode
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._decoding = threading.Lock()
        # Guards everything below, which is shared with the camera's thread.
        self._changed = threading.Condition()
        self._counts = FrameCounts()
        self._came = 0  # frames that came, refused ones too
        self._newest: _Newest | None = None
        self._last: Hashable = None  # what tells the newest frame from a repeated one, even if it cannot be decoded
        self._new_at = self._heard_at = clock.now()  # arrival of the newest frame, and of anything
        self._frozen = False  # whether the newest frame was repeated
        self._refused = ""  # why frames were refused since the newest one
        self._remark = ""  # what else the camera's driver knows of frames that do not come
        self._lost = ""  # why there is no stream; empty while one is open
        self._was_open = False
        self._hopeless: DeviceError | None = None  # why the stream could not be opened at first
        self._gone = ""  # why no frame will come any more

    # Calls of the camera's thread

    def start(self, work: Callable[[], None], name: str) -> None:
        """Run ``work`` on a thread of this name; an error that it does not catch ends every `read`."""

        def run() -> None:
            try:
                work()
            except Exception as error:  # readers must learn that the thread has ended
                log.debug("the driver of %s failed", self.name, exc_info=True)
                self.fail(f"the driver of {self.name} failed: {error!r} ({place_of(error)})")

        self._thread = threading.Thread(target=run, name=name, daemon=True)
        self._thread.start()

    def keep_open(self, stream: Callable[[], None], after: Callable[[], None] = lambda: None) -> None:
        """Call ``stream``, which opens the camera and puts its frames, again whenever it ends, until `close`.

        Pauses grow while no frame comes. An error before the camera was ever open ends `first`, unless it is a
        BusyError.

        Args:
            stream: returns or raises DeviceError at the end of the stream.
            after: called after each end of the stream.
        """
        pause = 0.0
        while not self._closing.wait(pause):
            frames = self.counts.frames
            error = DeviceError(f"{self.name} has closed the stream")
            try:
                stream()
            except DeviceError as raised:
                error = raised
            worked = self.counts.frames > frames
            self.lose(error)
            if not self.closing:
                after()
            pause = SHORTEST_PAUSE_S if worked else min(max(2 * pause, SHORTEST_PAUSE_S), LONGEST_PAUSE_S)
            if isinstance(error, StreamRefusedError):
                pause = REFUSED_PAUSE_S

    def opened(self) -> None:
        """Record that the stream is open."""
        with self._changed:
            again = 1 if self._was_open else 0
            self._counts = replace(self._counts, reconnects=self._counts.reconnects + again)
            self._heard_at, self._lost, self._was_open = self._clock.now(), "", True

    def heard(self) -> None:
        """Record that something was received, though no frame is complete."""
        with self._changed:
            self._heard_at = self._clock.now()

    def put(
        self, data: Any, arrived: float, took: float = 0.0, *, t: float | None = None, serial: Hashable = None
    ) -> bool:
        """Publish a frame, unless its serial, its own time or else its JPEG is that of the last one.

        Equal images without these are new: a video codec repeats the picture of a quiet scene to the last bit.

        Args:
            data: the image, (H, W, 3) BGR, or what `decode` takes, such as its JPEG; not changed any more.
            arrived: time of arrival [s]; the frame's time is this less the latency, where it has no ``t``.
            took: how long the frame took to arrive [s].
            t: middle of the exposure by the stream's own clock, mapped to the rig's [s].
            serial: what identifies the frame, such as its number or the stream's own time stamp.

        Returns:
            Whether the frame is a new one, and not the last one repeated.
        """
        with self._changed:
            self._heard_at = max(self._heard_at, arrived)
            own = t if serial is None else serial
            own = data if own is None and not isinstance(data, np.ndarray) else own
            if own is not None and own == self._last:
                self._counts = replace(self._counts, repeated=self._counts.repeated + 1)
                self._frozen = True
                return False
            self._last = own
            self._came += 1
            if took > self._fresh_s:
                self._refuse(f"its frames take {took:.2g} s to come", 1)
                return True
            skipped = 1 if self._newest is not None and not self._newest.read else 0
            counts = self._counts
            self._counts = replace(counts, frames=counts.frames + 1, skipped=counts.skipped + skipped)
            self._newest = _Newest(
                data, arrived - self.latency_s if t is None else t, arrived, self._new_at, self._came
            )
            self._new_at = arrived
            self._frozen, self._refused, self._remark, self._lost = False, "", "", ""
            self._changed.notify_all()
            return True

    def refuse(self, count: int = 1) -> None:
        """Count frames that were cut short."""
        if count:
            with self._changed:
                self._came += count
                self._refuse(self._broken, count)

    def remark(self, text: str) -> None:
        """Add to the reason why no frame comes, until the next one."""
        with self._changed:
            self._remark = text

    def lose(self, error: Exception) -> None:
        """Record that the stream has ended and will be opened again."""
        with self._changed:
            self._lost = str(error)
            if isinstance(error, DeviceError) and not (self._was_open or isinstance(error, BusyError)):
                self._hopeless = error
            self._changed.notify_all()

    def fail(self, why: str) -> None:
        """Record that no frame will come any more; the first reason counts."""
        with self._changed:
            self._gone = self._gone or why
            self._changed.notify_all()

    # Calls of any thread

    @property
    def counts(self) -> FrameCounts:
        """Frame counts so far."""
        with self._changed:
            return self._counts

    @property
    def gone(self) -> str:
        """Why no frame will come any more; empty while frames may come."""
        return self._gone

    @property
    def closing(self) -> bool:
        """Whether `close` was called."""
        return self._closing.is_set()

    @property
    def frozen_s(self) -> float:
        """Time for which the same frame has been repeated [s]."""
        with self._changed:
            return self._heard_at - self._new_at if self._frozen else 0.0

    @property
    def waited_s(self) -> float:
        """Time since the newest frame [s]."""
        with self._changed:
            return self._clock.now() - self._new_at

    def first(self, timeout: float) -> tuple[int, int]:
        """Wait for the first frame; return its (width, height) [px], which may differ from the expected one.

        Raises:
            DeviceError: the stream could not be opened, or brought no whole frame within ``timeout`` [s].
        """
        deadline = self._clock.now() + timeout
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._newest is not None or self._gone or self._hopeless,
                    max(deadline - self._clock.now(), 0.0),
                )
                if self._gone:
                    raise DeviceError(self._gone)
                if self._hopeless is not None:
                    raise self._hopeless
                newest = self._newest
                if newest is None:
                    none = f"{self.name} has sent no whole picture in {timeout:g} s"
                    raise DeviceError(self._lost or self._remark or self._refused or none)
            if (image := self._decode(newest)) is not None:
                return image.shape[1], image.shape[0]

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame; with ``newer_than`` [s] for one exposed after that time.

        Raises:
            StaleFrameError: no such frame arrived within ``timeout`` [s]; the message says why.
            DeviceError: the frames' size has changed, or no frame will come any more.
        """
        begin = self._clock.now()
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._gone or self._ready(newer_than, begin),
                    max(begin + timeout - self._clock.now(), 0.0),
                )
                if self._gone:
                    raise DeviceError(self._gone)
                newest = self._newest
                if newest is None or not self._ready(newer_than, begin):
                    raise StaleFrameError(self._why(timeout))
                newest.read = True
            image = self._decode(newest)
            if image is None:
                continue
            if (size := (image.shape[1], image.shape[0])) != self.size:
                now, was = (f"{width}x{height}" for width, height in (size, self.size))
                raise DeviceError(
                    f"{self.name} now sends {now} where it sent {was}: set its resolution back, or open it again"
                )
            return Frame(image, newest.t, number=newest.number)

    def close(self) -> None:
        """End every `read` and `keep_open`; called before the driver breaks off its connection."""
        self._closing.set()
        self.fail(f"{self.name} is closed")

    def join(self) -> bool:
        """Wait for the thread to end; return whether it has."""
        if self._thread is None:
            return True
        self._thread.join(JOIN_S)
        return not self._thread.is_alive()

    @property
    def _broken(self) -> str:
        return f"the pictures of {self.name} are broken"

    def _ready(self, newer_than: float | None, begin: float) -> bool:
        """Return whether there is a frame for a `read` that began at ``begin`` [s]; an old frame does not count."""
        newest = self._newest
        return (
            newest is not None
            and begin - newest.arrived <= self._fresh_s
            and (newer_than is None or newest.t > newer_than)
        )

    def _decode(self, newest: _Newest) -> Image | None:
        """Decode a frame once, read-only; None if it is damaged, which is counted."""
        with self._decoding:
            if newest.image is None:
                try:
                    newest.image = newest.data if isinstance(newest.data, np.ndarray) else self.decode(newest.data)
                except DamagedError as error:
                    log.debug("%s: %s", self.name, error)
                    with self._changed:
                        if self._newest is newest:
                            self._newest, self._new_at = None, newest.before
                        self._refuse(self._broken, 1)
            return newest.image

    def _refuse(self, why: str, count: int) -> None:
        self._refused = why
        self._counts = replace(self._counts, refused=self._counts.refused + count)

    def _why(self, timeout: float) -> str:
        """Explain why there is no newer frame."""
        now = self._clock.now()
        if self._lost:
            reason = f"{self._lost}; reconnecting"
        elif now - self._heard_at > QUIET_S:
            reason = f"{self.name} has sent nothing for {now - self._heard_at:.1f} s"
        elif self._refused:
            reason = f"{self._refused}, {self._counts.refused} so far"
        elif self._frozen:
            reason = f"{self.name} repeats the same picture"
        elif self._remark:
            return f"no new picture for {now - self._new_at:.1f} s: {self._remark}"
        else:
            return f"{self.name} sent no newer picture within {timeout:g} s"
        remark = f"; {self._remark}" if self._remark else ""
        return f"no new picture for {now - self._new_at:.1f} s: {reason}{remark}"


class BufferedCamera:
    """The calls of a camera that its `FrameBuffer` answers."""

    _frames: FrameBuffer

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the frames [px]."""
        return self._frames.size

    @property
    def counts(self) -> FrameCounts:
        """Frame counts so far."""
        return self._frames.counts

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for a frame, see `FrameBuffer.read`."""
        return self._frames.read(newer_than, timeout)
