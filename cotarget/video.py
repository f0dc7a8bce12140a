"""Read films that PyAV can decode, and write H.264 yuv420p films that any player and browser opens."""

import contextlib
import logging
import math
import os
from collections import deque
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
from cotarget.files import PartFile, write_all
from cotarget.rig import Frame, Image
from cotarget.safety.signals import deferred_signals

log = logging.getLogger(__name__)

# Codecs in which a packet without a frame is normal, and those in which one smaller than FFmpeg's MAX_NVOP_SIZE [bytes]
# repeats the frame before it.
HIDES_FRAMES, REPEATS, SMALLEST = ("vp8",), ("mpeg4",), 20


class Places:
    """Number the frames of a film as they are decoded, so that lost frames do not shift those after them.

    Until the decoder refuses a packet, frames are counted. After that, packets due before a decoded frame that did not
    become frames were lost and keep their numbers, as do those after the last frame. Where packets have no presentation
    time, or a frame may have two packets, frames are only counted.

    Attributes:
        number: number of the newest frame, from 0.
        reason: reason why the first packet was refused, in brackets; empty if none was.
    """

    def __init__(self, stream: av.VideoStream) -> None:
        stream.codec_context.copy_opaque = True  # so that a frame carries its packet's number
        codec = stream.codec_context.name
        self.number, self.reason = -1, ""
        self._known, self._smallest = codec not in HIDES_FRAMES, SMALLEST if codec in REPEATS else 0
        # For each packet: its part of the film, its time in that part, and whether it must become a frame.
        self._waiting: dict[int, tuple[int, int, bool]] = {}
        self._packets = self._part = self._time = 0
        self._refused = self._refused_inside = self._lost = 0
        # Number of the first lost frame, and of the first frame after a refusal.
        self._first: int | None = None
        self._first_refused: int | None = None

    def expect(self, packet: av.Packet) -> None:
        """Register a packet before it is decoded."""
        if not packet.size or not self._known:
            return
        if packet.pts is None:
            self._forget()
            return
        if packet.dts is not None:
            self._part += packet.dts < self._time  # time restarts where films were joined
            self._time = packet.dts
        packet.opaque = self._packets
        self._waiting[self._packets] = self._part, packet.pts, packet.size >= self._smallest
        self._packets += 1

    def refuse(self, error: av.error.FFmpegError) -> None:
        """Count a packet that the decoder refused."""
        self._refused += 1
        self.reason = self.reason or f" ({reason_of(error)})"

    def take(self, picture: av.VideoFrame) -> None:
        """Assign a number to a decoded frame."""
        place = self._waiting.pop(picture.opaque, None) if isinstance(picture.opaque, int) else None
        if place is None or picture.interlaced_frame:  # an interlaced frame may have a packet for each field
            self._forget()
        else:
            self._lose([packet for packet, at in self._waiting.items() if at[:2] < place[:2]])
        self.number += 1
        if self._refused and self._first_refused is None:
            self._first_refused = self.number
        self._refused_inside = self._refused

    def _forget(self) -> None:
        """Stop tracking packets; from now on frames are only counted."""
        self._known = False
        self._waiting.clear()

    def _lose(self, packets: list[int]) -> None:
        """Skip the numbers of packets that did not become frames, if any packet was refused."""
        count = sum(self._waiting.pop(packet)[2] for packet in packets)
        if not (self._refused and count):
            return
        self._first = self.number + 1 if self._first is None else self._first
        self._lost += count
        self.number += count

    def describe(self, *, ended: bool) -> str:
        """Describe what was lost, after the last frame; empty if nothing was.

        Args:
            ended: whether the message already says that the film ends early, so that packets after it do not count.
        """
        lost, refused = self._lost, self._refused_inside
        if not ended:  # PyAV reports no refusal once the decoder has returned a frame of the last packets
            lost, refused = lost + sum(needed for _, _, needed in self._waiting.values()), self._refused
        if not (count := max(lost, refused)):
            return ""
        packets = "1 packet" if count == 1 else f"{count} packets"
        starts = (first for first in (self._first, self._first_refused, self.number + 1) if first is not None)
        return f"{packets} from frame {next(starts)} on could not be decoded{self.reason}"


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
AHEAD = 3  # frames whose time stamps are looked at ahead: they outvote two wild ones in a row


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
    its header. Frames decoded with errors are not noticed, nor are packets missing from the container, except in AVI,
    whose header has the number of frames.

    Attributes:
        path: file of the film.
        size: (width, height) [px], of the picture as players turn it.
        rate_hz: mean frame rate [Hz].
        count: number of frames by the header; None if it has none.
        number: number of the newest frame, from 0. Frames that cannot be decoded have numbers too, so that labels by
            number stay valid for a damaged film.
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
        self._damaged = False  # whether the newest decoded frame is
        self._slots = 0  # end of what was read, in frames of the stream's own time
        self._end = 0.0  # end of what was read of pictures and sound, in the film's time [s]

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._container.close()

    def __iter__(self) -> Iterator[Frame]:
        """Decode the frames in order; times are the film's own [s], or from the frame rate if it has none.

        A wild time stamp is replaced, and a warning says so after the last frame: most of the next frames, or the end
        in the film's header, go on from the time before it, and it is not between.

        Raises:
            CotargetError: nothing can be decoded, or the image's size changes.
        """
        places, self._slots = Places(self._container.streams.video[0]), 0
        reason = ""
        try:
            yield from self._mended(self._decoded(places))
        except av.error.FFmpegError as error:
            reason = f" ({reason_of(error)})"
        if self.number < 0:
            raise CotargetError(
                f"{self.path}: holds no frame that can be decoded{reason or places.reason}; give a complete film"
            )
        ending = self._shortfall() or (f"what follows cannot be decoded{reason}" if reason else "")
        self.shortfall = "; ".join(filter(None, (places.describe(ended=bool(ending)), ending)))

    def _decoded(self, places: Places) -> Iterator[tuple[int, Frame]]:
        """Decode the frames with their numbers and the film's own times."""
        size = self.size
        for picture in self._pictures(places):
            image, self._damaged = picture.to_ndarray(format="bgr24"), picture.is_corrupt
            if self._turns:
                image = np.ascontiguousarray(np.rot90(image, self._turns))
            if (image.shape[1], image.shape[0]) != size:
                raise CotargetError(
                    f"{self.path}: the picture's size changes from {size[0]}x{size[1]} to "
                    f"{image.shape[1]}x{image.shape[0]} at frame {places.number}; cut the film there"
                )
            number = places.number
            yield number, Frame(image, number / self.rate_hz if picture.time is None else float(picture.time))

    def _mended(self, frames: Iterator[tuple[int, Frame]]) -> Iterator[Frame]:
        """Replace wild time stamps, see `__iter__`."""
        waiting: deque[tuple[int, Frame]] = deque()
        wild, end, failure = list[int](), list[float](), None
        before, period = -math.inf, 1 / self.rate_hz
        while True:
            while failure is None and len(waiting) <= AHEAD:
                try:
                    waiting.append(next(frames))
                except (StopIteration, CotargetError, av.error.FFmpegError) as error:
                    failure = error
                    if isinstance(error, StopIteration) and (stated := sum(self._stated())):
                        end = AHEAD * [stated + max(SHORT_S, SHORT_FRAMES * period)]
            if not waiting:
                break
            self.number, frame = waiting.popleft()
            after = ([each.t for _, each in waiting] + end)[:AHEAD]
            against = [i for i, t in enumerate(after, 1) if before < t and not before <= frame.t <= t]
            if against and 2 * len(against) >= len(after):
                wild.append(self.number)
                i, t = against[0], after[against[0] - 1]
                mended = t - i * period if math.isinf(before) else before + min(period, (t - before) / (i + 1))
                frame = replace(frame, t=mended)
            before = frame.t
            yield frame
        if wild:
            log.warning("%s: wild time stamps, replaced: %d, the first at frame %d", self.path, len(wild), wild[0])
        if failure is not None and not isinstance(failure, StopIteration):
            raise failure

    def _pictures(self, places: Places) -> Iterator[av.VideoFrame]:
        """Decode the first video stream; packets of all streams are read to find their end."""
        pictures = self._container.streams.video[0]
        for packet in self._container.demux():
            if packet.pts is not None and packet.time_base is not None:
                self._end = max(self._end, float((packet.pts + (packet.duration or 0)) * packet.time_base))
            if packet.stream is pictures and packet.dts is not None:
                self._slots = max(self._slots, packet.dts + (packet.duration or 1))
            # An empty packet repeats the frame before it; the very last one has no time and flushes the decoder.
            if packet.stream is pictures and (packet.size or packet.dts is None):
                places.expect(packet)
                try:
                    decoded = cast(list[av.VideoFrame], packet.decode())
                except av.error.FFmpegError as error:
                    places.refuse(error)
                    continue
                for picture in decoded:
                    places.take(picture)
                    yield picture

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
        """Describe what the container states beyond what was read, or that the last frame is damaged."""
        stream, container = self._container.streams.video[0], self._container
        begin, stated = self._stated()
        if begin + stated - self._end > max(SHORT_S, SHORT_FRAMES / self.rate_hz):
            return f"the film says that it lasts {stated:.1f} s, and ends at {max(self._end - begin, 0.0):.1f} s"
        # In AVI every frame is a slot of its time, even an empty one; a lost frame makes the others come too early.
        if container.format.name == "avi" and (lost := stream.frames - self._slots) > 0:
            stated_count = f"of the {stream.frames} frames that it says it has {lost} are lost"
            return f"{stated_count}, and those after them come too early"
        return "its last frame is damaged" if self._damaged else ""


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
        self._file = _FilmFile(self._part)
        self._rate = Fraction(rate_hz).limit_denominator(1001 * 30)
        self._stream: av.VideoStream | None = None
        self._begin, self._last = 0.0, -TICKS_HZ
        try:
            options = FRAGMENTS if path.suffix.lower() in FRAGMENTED else {}
            self._container = av.open(self._file, "w", options=options)
        except (av.error.FFmpegError, OSError, ValueError) as error:
            with self._part.ending(keep=False):
                raise self._said(error) from None

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
            with deferred_signals():  # an exception while the file is written would be lost in FFmpeg
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
            self._file.refuse(error)
        if self._file.failure is not None:
            raise self._said(self._file.failure)

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
        keep = self._stream is not None and (error is None or self._keep)
        with self._part.ending(keep=keep, error=error):
            try:
                if keep and self._stream is not None and self._file.failure is None:
                    self._container.mux(self._stream.encode(None))
                self._container.close()
            except (av.error.FFmpegError, OSError) as failed:
                self._file.refuse(failed)
            finally:
                with contextlib.suppress(av.error.FFmpegError, OSError):
                    self._container.close()
                self._file.close()
            failure = self._file.failure
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


class _FilmFile:
    """File of a film in the making, which can be played up to where the disk was full.

    FFmpeg completes a film by overwriting its beginning. That is done when the file is closed, and only if everything
    else could be written; after a failure nothing more is written.

    Attributes:
        name: path of the file, by which FFmpeg chooses the container.
        failure: the first error; None if there was none.
    """

    def __init__(self, part: PartFile) -> None:
        self.name = str(part.path)
        self.failure: Exception | None = None
        self._file = part.file
        self._at = self._size = 0
        self._overwritten: list[tuple[int, bytes]] = []

    def refuse(self, error: Exception) -> None:
        """Write nothing more because of an error."""
        self.failure = self.failure or error

    def write(self, data: bytes) -> int:
        """Append data; keep what overwrites earlier data for the end."""
        data = bytes(data)
        inside = min(len(data), self._size - self._at)
        if inside:
            self._overwritten.append((self._at, data[:inside]))
        if len(data) > inside and self.failure is None:
            try:
                write_all(self._file, data[inside:])
            except OSError as error:
                self.refuse(error)
                self._file.truncate(self._size)
        self._at += len(data)
        self._size = max(self._size, self._at)
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a place of the file, as it would be without failures."""
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._size}[whence]
        return self._at

    def tell(self) -> int:
        """Return the place in the file."""
        return self._at

    def close(self) -> None:
        """Write what overwrites earlier data, and close the file."""
        with self._file:
            if self.failure is None:
                for at, data in self._overwritten:
                    self._file.seek(at)
                    write_all(self._file, data)


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
