"""Read films that PyAV can decode, and write H.264 yuv420p films that any player and browser opens."""

import contextlib
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import cv2
import numpy as np

from cotarget.errors import CotargetError
from cotarget.files import PartFile
from cotarget.rig import Frame, Image

log = logging.getLogger(__name__)


def reason_of(error: Exception) -> str:
    """Return the first line of an error, without the path that FFmpeg appends."""
    return (getattr(error, "strerror", None) or str(error) or type(error).__name__).splitlines()[0]


FALLBACK_RATE_HZ = 25.0  # frame rate of a film that does not state its own [Hz]
# Containers whose header holds the duration; for others FFmpeg estimates it from the content or the bit rate.
TELL_DURATION = ("mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm", "flv", "asf")
FROM_ZERO = "matroska,webm"  # its duration counts from time 0, and not from the first frame
MICROSECONDS = 1e6  # FFmpeg's units of duration per second
# Least shortfall of a film, the longer of the two: the last frame's length and edits at the end are stated roughly.
SHORT_S, SHORT_FRAMES = 0.5, 3


def _url(path: Path) -> str:
    """Path of a film for FFmpeg, which would take what leads a colon in a relative one for a protocol."""
    return str(path.absolute())


def _quarter_turns(path: Path) -> int:
    """Quarter turns to the left by which players show a film, as one taken with an upright phone; 0 if unknown."""
    if not path.is_file():  # a pipe is read once
        return 0
    with contextlib.suppress(av.error.FFmpegError, OSError), contextlib.closing(av.open(_url(path))) as container:
        for picture in container.decode(video=0):
            return round(picture.rotation / 90) % 4
    return 0


class Film(contextlib.AbstractContextManager["Film", None]):
    """Read a film: iterate over it for its frames. A context manager.

    Frames that cannot be decoded are left out, and `shortfall` says so, as it does where a film ends before the time in
    its header. Frames decoded with errors are not noticed, nor are packets missing from the container.

    Attributes:
        path: file of the film.
        size: (width, height) [px], of the picture as players turn it.
        rate_hz: mean frame rate [Hz].
        count: number of frames by the header; None if it has none.
        number: number of the newest frame, from 0. Packets that cannot be decoded count as frames, so that labels by
            number stay valid for a damaged film; beside one, B-frames may have their neighbours' numbers.
        shortfall: reason why frames are missing, known after the last frame; empty if the film is whole, or if that
            cannot be known.
    """

    def __init__(self, path: Path) -> None:
        """Open a film.

        Raises:
            CotargetError: the file is missing, is no film, or has no video stream.
        """
        if path.is_dir():
            raise CotargetError(f"{path}: is a directory; give the path of a film")
        if not path.exists():
            raise CotargetError(f"{path}: no such file; give the path of a film")
        self.path = path
        try:
            self._container = av.open(_url(path))
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise CotargetError(
                f"{path}: cannot be read as a film ({reason_of(error)}); give e.g. an mp4 or avi"
            ) from None
        if not self._container.streams.video:
            self._container.close()
            raise CotargetError(f"{path}: has no video stream; give a film with pictures")
        stream = self._container.streams.video[0]
        stream.thread_type = "AUTO"
        self._turns = _quarter_turns(path)
        self.size = (int(stream.width), int(stream.height))
        if self._turns % 2:
            self.size = self.size[::-1]
        self.rate_hz = float(stream.average_rate or stream.guessed_rate or FALLBACK_RATE_HZ)
        self.count: int | None = stream.frames or None
        self.number = -1
        self.shortfall = ""
        self._end = 0.0  # end of what was read of pictures and sound, in the film's time [s]

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._container.close()

    def __iter__(self) -> Iterator[Frame]:
        """Decode the frames in order; times are the film's own [s], or from the frame rate if it has none.

        A single wild time stamp, which is not between those of its neighbours, is replaced, and a warning says so; the
        first and the last one, and two in a row, stay as they are.

        Raises:
            CotargetError: nothing can be decoded, or the image's size changes.
        """
        waiting: tuple[int, Frame] | None = None  # a frame and its number, until the next one is read
        before = math.inf
        for number, frame in self._decoded():
            if waiting is not None:
                self.number, read = waiting
                if before < frame.t and not before <= read.t <= frame.t:
                    log.warning("%s: the wild time stamp of frame %d is replaced", self.path, self.number)
                    read = replace(read, t=(before + frame.t) / 2)
                before = read.t
                yield read
            waiting = number, frame
        if waiting is not None:
            self.number, read = waiting
            yield read

    def _decoded(self) -> Iterator[tuple[int, Frame]]:
        """Decode the frames with their numbers and the film's own times; then find out what is missing."""
        number, refused, first, reason, failed = -1, 0, -1, "", ""
        try:
            for found in self._packets():
                if isinstance(found, av.error.FFmpegError):
                    reason, first = reason or f" ({reason_of(found)})", number + 1 if first < 0 else first
                    number, refused = number + 1, refused + 1
                    continue
                number += 1
                yield number, self._frame(found, number)
        except av.error.FFmpegError as error:
            failed = f" ({reason_of(error)})"
        if refused == number + 1:
            raise CotargetError(
                f"{self.path}: holds no frame that can be decoded{failed or reason}; give a complete film"
            )
        lost = f"{refused} packet{'s' if refused > 1 else ''} from frame {first} on could not be decoded{reason}"
        ending = self._shortfall() or (f"what follows cannot be decoded{failed}" if failed else "")
        self.shortfall = "; ".join(filter(None, (lost if refused else "", ending)))

    def _frame(self, picture: av.VideoFrame, number: int) -> Frame:
        """Convert a decoded picture; one without a time has that of the frame rate."""
        image = np.ascontiguousarray(np.rot90(picture.to_ndarray(format="bgr24"), self._turns))
        width, height = self.size
        if image.shape[:2] != (height, width):
            raise CotargetError(
                f"{self.path}: the picture's size changes from {width}x{height} to "
                f"{image.shape[1]}x{image.shape[0]} at frame {number}; cut the film there"
            )
        return Frame(image, number / self.rate_hz if picture.time is None else float(picture.time))

    def _packets(self) -> Iterator[av.VideoFrame | av.error.FFmpegError]:
        """Decode the first video stream, packet by packet; packets of all streams are read to find their end."""
        pictures = self._container.streams.video[0]
        for packet in self._container.demux():
            if packet.pts is not None and packet.time_base is not None:
                self._end = max(self._end, float((packet.pts + (packet.duration or 0)) * packet.time_base))
            # An empty packet repeats the frame before it; the very last one has no time and flushes the decoder.
            if packet.stream is pictures and (packet.size or packet.dts is None):
                try:
                    yield from cast(list[av.VideoFrame], packet.decode())
                except av.error.FFmpegError as error:
                    yield error

    def _stated(self) -> tuple[float, float]:
        """Begin and duration of the film by its header [s]; 0 where it has none."""
        stream, container = self._container.streams.video[0], self._container
        begin, stated = 0.0, 0.0
        if container.format.name == "avi" and stream.frames and stream.time_base is not None:
            stated = float(stream.frames * stream.time_base)  # FFmpeg estimates AVI's duration from the file's size
        elif container.format.name in TELL_DURATION and container.duration is not None:
            stated = container.duration / MICROSECONDS
            if container.format.name != FROM_ZERO:
                begin = (container.start_time or 0) / MICROSECONDS
        return begin, stated

    def _shortfall(self) -> str:
        """Describe what the header states beyond what was read; empty if nothing."""
        begin, stated = self._stated()
        if begin + stated - self._end <= max(SHORT_S, SHORT_FRAMES / self.rate_hz):
            return ""
        return f"the film says that it lasts {stated:.1f} s, and ends at {max(self._end - begin, 0.0):.1f} s"


QUALITY, PRESET = "20", "veryfast"  # of x264; see docs/design-notes.md
# Clock of a film's frames [Hz], MPEG's own. A container for constant rates alone, such as AVI, counts in frames.
TICKS_HZ = 90_000
LEAST_S = 1e-3  # least time from frame to frame [s], Matroska's unit
# A film in a MOV container is written in pieces of a second, each of which can be played while later ones are missing,
# and becomes one whole when it is complete.
FRAGMENTED = (".mp4", ".mov", ".m4v")
FRAGMENTS = {"movflags": "hybrid_fragmented+delay_moov", "frag_duration": "1000000"}
KEYFRAME_S = 1.0  # a piece begins with a keyframe


class FilmWriter(contextlib.AbstractContextManager["FilmWriter", None]):
    """Write a film as H.264 yuv420p, under its name only when it is complete. A context manager.

    Frames are shown at their own times. What a killed run has written so far can be played from its temporary file.

    Attributes:
        epoch: wall-clock time at which the frames' clock showed 0, for the film's creation time; None if it has none.
            To be set before the first frame.
    """

    def __init__(self, path: Path, rate_hz: float, *, keep: bool = False) -> None:
        """Open a film for writing.

        Args:
            path: file of the film, with a suffix that names a container, such as .mp4.
            rate_hz: nominal frame rate, which gives the last frame's duration [Hz].
            keep: whether to keep the frames so far as a film if the block ends in an error.

        Raises:
            CotargetError: the folder is missing, or the suffix names no container.
        """
        self._path, self._keep = path, keep
        self.epoch: datetime | None = None
        self._part = PartFile(path)
        self._rate = Fraction(rate_hz).limit_denominator(1001 * 30)
        self._stream: av.VideoStream | None = None
        self._begin, self._last = 0.0, -TICKS_HZ
        try:
            options = {"flush_packets": "1"} | (FRAGMENTS if path.suffix.lower() in FRAGMENTED else {})
            self._container = av.open(_url(self._part.path), "w", options=options)
        except (av.error.FFmpegError, OSError, ValueError) as error:
            with self._part.ending(keep=False):
                raise self._said(error) from None

    @property
    def size_bytes(self) -> int:
        """Size of what is written so far [bytes]; the encoder keeps some frames back."""
        return self._part.path.stat().st_size

    def write(self, image: Image, t: float) -> None:
        """Append an image.

        Args:
            image: (H, W, 3) BGR; an odd side is extended by repeating its last row or column.
            t: time at which it is shown, on any clock [s]; the film begins at the first one.

        Raises:
            CotargetError: the container cannot hold H.264, or the disk is full.
        """
        height, width = image.shape[:2]
        if height % 2 or width % 2:
            image = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE).astype(np.uint8)
        try:
            if self._stream is None:
                self._stream, self._begin = self._begun(image, t), t
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24")
            tick = self._stream.codec_context.time_base
            assert tick is not None
            least = max(1, round(LEAST_S / tick))
            self._last = max(self._last + least, round((t - self._begin) / tick))  # a clock may jump back
            picture.pts, picture.time_base, picture.duration = self._last, tick, round(1 / self._rate / tick)
            self._container.mux(self._stream.encode(picture))
        except (av.error.FFmpegError, ValueError) as error:
            raise self._said(error) from None

    def _begun(self, image: Image, t: float) -> av.VideoStream:
        """Add the stream for images of this size."""
        variable = self._container.format.flags & av.format.Flags.variable_fps.value
        stream = self._container.add_stream("libx264", rate=self._rate, options={"crf": QUALITY, "preset": PRESET})
        stream.width, stream.height, stream.pix_fmt = image.shape[1], image.shape[0], "yuv420p"
        stream.codec_context.time_base = stream.time_base = Fraction(1, TICKS_HZ) if variable else 1 / self._rate
        stream.codec_context.gop_size = max(1, round(KEYFRAME_S * self._rate))
        if self.epoch is not None:
            began = self.epoch + timedelta(seconds=t)
            self._container.metadata["creation_time"] = began.isoformat(timespec="microseconds")
        return stream

    def _said(self, error: Exception) -> CotargetError:
        return CotargetError(f"{self._path}: cannot be written ({reason_of(error)}); name e.g. an .mp4")

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Complete the film and give it its name; after an error, remove it or keep the frames so far.

        Raises:
            CotargetError: the film could not be completed, for example on a full disk.
        """
        keep, failure = self._stream is not None and (error is None or self._keep), None
        with self._part.ending(keep=keep, error=error):
            try:
                if keep and self._stream is not None:
                    self._container.mux(self._stream.encode(None))
                self._container.close()
            except (av.error.FFmpegError, OSError) as failed:  # FFmpeg writes nothing more after a full disk
                failure = failed
                with contextlib.suppress(av.error.FFmpegError, OSError):
                    self._container.close()
            if keep and failure is not None and not _can_be_played(self._part.path):
                raise CotargetError(f"{self._path}: cannot be completed ({reason_of(failure)})")
        if error is None and failure is not None:
            raise CotargetError(f"{self._path}: is cut short ({reason_of(failure)}); holds what there was until then")


def _can_be_played(path: Path) -> bool:
    """Check whether a film has a frame that can be decoded."""
    try:
        with Film(path) as film:
            return next(iter(film), None) is not None
    except CotargetError:
        return False


def join_films(parts: Sequence[Path], path: Path) -> None:
    """Concatenate films of one size and rate, as `FilmWriter` writes them, without encoding them again."""
    with av.open(_url(path), "w") as joined:
        stream, shift = None, 0
        for part in parts:
            with av.open(_url(part)) as film:
                source = film.streams.video[0]
                if stream is None:
                    stream = joined.add_stream_from_template(source)
                    stream.time_base = source.time_base
                end = 0
                for packet in film.demux(source):
                    if packet.dts is None:  # the demuxer's end marker
                        continue
                    end = max(end, packet.pts + packet.duration)
                    packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                    packet.stream = stream
                    joined.mux(packet)
                shift += end
