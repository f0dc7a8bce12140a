"""The bytes between an emulated unit and its client: each takes its time, ten bits at the baud rate, in each direction.

The times are planned ahead of the clock, so that a thread that wakes late does not slow the line.
"""

import random
from collections import deque
from typing import Protocol

from cotarget.emulators.faults import Faults

BITS = 10  # of a byte: start, eight, stop
# Bytes that wait to be taken by the firmware, beyond which the sender has to wait.
BACKLOG = 4096


class Firmware(Protocol):
    """What a line needs of the device behind it."""

    faults: Faults

    @property
    def baud(self) -> int:
        """Of its serial port, from the byte after the last output on."""

    @property
    def byte_delay_s(self) -> float:
        """Pause after each byte it sends [s]."""

    def set_baud(self, baud: int) -> None:
        """Set its serial port, at power-up too."""

    def receive(self, data: bytes) -> None:
        """Take what comes in."""

    def output(self) -> bytes:
        """What is to be sent by now."""

    def connected(self) -> None:
        """Tell that a TCP client has connected."""


class Wire:
    """The bytes under way between a firmware and its client, each with the time at which its last bit is there.

    Args:
        firmware: the device.
        paced: whether bytes take time.
    """

    def __init__(self, firmware: Firmware, paced: bool = True) -> None:
        self._firmware = firmware
        self._paced = paced
        self._noise = random.Random(0)
        self._baud = firmware.baud  # at which the firmware sends what it gives out next
        self._in: deque[tuple[float, int, int | None]] = deque()
        self._out: deque[tuple[float, int, int]] = deque()
        self._in_free = self._out_free = 0.0

    @property
    def room(self) -> int:
        """How many bytes more can be under way to the firmware."""
        return max(BACKLOG - len(self._in), 0)

    def feed(self, data: bytes, now: float, baud: int | None = None) -> None:
        """Put bytes from the client on the wire.

        Args:
            data: the bytes.
            now: when they were sent [s].
            baud: the client's; at another than the firmware's it hears noise. None for the firmware's own.
        """
        for byte in data:
            took = BITS / (baud or self._firmware.baud) if self._paced else 0.0
            self._in_free = max(self._in_free, now) + took
            self._in.append((self._in_free, byte, baud))

    def step(self, now: float, baud: int | None = None) -> bytes:
        """Let the firmware have what has arrived by now; return what has arrived at the client, whose baud is given."""
        while self._in and self._in[0][0] <= now:
            arrived, byte, sent_at = self._in.popleft()
            agreed = sent_at is None or sent_at == self._firmware.baud
            self._firmware.receive(bytes([byte]) if agreed else self._noise.randbytes(1))
            self._collect(arrived)
        self._collect(now)
        due = bytearray()
        while self._out and self._out[0][0] <= now:
            _, byte, sent_at = self._out.popleft()
            due += bytes([byte]) if baud in (None, sent_at) else self._noise.randbytes(1)
        return bytes(due)

    def due(self) -> float | None:
        """When the next byte arrives at either end [s]; None if none is under way."""
        times = [way[0][0] for way in (self._in, self._out) if way]
        return min(times, default=None)

    def clear(self) -> None:
        """Lose what is under way, and what the firmware has to say."""
        self._in.clear()
        self._out.clear()
        self._firmware.output()

    def _collect(self, ready: float) -> None:
        """Put on the wire what the firmware says; a change of its baud holds from the next output on."""
        for byte in self._firmware.output():
            took = BITS / self._baud + self._firmware.byte_delay_s if self._paced else 0.0
            self._out_free = max(self._out_free, ready) + took
            self._out.append((self._out_free, byte, self._baud))
        self._baud = self._firmware.baud
