"""Emulated Canon PowerShot S5 IS on PTP/IP, in front of image feeds and a lens.

It announces the operations, events and properties of a real camera, as one reported them to gphoto2 in July 2008
(libgphoto2, camlibs/ptp2/cameras/canon-s5.txt), except for the serial number, and for image size and quality, which are
at their best. It carries out what libgphoto2 sends for remote shooting and refuses the rest as not supported. It has no
card: a still stays in memory until the next one, or until the camera is switched off. Stills always have their full
size; exposure settings are stored and have no effect.

Behaviour that was not measured on a real camera is chosen so that a driver for this emulator expects little:

- Zoom positions beyond the lens's last are digital: they are accepted, the lens stays at its last, nothing is cropped.
- The zoom reads back as commanded, even while the lens moves, and may be set during a motion.
- The viewfinder gives each image once and waits for the next. It answers "busy" during a still, and after a second
  without an image.
- The lens stays out when the camera leaves shooting mode.

Faults of USB are not emulated: PTP/IP is another transport.
"""

import logging
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from cotarget.emulators.plant import Feed, LensPlant, encode_jpeg
from cotarget.emulators.ptpip import (
    ARRAY,
    JPEG,
    LINE_FAULTS,
    STRING,
    UINT8,
    UINT16,
    UINT32,
    Code,
    Property,
    PtpError,
    PtpIpServer,
    PtpReply,
    Value,
    array,
    decode,
    device_info,
    encode,
    object_info,
    storage_info,
)
from cotarget.emulators.serve import LOCAL, Faults
from cotarget.errors import CotargetError
from cotarget.rig import Image

log = logging.getLogger(__name__)

# Viewfinder and stills

PICTURE_WAIT_S = 1.0  # time limit for the viewfinder's next image [s]
CHECK_S = 0.1  # period of checking whether the viewfinder is still on [s]


@dataclass(frozen=True)
class Exposure:
    """A still as JPEG, and its size [px]."""

    jpeg: bytes
    size: tuple[int, int]


class Viewfinder:
    """Images of a feed as JPEG of one size (width, height) [px], each given once."""

    def __init__(self, feed: Feed, size: tuple[int, int], quality: int) -> None:
        self._feed, self._size, self._quality = feed, size, quality
        self._seen = -1  # index of the last image given
        self._since: float | None = None

    @property
    def on(self) -> bool:
        """Whether the viewfinder is on."""
        return self._since is not None

    def switch(self, on: bool) -> None:
        """Switch the viewfinder on or off; on again has no effect."""
        self._since = (time.monotonic() if self._since is None else self._since) if on else None

    def image(self) -> bytes | None:
        """Wait for an image exposed since the viewfinder is on and not given yet; None if none comes."""
        deadline = time.monotonic() + PICTURE_WAIT_S
        while (since := self._since) is not None and time.monotonic() < deadline:
            picture = self._feed.newest(self._seen, CHECK_S)
            if picture is not None:
                self._seen = picture.index
                if picture.t >= since:
                    return encode_jpeg(picture.image, self._quality, self._size)
        return None


class Shutter:
    """Take stills, each on its own thread, with a delay from the request to the exposure [s]."""

    def __init__(self, still: Callable[[], Image], quality: int, delay_s: float) -> None:
        self._still, self._quality, self._delay_s = still, quality, delay_s
        self._timers: list[threading.Timer] = []

    def release(self, done: Callable[[Exposure | None], None]) -> None:
        """Take a still, and call ``done`` with it, or with None if none could be taken."""
        timer = threading.Timer(self._delay_s, self._take, (done,))
        self._timers = [*(other for other in self._timers if other.is_alive()), timer]
        timer.start()

    def close(self) -> None:
        """Wait for the stills under way, and drop those whose delay is not over."""
        for timer in self._timers:
            timer.cancel()
            timer.join()

    def _take(self, done: Callable[[Exposure | None], None]) -> None:
        try:
            image = self._still()
        except CotargetError as error:
            log.warning("no still: %s", error)
            done(None)
            return
        done(Exposure(encode_jpeg(image, self._quality), (image.shape[1], image.shape[0])))


# Operations

MEMORY = 0x80000001  # number of the internal memory as a storage
FIRST_HANDLE = 0x81000000
ALREADY_SO, REFUSED = 0xA009, 0xA005  # Canon's response codes: already in that mode; operation refused
OBJECT_TRANSFER, MODE_CHANGED, CAPTURE_COMPLETE = 0xC009, 0xC00C, 0x400D  # events
INTERRUPTING, CHECKED = (1, 2, 3, 4, 5), (3, 4, 5, 7)  # event modes: sent at once, fetched by CheckEvent
EVENT_CONTAINER = 4  # type of an event container in PTP over USB, whose layout CheckEvent uses
INFO, OPEN, CLOSE, SET_VALUE = 0x1001, 0x1002, 0x1003, 0x1016
START_SHOOTING, END_SHOOTING, VIEWFINDER_ON, VIEWFINDER_OFF = 0x9008, 0x9009, 0x900B, 0x900C
CAPTURE, VIEWFINDER_IMAGE = 0x901A, 0x901D
SHOOTING_ONLY = frozenset((VIEWFINDER_ON, VIEWFINDER_OFF, CAPTURE, VIEWFINDER_IMAGE))
# Operations that a busy camera refuses; queries and events still work.
NOT_WHEN_BUSY = SHOOTING_ONLY | {SET_VALUE, START_SHOOTING, END_SHOOTING}


class CodeError(Exception):
    """An operation is refused with a response code."""

    def __init__(self, code: int, *parameters: int) -> None:
        super().__init__(f"{code:#06x}")
        self.answer = PtpReply(code, parameters)


class S5isCamera:
    """The camera's operations; safe from any thread.

    ``interrupt`` sends an event's code and parameters to the initiator at once. Of the faults, "busy" is used here.
    """

    def __init__(
        self,
        viewfinder: Viewfinder,
        shutter: Shutter,
        lens: LensPlant,
        faults: Faults,
        interrupt: Callable[[int, Iterable[int]], None],
    ) -> None:
        self._viewfinder, self._shutter, self._lens, self._faults = viewfinder, shutter, lens, faults
        self._interrupt = interrupt
        self._lock = threading.RLock()
        self._playing = {prop.code: prop for prop in ALWAYS}
        self._all = self._playing | {prop.code: prop for prop in shooting(lens.last)}
        self._handle = FIRST_HANDLE
        self._reset()
        self._values[ZOOM] = lens.position()
        # Operations that return data.
        self._data: dict[int, Callable[[tuple[int, ...]], bytes]] = {
            0x1004: lambda words: array([MEMORY], UINT32),  # storages
            0x1005: lambda words: storage_info("V"),
            0x1007: lambda words: array([], UINT32),  # objects; stills in memory are not listed
            0x1008: lambda words: self._still_info(words[0]),
            0x1009: lambda words: self._still(words[0])[1].jpeg,
            0x1014: lambda words: self._property(words[0]).describe(self._values[words[0]]),
            0x1015: lambda words: encode(self._property(words[0]).kind, self._values[words[0]]),
            0x9013: lambda words: self._events.popleft() if self._events else b"",
        }
        # Operations that change something, with the initiator's data.
        self._actions: dict[int, Callable[[tuple[int, ...], bytes], None]] = {
            OPEN: lambda words, data: self._open(words[0]),
            CLOSE: lambda words, data: self.disconnected(),
            SET_VALUE: lambda words, data: self._set(words[0], data),
            START_SHOOTING: lambda words, data: self._set_shooting(True),
            END_SHOOTING: lambda words, data: self._set_shooting(False),
            VIEWFINDER_ON: lambda words, data: self._viewfinder.switch(True),
            VIEWFINDER_OFF: lambda words, data: self._viewfinder.switch(False),
            CAPTURE: lambda words, data: self._capture(),
        }

    def operate(self, code: int, parameters: tuple[int, ...], data: bytes) -> PtpReply:
        """Carry out an operation, with five parameters and its data."""
        with self._lock:
            if code == INFO:
                return PtpReply(data=self._info())
            if not self._session and code != OPEN:
                return PtpReply(Code.SESSION_NOT_OPEN)
            if code in NOT_WHEN_BUSY and (self._exposure is not None or "busy" in self._faults):
                return PtpReply(Code.DEVICE_BUSY)
            if code in SHOOTING_ONLY and not self._shooting:
                return PtpReply(REFUSED)
            try:
                if code in self._data:
                    return PtpReply(data=self._data[code](parameters))
                if code in self._actions:
                    self._actions[code](parameters, data)
                    return PtpReply()
            except CodeError as error:
                return error.answer
        if code == VIEWFINDER_IMAGE:  # waits outside of the lock, so that a power-off is not delayed
            image = self._viewfinder.image()
            return PtpReply(Code.DEVICE_BUSY) if image is None else PtpReply(parameters=(len(image),), data=image)
        return PtpReply(Code.OPERATION_NOT_SUPPORTED)

    def disconnected(self) -> None:
        """Close the session; the camera stays in shooting mode, with its viewfinder off."""
        with self._lock:
            self._session = 0
            self._viewfinder.switch(False)

    def unplugged(self) -> None:
        """Go back to play mode, as a camera does without a computer."""
        with self._lock:
            self.disconnected()
            self._shooting = False

    def switch_off(self) -> None:
        """Drop settings and stills, and retract the lens."""
        with self._lock:
            self._reset()
        self._lens.command(0)

    def _reset(self) -> None:
        self._session = 0
        self._shooting = False
        self._viewfinder.switch(False)
        self._exposure: object | None = None  # marks the still under way
        self._taken: tuple[int, Exposure, str] | None = None  # handle, still, date
        self._events: deque[bytes] = deque()
        self._values: dict[int, Value] = {code: prop.default for code, prop in self._all.items()}
        self._values[UNIX_TIME] = int(time.time())

    def _info(self) -> bytes:
        properties = self._all if self._shooting else self._playing
        lists = (OPERATIONS, EVENTS, properties, (JPEG,), FORMATS)
        return device_info(EXTENSION, lists, (MAKER, MODEL, VERSION, SERIAL))

    def _open(self, session: int) -> None:
        if self._session:
            raise CodeError(Code.SESSION_ALREADY_OPEN, self._session)
        if session == 0:
            raise CodeError(Code.INVALID_PARAMETER)
        self._session = session
        self._events.clear()

    def _property(self, code: int) -> Property:
        prop = (self._all if self._shooting else self._playing).get(code)
        if prop is None:
            raise CodeError(Code.PROPERTY_NOT_SUPPORTED)
        return prop

    def _set(self, code: int, data: bytes) -> None:
        prop = self._property(code)
        if not prop.writable:
            raise CodeError(Code.ACCESS_DENIED)
        try:
            value = decode(prop.kind, data)
        except PtpError:
            raise CodeError(Code.INVALID_PROPERTY_FORMAT) from None
        if not prop.allows(value):
            raise CodeError(Code.INVALID_PROPERTY_VALUE)
        self._values[code] = value
        if code == ZOOM and isinstance(value, int):
            self._lens.command(min(value, self._lens.last))

    def _set_shooting(self, on: bool) -> None:
        if on == self._shooting:
            raise CodeError(ALREADY_SO)
        self._shooting = on
        self._viewfinder.switch(False)
        self._emit(MODE_CHANGED)

    def _capture(self) -> None:
        # The viewfinder is off until the still is taken: its next image is exposed after it.
        live = self._viewfinder.on
        self._viewfinder.switch(False)
        exposure = self._exposure = object()
        self._shutter.release(lambda taken: self._keep(exposure, taken, live))

    def _keep(self, exposure: object, taken: Exposure | None, live: bool) -> None:
        with self._lock:
            if exposure is not self._exposure:  # the camera was switched off meanwhile
                return
            self._exposure = None
            self._viewfinder.switch(live and bool(self._session))
            if taken is not None:
                self._handle += 1
                self._taken = self._handle, taken, time.strftime("%Y%m%dT%H%M%S")
                self._emit(OBJECT_TRANSFER, self._handle)
            self._emit(CAPTURE_COMPLETE)

    def _emit(self, code: int, *parameters: int) -> None:
        mode = self._values[EVENT_EMULATE_MODE]
        if mode in CHECKED:
            length = 12 + 4 * len(parameters)
            head = struct.pack("<IHHI", length, EVENT_CONTAINER, code, 0)
            self._events.append(head + struct.pack(f"<{len(parameters)}I", *parameters))
        if mode in INTERRUPTING:
            self._interrupt(code, parameters)

    def _still(self, handle: int) -> tuple[int, Exposure, str]:
        if self._taken is None or self._taken[0] != handle:
            raise CodeError(Code.INVALID_HANDLE)
        return self._taken

    def _still_info(self, handle: int) -> bytes:
        _, still, date = self._still(handle)
        name = f"IMG_{handle - FIRST_HANDLE:04d}.JPG"
        return object_info(MEMORY, len(still.jpeg), still.size, name, date)


# Tables of operations, events and properties

MAKER, MODEL, VERSION, SERIAL = "Canon Inc.", "Canon PowerShot S5 IS", "1-3.2.1.0", "0" * 32
EXTENSION = 0xB  # Canon's
FORMATS = (0x3001, 0x3002, 0x3006, 0x300A, 0x3008, 0x3801, 0x3800, 0xB101, 0xBF01)
DIGITAL = 6  # digital zoom positions beyond the lens's last, which is 128
EVENT_EMULATE_MODE, TRANSFER_MODE, ZOOM, UNIX_TIME = 0xD045, 0xD029, 0xD02A, 0xD034
# fmt: off
OPERATIONS = (
    0x1014, 0x1015, 0x1016, 0x1017, 0x1001, 0x1002, 0x1003, 0x9013, 0x901F, 0x1004, 0x1005, 0x1006, 0x1007, 0x1008,
    0x1009, 0x100A, 0x101B, 0x100C, 0x100D, 0x100B, 0x100F, 0x1012, 0x9001, 0x9021, 0x901B, 0x901E, 0x9019, 0x9006,
    0x901C, 0x9002, 0x904C, 0x902C, 0x902D, 0x902E, 0x9024, 0x9025, 0x900E, 0x900F, 0x9010, 0x9011, 0x9028, 0x9023,
    0x9029, 0x902A, 0x902B, 0x9034, 0x100E, 0x9008, 0x901A, 0x9009, 0x900B, 0x901D, 0x900C, 0x9014, 0x9015, 0x9018,
    0x9012, 0x9801, 0x9802, 0x9803, 0x9804, 0x9805, 0x9020,
)
EVENTS = (
    0x4001, 0x4002, 0x4003, 0x4004, 0x4005, 0x4006, 0x4007, 0x4008, 0x4009, 0x400A, 0x400B, 0x400C, 0x400D, 0x400E,
    0xC001, 0xC005, 0xC008, 0xC009, 0xC00A, 0xC00B, 0xC00C, 0xC00D, 0xC00E, 0xC00F, 0xC011, 0xC013,
)
# fmt: on
def size_qualities() -> Iterator[tuple[int, ...]]:
    """Yield height, width and number of each size in each of three qualities, as the camera lists them."""
    sizes = ((2448, 3264, 1, 5), (1944, 2592, 2, 5), (1536, 2048, 3, 5), (1200, 1600, 17, 1), (480, 640, 5, 5))
    for height, width, number, step in sizes:
        for quality in range(3):
            yield height, width, number + step * quality, 0, 0, 0


COMPENSATIONS = (8, 11, 13, 16, 19, 21, 24, 27, 29, 32, 35, 37, 40)  # +2 EV to -2 EV
BYTES_OF_SIZES = (
    *(3518464, 2563072, 1640448, 0, 254976, 2109440, 1428480, 914432, 0, 153600),
    *(1003520, 711680, 455680, 0, 86016, 0, 1026048, 571392, 284672),
)
ALWAYS = (
    Property(EVENT_EMULATE_MODE, UINT16, 4, True, (1, 2, 3, 4, 5, 6, 7)),
    Property(0xD04A, UINT8, 0, True, (0, 1, 2, 3)),
    Property(0xD02E, UINT32, 524288),  # size of output data from the camera
    Property(0xD02F, UINT32, 262144),  # size of input data to the camera
    Property(0xD002, UINT16, 1, False, (0, 1, 2, 3, 4, 5)),  # battery type
    Property(0xD003, UINT32, 1, False, (0, 1, 2, 3)),  # battery mode
    Property(UNIX_TIME, UINT32, 0, True),
    Property(0xD047, UINT16, 2),  # type of slideshow
    Property(0xD046, UINT16, 257),  # DPOF version
    Property(0xD02D, ARRAY | UINT32, (119, 0, 159, 0)),  # supported thumb size
    Property(0xD048, ARRAY | UINT32, BYTES_OF_SIZES),  # average file sizes
    Property(0xD02C, ARRAY | UINT32, (0, 0, 0, 0, 0, 0), False, tuple(size_qualities())),
    Property(0xD030, UINT32, 256),  # remote API version
    Property(0xD049, UINT32, 34144256),  # model id
    Property(0xD032, STRING, MODEL),
    Property(0xD033, ARRAY | UINT8, (), True),  # owner
    Property(0xD031, UINT32, 16777472),  # firmware version
    Property(0xD402, STRING, MODEL),  # friendly name
    Property(0xD406, STRING, "Windows", True),  # session initiator
    Property(0xD407, UINT32, 1),  # perceived device type
)


def shooting(last: int) -> tuple[Property, ...]:
    """Make the properties in shooting mode of a camera whose lens has positions 0 to ``last``."""
    return (
        Property(TRANSFER_MODE, UINT16, 15, True, (1, 2, 3)),
        Property(0xD006, UINT8, 5, True, (5, 3, 2)),  # image quality: superfine, fine, economy
        Property(0xD007, UINT8, 1, False, ()),  # full view file format
        Property(0xD008, UINT8, 0, True, (0, 1, 3, 7, 2)),  # image size: large, medium 1, 2, 3, small
        Property(0xD00E, UINT8, 0, False, ()),  # drive mode
        Property(0xD010, UINT8, 3, True, (3, 0, 1)),  # metering mode
        Property(0xD011, UINT8, 1, True, (1, 3)),  # AF distance
        Property(0xD012, UINT16, 12291, False, ()),  # focusing point
        Property(0xD013, UINT8, 0, True, (0, 1, 2, 3, 4, 7, 5, 6)),  # white balance
        Property(0xD01C, UINT16, 0, True, (0, 69, 72, 80, 88, 96, 104)),  # ISO speed
        Property(0xD01F, UINT8, 24, True, COMPENSATIONS),  # of exposure
        Property(0xD020, UINT8, 24, True, COMPENSATIONS),  # of the flash
        Property(0xD041, UINT16, 1, True, (1, 0)),  # assist light
        Property(0xD042, UINT16, 2, False, ()),  # flash quantity count
        Property(0xD044, UINT16, 0, True, (0, 1)),  # rotation scene
        Property(0xD00A, UINT8, 0, False, ()),  # flash mode
        Property(0xD00C, UINT8, 1, True, (1, 2, 3, 4)),  # shooting mode
        Property(0xD01D, UINT16, 40, False, ()),  # aperture
        Property(0xD01E, UINT16, 112, False, ()),  # shutter speed
        Property(ZOOM, UINT16, 0, True, range(last + DIGITAL + 1)),
        Property(0xD036, UINT8, 3, True, (1, 2, 3)),  # camera output
        Property(0xD037, UINT16, 1),  # Disp Av
        Property(0xD038, UINT16, 27),  # Av open apex
        Property(0xD039, UINT16, 3264),  # digital zoom magnification
        Property(0xD03B, UINT16, 0),  # Disp Av max
        Property(0xD03C, UINT16, 56),  # Av max apex
        Property(0xD03D, UINT16, last + 1),  # EZoom start position
        Property(0xD043, UINT16, 0),  # rotation angle
    )


# The server

# "busy" refuses operations that shoot or set. The camera is unplugged while "gone" is on, and switched off, as by its
# timer, while "power-off" is on. The others are faults of the line.
S5IS_FAULTS = (*LINE_FAULTS, "busy", "gone", "power-off")
GUID = bytes.fromhex("00000000000010008000000085c50148")


class S5isServer(PtpIpServer):
    """The emulated camera on a TCP port, for one initiator at a time; a context manager.

    Args:
        preview: images of the viewfinder.
        still: takes a full-size image now.
        lens: the zoom.
        host: address to listen at.
        port: to listen at; 0 for any free port.
        preview_size: (width, height) of the viewfinder's images, which are scaled by averaging areas [px].
        quality: of JPEG, 1 to 100.
        faults: must know `S5IS_FAULTS`; None for a camera without faults.
        shutter_s: from the request of a still to its exposure, mostly focusing [s].
    """

    def __init__(
        self,
        preview: Feed,
        still: Callable[[], Image],
        lens: LensPlant,
        *,
        host: str = LOCAL,
        port: int = 0,
        preview_size: tuple[int, int] = (320, 240),
        quality: int = 90,
        faults: Faults | None = None,
        shutter_s: float = 0.4,
    ) -> None:
        self.faults = Faults(S5IS_FAULTS) if faults is None else faults
        self._viewfinder = Viewfinder(preview, preview_size, quality)
        self._shutter = Shutter(still, quality, shutter_s)
        self._camera = S5isCamera(self._viewfinder, self._shutter, lens, self.faults, self.send_event)
        super().__init__(self._camera, GUID, MODEL, self.faults, self._is_absent, host, port)

    def close(self) -> None:
        """Close the connections and end every thread."""
        self._viewfinder.switch(False)
        super().close()
        self._shutter.close()

    def _is_absent(self) -> bool:
        if "power-off" in self.faults:
            self._camera.switch_off()
            return True
        if "gone" in self.faults:
            self._camera.unplugged()
            return True
        return False
