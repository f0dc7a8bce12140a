"""What a Canon PowerShot S5 IS answers to each operation of PTP, whatever brings the operations to it.

What is not known of the real camera is chosen so that a driver that works with this one expects little; `s5is` tells.
"""

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable

from cotarget.emulators.faults import Faults
from cotarget.emulators.plant import LensPlant
from cotarget.emulators.ptp import (
    UINT32,
    Answer,
    Code,
    DeviceInfo,
    ObjectInfo,
    Property,
    PtpError,
    Value,
    array,
    decode,
    encode,
    storage_info,
)
from cotarget.emulators.s5is_pictures import THUMB_SIZE, Exposure, Shutter, Viewfinder
from cotarget.emulators.s5is_tables import (
    ALWAYS,
    EVENT_EMULATE_MODE,
    EVENTS,
    EXTENSION,
    FORMATS,
    MAKER,
    MODEL,
    OPERATIONS,
    SERIAL,
    UNIX_TIME,
    VERSION,
    ZOOM,
    shooting,
)

MEMORY = 0x80000001  # the storage that is no card
FIRST_HANDLE = 0x81000000
ALREADY_SO, REFUSED = 0xA009, 0xA005  # Canon's response codes: in that mode already; operation refused
OBJECT_TRANSFER, MODE_CHANGED, CAPTURE_COMPLETE = 0xC009, 0xC00C, 0x400D  # events
INTERRUPTING, CHECKED = (1, 2, 3, 4, 5), (3, 4, 5, 7)  # modes of event emulation, by how the events come
EVENT_CONTAINER = 4  # its type in PTP over USB, whose layout CheckEvent uses
INFO, OPEN, CLOSE, SET_VALUE, RESET_VALUE = 0x1001, 0x1002, 0x1003, 0x1016, 0x1017
START_SHOOTING, END_SHOOTING, VIEWFINDER_ON, VIEWFINDER_OFF = 0x9008, 0x9009, 0x900B, 0x900C
CAPTURE, VIEWFINDER_IMAGE, FOCUS_LOCK, FOCUS_UNLOCK = 0x901A, 0x901D, 0x9014, 0x9015
SHOOTING_ONLY = frozenset((VIEWFINDER_ON, VIEWFINDER_OFF, CAPTURE, VIEWFINDER_IMAGE, FOCUS_LOCK, FOCUS_UNLOCK))
# What a busy camera refuses; it still tells what it is and what happened.
NOT_WHEN_BUSY = SHOOTING_ONLY | {SET_VALUE, RESET_VALUE, START_SHOOTING, END_SHOOTING}
OK = Answer()


class S5isCamera:
    """The camera; safe from any thread.

    Args:
        viewfinder: its live pictures.
        shutter: its stills.
        lens: its zoom.
        faults: which are on; of them "busy" is its own affair.
    """

    def __init__(self, viewfinder: Viewfinder, shutter: Shutter, lens: LensPlant, faults: Faults) -> None:
        self._viewfinder, self._shutter, self._lens, self._faults = viewfinder, shutter, lens, faults
        self._interrupt: Callable[[int, Iterable[int]], None] = lambda code, parameters: None
        self._lock = threading.RLock()
        self._playing = {prop.code: prop for prop in ALWAYS}
        self._all = self._playing | {prop.code: prop for prop in shooting(lens.last)}
        self._handle = FIRST_HANDLE
        self._reset()
        self._values[ZOOM] = lens.position()
        self._operations: dict[int, Callable[[tuple[int, ...], bytes], Answer]] = {
            0x1004: lambda words, data: Answer(data=array([MEMORY], UINT32)),  # storages
            0x1005: self._storage,
            0x1006: lambda words, data: Answer(parameters=(0,)),  # objects; what lies in memory is not listed
            0x1007: lambda words, data: Answer(data=array([], UINT32)),
            0x1008: lambda words, data: self._of_still(words[0], self._still_info),
            0x1009: lambda words, data: self._of_still(words[0], lambda still: still.jpeg),
            0x100A: lambda words, data: self._of_still(words[0], lambda still: still.thumb),
            0x100B: self._delete,
            0x1014: self._describe,
            0x1015: self._value,
            SET_VALUE: self._set,
            RESET_VALUE: self._set_default,
            0x101B: self._part,
            START_SHOOTING: lambda words, data: self._shoot(True),
            END_SHOOTING: lambda words, data: self._shoot(False),
            VIEWFINDER_ON: lambda words, data: self._look(True),
            VIEWFINDER_OFF: lambda words, data: self._look(False),
            0x9013: lambda words, data: Answer(data=self._events.popleft() if self._events else b""),
            FOCUS_LOCK: lambda words, data: OK,
            FOCUS_UNLOCK: lambda words, data: OK,
            CAPTURE: self._capture,
        }

    def interrupt_by(self, send_event: Callable[[int, Iterable[int]], None]) -> None:
        """Have events brought to the initiator at once, as code and parameters, where its mode is such."""
        self._interrupt = send_event

    def operate(self, code: int, parameters: tuple[int, ...], data: bytes) -> Answer:
        """Do an operation."""
        with self._lock:
            if code == INFO:
                return Answer(data=self._info())
            if code == OPEN:
                return self._open(parameters[0])
            if not self._session:
                return Answer(Code.SESSION_NOT_OPEN)
            if code == CLOSE:
                self.disconnected()
                return OK
            if code in NOT_WHEN_BUSY and (self._exposure is not None or "busy" in self._faults):
                return Answer(Code.DEVICE_BUSY)
            if code in SHOOTING_ONLY and not self._shooting:
                return Answer(REFUSED)
            if code in self._operations:
                return self._operations[code](parameters, data)
        if code == VIEWFINDER_IMAGE:  # waits, and must not hold up a power-off meanwhile
            image = self._viewfinder.image()
            return Answer(Code.DEVICE_BUSY) if image is None else Answer(parameters=(len(image),), data=image)
        return Answer(Code.OPERATION_NOT_SUPPORTED)

    def disconnected(self) -> None:
        """Close the session; the camera goes on shooting, with its viewfinder off."""
        with self._lock:
            self._session = 0
            self._look(False)

    def unplugged(self) -> None:
        """Go back to play mode, as it does without a computer."""
        with self._lock:
            self.disconnected()
            self._shooting = False

    def switch_off(self) -> None:
        """Forget settings and stills, and draw the lens in."""
        with self._lock:
            self._reset()
        self._lens.command(0)

    def _reset(self) -> None:
        self._session = 0
        self._shooting = False
        self._look(False)
        self._exposure: object | None = None  # the still under way
        self._taken: tuple[int, Exposure, str] | None = None  # handle, still, date
        self._events: deque[bytes] = deque()
        self._clock_offset = 0  # seconds by which its clock was set
        self._values: dict[int, Value] = {code: prop.default for code, prop in self._all.items()}

    def _properties(self) -> dict[int, Property]:
        return self._all if self._shooting else self._playing

    def _info(self) -> bytes:
        codes = tuple(self._properties())
        return DeviceInfo(EXTENSION, OPERATIONS, EVENTS, codes, FORMATS, MAKER, MODEL, VERSION, SERIAL).pack()

    def _open(self, session: int) -> Answer:
        if self._session:
            return Answer(Code.SESSION_ALREADY_OPEN, (self._session,))
        if session == 0:
            return Answer(Code.INVALID_PARAMETER)
        self._session = session
        self._events.clear()
        return OK

    def _storage(self, words: tuple[int, ...], _: bytes) -> Answer:
        return Answer(data=storage_info("V")) if words[0] == MEMORY else Answer(Code.INVALID_STORAGE)

    def _describe(self, words: tuple[int, ...], _: bytes) -> Answer:
        prop = self._properties().get(words[0])
        return Answer(Code.PROPERTY_NOT_SUPPORTED) if prop is None else Answer(data=prop.describe(self._now(prop)))

    def _value(self, words: tuple[int, ...], _: bytes) -> Answer:
        prop = self._properties().get(words[0])
        return Answer(Code.PROPERTY_NOT_SUPPORTED) if prop is None else Answer(data=encode(prop.kind, self._now(prop)))

    def _now(self, prop: Property) -> Value:
        return int(time.time()) + self._clock_offset if prop.code == UNIX_TIME else self._values[prop.code]

    def _set(self, words: tuple[int, ...], data: bytes) -> Answer:
        prop = self._properties().get(words[0])
        if prop is None:
            return Answer(Code.PROPERTY_NOT_SUPPORTED)
        if not prop.writable:
            return Answer(Code.ACCESS_DENIED)
        try:
            value = decode(prop.kind, data)
        except PtpError:
            return Answer(Code.INVALID_PROPERTY_FORMAT)
        return self._assign(prop, value) if prop.allows(value) else Answer(Code.INVALID_PROPERTY_VALUE)

    def _set_default(self, words: tuple[int, ...], _: bytes) -> Answer:
        prop = self._properties().get(words[0])
        if prop is None:
            return Answer(Code.PROPERTY_NOT_SUPPORTED)
        return self._assign(prop, prop.default) if prop.writable else Answer(Code.ACCESS_DENIED)

    def _assign(self, prop: Property, value: Value) -> Answer:
        self._values[prop.code] = value
        if prop.code == UNIX_TIME and isinstance(value, int):
            self._clock_offset = value - int(time.time())
        if prop.code == ZOOM and isinstance(value, int):
            self._lens.command(min(value, self._lens.last))
        return OK

    def _shoot(self, on: bool) -> Answer:
        if on == self._shooting:
            return Answer(ALREADY_SO)
        self._shooting = on
        self._look(False)
        self._happen(MODE_CHANGED)
        return OK

    def _look(self, on: bool) -> Answer:
        self._viewfinder.switch(on)
        return OK

    def _capture(self, _: tuple[int, ...], __: bytes) -> Answer:
        # The viewfinder is blind until the still is taken: whatever it shows next was exposed after it.
        live = self._viewfinder.on
        self._look(False)
        exposure = self._exposure = object()
        self._shutter.release(lambda taken: self._keep(exposure, taken, live))
        return OK

    def _keep(self, exposure: object, taken: Exposure | None, live: bool) -> None:
        with self._lock:
            if exposure is not self._exposure:  # it was switched off meanwhile
                return
            self._exposure = None
            self._look(live and bool(self._session))
            if taken is not None:
                self._handle += 1
                self._taken = self._handle, taken, time.strftime("%Y%m%dT%H%M%S")
                self._happen(OBJECT_TRANSFER, self._handle)
            self._happen(CAPTURE_COMPLETE)

    def _happen(self, code: int, *parameters: int) -> None:
        mode = self._values[EVENT_EMULATE_MODE]
        if mode in CHECKED:
            length = 12 + 4 * len(parameters)
            head = struct.pack("<IHHI", length, EVENT_CONTAINER, code, 0)
            self._events.append(head + struct.pack(f"<{len(parameters)}I", *parameters))
        if mode in INTERRUPTING:
            self._interrupt(code, parameters)

    def _of_still(self, handle: int, part: Callable[[Exposure], bytes]) -> Answer:
        if self._taken is None or self._taken[0] != handle:
            return Answer(Code.INVALID_HANDLE)
        return Answer(data=part(self._taken[1]))

    def _still_info(self, still: Exposure) -> bytes:
        assert self._taken is not None
        name = f"IMG_{self._handle - FIRST_HANDLE:04d}.JPG"
        date = self._taken[2]
        return ObjectInfo(MEMORY, len(still.jpeg), still.size, len(still.thumb), THUMB_SIZE, name, date).pack()

    def _part(self, words: tuple[int, ...], _: bytes) -> Answer:
        answer = self._of_still(words[0], lambda still: still.jpeg[words[1] :][: words[2]])
        return answer if answer.data is None else Answer(parameters=(len(answer.data),), data=answer.data)

    def _delete(self, words: tuple[int, ...], _: bytes) -> Answer:
        answer = self._of_still(words[0], lambda still: b"")
        self._taken = None if answer.data is not None else self._taken
        return Answer(answer.code)
