"""Ports of the emulated PTU-D46: a pseudo-terminal, TCP, or both, served by one thread.

`Wire` gives every byte its time on the serial line, ten bits at the baud rate, in each direction. Times are planned
ahead of the clock, so that a thread that wakes late does not slow the line.
"""

import contextlib
import os
import random
import select
import socket
import termios
import threading
import time
import tty
from collections import deque

from cotarget.emulators.ptu_d46.firmware import D46
from cotarget.emulators.serve import LOCAL, Closes, open_listener
from cotarget.errors import DeviceError

BAUD, BITS = 9600, 10  # factory setting of the line; bits of a byte: start, eight, stop
TICK_S = 0.005  # period of asking an idle firmware for output, and of checking whether the ports close [s]
RECEIVE = 4096  # bytes
SEND_TIMEOUT_S = 1.0  # a TCP client that reads nothing for this time is dropped [s]
SPEEDS = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}


class Wire:
    """Bytes under way between a firmware and its client, each with the arrival time of its last bit."""

    def __init__(self, firmware: D46) -> None:
        self._firmware = firmware
        self._noise = random.Random(0)
        self._in: deque[tuple[float, int, int | None]] = deque()
        self._out: deque[tuple[float, int]] = deque()
        self._in_free = self._out_free = 0.0

    def feed(self, data: bytes, now: float, baud: int | None = None) -> None:
        """Put bytes from the client on the wire now [s].

        If the client's baud rate differs from the unit's, noise arrives; None is the unit's own.
        """
        for byte in data:
            self._in_free = max(self._in_free, now) + BITS / (baud or BAUD)
            self._in.append((self._in_free, byte, baud))

    def step(self, now: float, baud: int | None = None) -> bytes:
        """Pass to the firmware the bytes that have arrived; return those at a client with this baud rate."""
        while self._in and self._in[0][0] <= now:
            arrived, byte, sent_at = self._in.popleft()
            self._firmware.receive(bytes([byte]) if sent_at in (None, BAUD) else self._noise.randbytes(1))
            self._collect(arrived)
        self._collect(now)
        due = bytearray()
        while self._out and self._out[0][0] <= now:
            _, byte = self._out.popleft()
            due += bytes([byte]) if baud in (None, BAUD) else self._noise.randbytes(1)
        return bytes(due)

    def due(self) -> float | None:
        """Return when the next byte arrives at either end [s]; None if none is under way."""
        return min((way[0][0] for way in (self._in, self._out) if way), default=None)

    def clear(self) -> None:
        """Drop the bytes under way, and the firmware's output."""
        self._in.clear()
        self._out.clear()
        self._firmware.output()

    def _collect(self, ready: float) -> None:
        """Put the firmware's output on the wire."""
        for byte in self._firmware.output():
            self._out_free = max(self._out_free, ready) + BITS / BAUD
            self._out.append((self._out_free, byte))


class UnitPorts(Closes):
    """The ports of a unit, which serve one program at a time; a context manager.

    The pseudo-terminal behaves as a serial port: a client with another baud rate than the unit exchanges noise with it.
    The TCP port is as of a serial device server. While it has a client, the pseudo-terminal is not served. A second
    client replaces the first, because one that vanished, such as by a pulled cable, would otherwise block the unit for
    ever. While the fault unplugged is on, there are no ports; afterwards the pseudo-terminal may have another name.

    Args:
        firmware: the unit.
        serial: whether there is a pseudo-terminal.
        tcp: TCP port to listen at, 0 for any free one; None for none.
        host: address to listen at.

    Raises:
        DeviceError: the address is invalid or in use, or the machine has no pseudo-terminal left.
    """

    def __init__(self, firmware: D46, *, serial: bool = True, tcp: int | None = None, host: str = LOCAL) -> None:
        self._firmware, self._wire, self._serial = firmware, Wire(firmware), serial
        self._ends: tuple[int, int] | None = None  # emulator's and client's end; the latter stays open here too,
        self.port = ""  # because without any open client's end the emulator's fails
        self._listener = None if tcp is None else open_listener(host, tcp)
        self._address = None if self._listener is None else (host, int(self._listener.getsockname()[1]))
        self._client: socket.socket | None = None
        try:
            self._plug_in()
        except OSError as error:
            self._unplug()
            raise DeviceError(f"no pseudo-terminal: {error.strerror}") from None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="unit ports", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """URL of the TCP port for pyserial and rig.toml."""
        assert self._address is not None
        return "socket://{}:{}".format(*self._address)

    def close(self) -> None:
        """End the thread and remove the ports."""
        self._closing.set()
        self._thread.join()

    def _serve(self) -> None:
        plugged = True
        while not self._closing.is_set():
            if "unplugged" in self._firmware.faults:
                self._unplug()
                plugged = False
                self._firmware.faults.wait_while("unplugged", TICK_S)
            elif plugged:
                self._exchange()
            else:
                with contextlib.suppress(OSError, DeviceError):  # another program has the port for now
                    self._plug_in()
                    plugged = True
        self._unplug()

    def _plug_in(self) -> None:
        if self._address is not None and self._listener is None:
            self._listener = open_listener(*self._address)
        if not self._serial:
            return
        master, slave = os.openpty()
        tty.setraw(master)
        tty.setraw(slave)
        attributes = termios.tcgetattr(slave)
        attributes[4] = attributes[5] = termios.B9600
        termios.tcsetattr(slave, termios.TCSANOW, attributes)
        os.set_blocking(master, False)
        self._ends, self.port = (master, slave), os.ttyname(slave)

    def _unplug(self) -> None:
        self._drop_client()
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        if self._ends is not None:
            self.port = ""
            for end in self._ends:
                os.close(end)
            self._ends = None
        self._wire.clear()

    def _exchange(self) -> None:
        """Pass on the bytes that are due, and wait for more, or for a client."""
        now, baud = time.monotonic(), self._baud()
        if arrived := self._wire.step(now, baud):
            self._send(arrived)
        due = self._wire.due()
        timeout = TICK_S if due is None else min(max(due - time.monotonic(), 0.0), TICK_S)
        sources = (self._listener, self._client, None if self._ends is None else self._ends[0])
        for source in select.select([source for source in sources if source is not None], [], [], timeout)[0]:
            if source is self._listener:
                self._accept_client()
            elif source is self._client:
                self._receive()
            elif self._ends is not None and source == self._ends[0]:
                with contextlib.suppress(BlockingIOError):
                    data = os.read(source, RECEIVE)
                    if self._client is None:
                        self._wire.feed(data, time.monotonic(), self._baud())

    def _baud(self) -> int | None:
        """Return the baud rate that the program at the pseudo-terminal has set; None for a line without one."""
        if self._client is not None or self._ends is None:
            return None
        return SPEEDS.get(termios.tcgetattr(self._ends[1])[5]) or None

    def _send(self, data: bytes) -> None:
        if self._client is not None:
            try:
                self._client.sendall(data)
            except OSError:  # the client is gone, or reads nothing
                self._drop_client()
        elif self._ends is not None:
            with contextlib.suppress(BlockingIOError):  # without a reader a serial port loses bytes
                os.write(self._ends[0], data)

    def _receive(self) -> None:
        assert self._client is not None
        try:
            data = self._client.recv(RECEIVE)
        except OSError:
            data = b""
        if data:
            self._wire.feed(data, time.monotonic())
        else:
            self._drop_client()

    def _accept_client(self) -> None:
        assert self._listener is not None
        self._drop_client()
        with contextlib.suppress(OSError):  # the client is gone already
            self._client = self._listener.accept()[0]
            self._client.settimeout(SEND_TIMEOUT_S)
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
            self._wire.clear()
