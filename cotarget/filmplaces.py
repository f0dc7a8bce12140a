"""Which frame of a film is which, so that one that cannot be decoded takes no number from those after it."""

import av

# Codecs of which a packet without a picture is nothing unusual.
HIDES_FRAMES = ("vp8",)
# One of these that is smaller says that the picture before it stays [bytes], as FFmpeg's MAX_NVOP_SIZE has it.
REPEATS, SMALLEST = ("mpeg4",), 20


class Places:
    """Numbers the frames of a film as they are decoded.

    A packet makes a frame. As long as the decoder refuses none, frames are counted, whatever packets are without one.
    After that, packets that were to be seen before a frame and did not become one were lost, and keep their numbers;
    and so were those behind the last frame.
    Where packets do not say when they are to be seen, or may be one of two of a frame, frames are counted all the time.

    Attributes:
        number: of the newest frame, from 0.
        reason: why the first packet was refused, in brackets; empty where none was.
    """

    def __init__(self, stream: av.VideoStream) -> None:
        """Begin with a film whose packets were not decoded yet."""
        stream.codec_context.copy_opaque = True  # a frame has its packet's
        codec = stream.codec_context.name
        self.number, self.reason = -1, ""
        self._known, self._smallest = codec not in HIDES_FRAMES, SMALLEST if codec in REPEATS else 0
        # By packet: its part of the film, its time in that, and whether it has to become a frame.
        self._waiting: dict[int, tuple[int, int, bool]] = {}
        self._packets = self._part = self._time = 0
        self._begun = False
        self._refused = self._refused_inside = self._lost = 0
        # Number of the first that was lost, and of the frame after the first refusal.
        self._first: int | None = None
        self._first_refused: int | None = None

    def expect(self, packet: av.Packet) -> None:
        """Take note of a packet that is going to be decoded."""
        if not packet.size or not self._known:
            return
        if packet.pts is None:
            self._forget()
            return
        if packet.dts is not None:
            self._part += packet.dts < self._time  # where films were joined, time begins again
            self._time = packet.dts
        self._begun = self._begun or packet.is_keyframe  # nothing can be decoded before
        needed = self._begun and packet.size >= self._smallest and not packet.is_discard
        packet.opaque = self._packets
        self._waiting[self._packets] = self._part, packet.pts, needed
        self._packets += 1

    def refuse(self, error: av.error.FFmpegError) -> None:
        """Count a packet that cannot be decoded."""
        self._refused += 1
        self.reason = self.reason or f" ({reason_of(error)})"

    def take(self, picture: av.VideoFrame) -> None:
        """Number a frame."""
        place = self._waiting.pop(picture.opaque, None) if isinstance(picture.opaque, int) else None
        if place is None or picture.interlaced_frame:  # which may have a packet for each of its two fields
            self._forget()
        else:
            self._lose([packet for packet, at in self._waiting.items() if at[:2] < place[:2]])
        self.number += 1
        if self._refused and self._first_refused is None:
            self._first_refused = self.number
        self._refused_inside = self._refused

    def _forget(self) -> None:
        """From now on only count."""
        self._known = False
        self._waiting.clear()

    def _lose(self, packets: list[int]) -> None:
        """Leave out the numbers of packets that did not become frames, where anything was refused."""
        count = sum(self._waiting.pop(packet)[2] for packet in packets)
        if not (self._refused and count):
            return
        self._first = self.number + 1 if self._first is None else self._first
        self._lost += count
        self.number += count

    def told(self, *, ended: bool) -> str:
        """Say what was lost, after the last frame; empty where nothing was.

        Args:
            ended: whether it is told otherwise that the film ends there, so that what follows is no more to be told.
        """
        lost, refused = self._lost, self._refused_inside
        if not ended:  # PyAV tells of no refusal once the decoder has given a frame of the last ones
            lost, refused = lost + sum(needed for _, _, needed in self._waiting.values()), self._refused
        if not (count := max(lost, refused)):
            return ""
        packets = "1 packet" if count == 1 else f"{count} packets"
        starts = (first for first in (self._first, self._first_refused, self.number + 1) if first is not None)
        return f"{packets} from frame {next(starts)} on could not be decoded{self.reason}"


def reason_of(error: Exception) -> str:
    """The first line of an error, without the path that FFmpeg appends."""
    return (getattr(error, "strerror", None) or str(error) or type(error).__name__).splitlines()[0]
