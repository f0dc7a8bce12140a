"""The wide camera on an Axis video server: a thread that drains its stream and keeps the newest picture.

A consumer that read the stream itself would fall behind it: what it has not read yet waits in buffers, and grows old.
"""

import contextlib
import logging
import threading
from dataclasses import dataclass, replace

from cotarget.errors import ConfigError, DeviceError, StaleFrameError
from cotarget.hardware.jpeg import JpegDecoder
from cotarget.hardware.multipart import MultipartReader, Picture
from cotarget.hardware.vapix import BusyError, RefusedError, Stream, VideoServer
from cotarget.hwconfig import HardwareFixed
from cotarget.rig import Clock, Frame, Image

log = logging.getLogger(__name__)

# How long the first picture may take; a server that is busy is asked again until then [s].
OPEN_S = 5.0
# Before the stream is opened again: after it worked, and at most; after a refusal, which might lock the user out [s].
SHORTEST_PAUSE_S, LONGEST_PAUSE_S, REFUSED_PAUSE_S = 0.05, 0.4, 2.0
# Pictures of a live camera differ by their noise; a stream that repeats one for so long is frozen [s].
FROZEN_S = 1.0
# A stream that has been silent for so long is said to have stalled, should somebody ask for a picture [s].
QUIET_S = 0.2
# A stream that brings bytes, but no whole picture for so many times the silence of a stalled one, is opened anew.
FRUITLESS_SILENCES = 2.0
# The thread ends at once, but for a connection that is just being made, or a server that is slow to answer [s].
JOIN_S = 10.0


@dataclass(frozen=True)
class Counters:
    """What came of a stream.

    Attributes:
        frames: new whole pictures.
        repeated: pictures that were the same, byte for byte, as the one before.
        broken: pictures that were cut short or could not be decoded; of those that nobody read the latter is not known.
        reconnects: how often the stream was opened again.
    """

    frames: int = 0
    repeated: int = 0
    broken: int = 0
    reconnects: int = 0


class AxisCamera:
    """A camera of an Axis video server; close it after use.

    A frame's time is that of its first byte's arrival, less the latency of the config. A picture is decoded when it is
    read: a consumer that is slower than the stream saves the time of the others, and none holds up the stream.

    Args:
        config: where it is, and what is expected of it.
        clock: the rig's.

    Raises:
        ConfigError: the config does not say where it is, or expects another size.
        DeviceError: the server cannot be reached, refuses us, or has no pictures.
    """

    def __init__(self, config: HardwareFixed, clock: Clock) -> None:
        self._config, self._clock = config, clock
        self._server = VideoServer(config)
        self._api = ""
        self._closing = threading.Event()
        self._decoder, self._decoding = JpegDecoder(), threading.Lock()
        self._decoded: tuple[Picture, Image] | None = None
        # All that follows is shared with the thread, and guarded by this.
        self._new = threading.Condition()
        self._counters = Counters()
        self._picture: Picture | None = None  # the newest
        self._last = b""  # its bytes, kept where it could not be decoded too
        self._fresh = self._heard = clock.now()  # when the newest came, and the last byte
        self._spoilt = self._frozen = False  # what came since the newest: broken ones, or the same
        self._trouble = ""  # why there is no stream; empty while there is one
        self._refused: DeviceError | None = None  # why there never was one
        self._failed = ""  # why there will be none any more
        self._asked = False  # whether the server was asked why there are no new ones
        self._video: bool | None = None  # what it said: whether the input has a signal
        self._thread = threading.Thread(target=self._run, name="axis", daemon=True)
        try:
            self._api = self._server.check()
            self._thread.start()
            self._await_first()
        except BaseException:
            self.close()
            raise

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self._config.size

    @property
    def counters(self) -> Counters:
        """What came of the stream so far."""
        with self._new:
            return self._counters

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for the newest frame; with ``newer_than`` [s] for one exposed after that time.

        Raises:
            StaleFrameError: no such frame arrived within ``timeout`` [s], and why.
            DeviceError: the pictures have another size than at the start, the camera is closed, or its driver failed.
        """
        deadline = self._clock.now() + timeout
        # What came before a stall is no answer to somebody who wants to see what is.
        oldest = deadline - timeout - self._config.latency_s - self._server.silence_s
        after = oldest if newer_than is None else max(oldest, newer_than)
        while True:
            with self._new:
                self._new.wait_for(lambda: self._ready(after), max(deadline - self._clock.now(), 0.0))
                if self._closing.is_set():
                    raise DeviceError("the fixed camera is closed")
                if self._failed:
                    raise DeviceError(self._failed)
                picture = self._picture
                if picture is not None and picture.size != self.size:
                    raise DeviceError(self._other_size(picture.size))
                if picture is None or not self._ready(after):
                    raise StaleFrameError(self._why(timeout))
            image = self._decode(picture)
            if image is not None:
                return Frame(image, self._time(picture))

    def close(self) -> None:
        """End the stream and the thread; once more does no harm."""
        self._closing.set()
        self._server.end()
        with self._new:
            self._new.notify_all()
        if self._thread.is_alive():
            self._thread.join(JOIN_S)
        if not self._thread.is_alive():
            self._server.close()

    def _await_first(self) -> None:
        with self._new:
            self._new.wait_for(lambda: self._picture is not None or self._refused is not None, OPEN_S)
            if self._refused is not None:
                raise self._refused
            if self._picture is None:
                raise DeviceError(self._trouble or f"{self._server.name} has sent no whole picture in {OPEN_S:g} s")
            width, height = self._picture.size
        if (width, height) != self.size:
            raise ConfigError(
                f"hardware.fixed.size: {list(self.size)} is not what {self._server.name} sends: write size = "
                f"[{width}, {height}], or ask for another hardware.fixed.resolution than '{self._config.resolution}'"
            )

    def _time(self, picture: Picture) -> float:
        return picture.t - self._config.latency_s

    def _ready(self, after: float) -> bool:
        """Whether there is something to tell: a picture from after then, one of another size, or the end."""
        picture = self._picture
        told = picture is not None and (self._time(picture) > after or picture.size != self.size)
        return told or bool(self._failed) or self._closing.is_set()

    def _decode(self, picture: Picture) -> Image | None:
        """The picture's image, read-only; None, and counted, if it has none."""
        with self._decoding:
            if self._decoded is not None and self._decoded[0] is picture:
                return self._decoded[1]
            image = self._decoder.decode(picture.jpeg)
            if image is not None:
                self._decoded = (picture, image)
                return image
        with self._new:
            if self._picture is picture:
                self._picture, self._spoilt = None, True
            self._counters = replace(self._counters, broken=self._counters.broken + 1)
        return None

    def _other_size(self, size: tuple[int, int]) -> str:
        was, now = (f"{width}x{height}" for width, height in (self.size, size))
        return f"{self._server.name} now sends {now} where it sent {was}: set its resolution back, or open it anew"

    def _why(self, timeout: float) -> str:
        """Why there is no newer picture."""
        now, name = self._clock.now(), self._server.name
        if self._trouble:
            reason = f"{self._trouble}; reconnecting"
        elif now - self._heard > QUIET_S:
            reason = f"{name} has sent nothing for {now - self._heard:.1f} s"
        elif self._frozen:
            reason = f"{name} repeats the same picture"
        elif self._spoilt:
            return f"the pictures of {name} are broken, {self._counters.broken} so far"
        else:
            return f"{name} sent no newer picture within {timeout:g} s"
        video = f"; its input {self._config.camera} has no video" if self._video is False else ""
        return f"no new picture for {now - self._fresh:.1f} s: {reason}{video}"

    def _run(self) -> None:
        """What the thread does."""
        try:
            self._keep_open()
        except Exception as error:  # a thread must not die in silence
            log.debug("the driver of the fixed camera failed", exc_info=True)
            with self._new:
                self._failed = f"the driver of the fixed camera failed: {error!r}"
                self._refused = DeviceError(self._failed)
                self._new.notify_all()

    def _keep_open(self) -> None:
        """Keep a stream open until the end."""
        pause = 0.0
        while not self._closing.wait(pause):
            frames = self._counters.frames
            error, opened = self._stream()
            with self._new:
                self._trouble = str(error)
                worked, lost = self._counters.frames > frames, self._clock.now() - self._fresh > FROZEN_S
                ask = opened and lost and not self._asked
                if not (worked or opened or self._counters.frames or isinstance(error, BusyError)):
                    self._refused = error
                self._new.notify_all()
            pause = SHORTEST_PAUSE_S if worked else min(max(2 * pause, SHORTEST_PAUSE_S), LONGEST_PAUSE_S)
            if isinstance(error, RefusedError):
                pause = REFUSED_PAUSE_S
            if ask and not self._closing.is_set():
                self._ask_for_video()

    def _stream(self) -> tuple[DeviceError, bool]:
        """Open the stream and take its pictures until it ends; why it did, and whether it was open."""
        opened = False
        try:
            with self._server.stream(self._api) as stream:
                opened = True
                self._drain(stream)
        except DeviceError as error:
            return error, opened
        return DeviceError(f"{self._server.name} has closed the stream"), opened

    def _drain(self, stream: Stream) -> None:
        reader, broken = MultipartReader(stream.boundary), 0
        fruitful = self._clock.now()
        with self._new:
            again = 1 if self._trouble else 0
            self._counters = replace(self._counters, reconnects=self._counters.reconnects + again)
            self._heard, self._trouble = fruitful, ""
        try:
            for piece in stream.pieces:
                now = self._clock.now()
                pictures = reader.feed(piece, now)
                frozen = self._take(pictures, reader.broken - broken, now)
                broken = reader.broken
                fruitful = now if pictures else fruitful
                if now - fruitful > FRUITLESS_SILENCES * self._server.silence_s:
                    raise DeviceError(f"{self._server.name} sends no whole pictures")
                if frozen and not self._asked:
                    # Asked while this stream is not drained, the time of the next picture would be wrong.
                    raise DeviceError(f"{self._server.name} repeats the same picture")
        finally:
            self._take([], reader.broken - broken + reader.unfinished, None)

    def _take(self, pictures: list[Picture], broken: int, now: float | None) -> bool:
        """Note what came; whether the pictures have been the same for too long."""
        with self._new:
            self._heard = self._heard if now is None else now
            counters = replace(self._counters, broken=self._counters.broken + broken)
            self._spoilt = self._spoilt or broken > 0
            for picture in pictures:
                if picture.jpeg == self._last:
                    counters = replace(counters, repeated=counters.repeated + 1)
                    self._frozen = True
                    continue
                counters = replace(counters, frames=counters.frames + 1)
                self._picture, self._last, self._fresh = picture, picture.jpeg, picture.t
                self._frozen = self._spoilt = self._asked = False
                self._video = None
                self._new.notify_all()
            self._counters = counters
            return self._frozen and now is not None and now - self._fresh > FROZEN_S

    def _ask_for_video(self) -> None:
        video = None
        with contextlib.suppress(DeviceError):  # it is just one more thing that fails
            video = self._server.has_video()
        with self._new:
            self._asked, self._video = True, video


def probe(config: HardwareFixed) -> str:
    """Say in a line who the video server is, by harmless questions.

    Raises:
        ConfigError: the config does not say where it is.
        DeviceError: it cannot be reached, or tells nothing.
    """
    with contextlib.closing(VideoServer(config)) as server:
        return server.describe()
