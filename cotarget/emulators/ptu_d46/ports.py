"""Ports of the emulated PTU-D46: a pseudo-terminal and TCP, served by one thread.

`Wire` gives every byte its time on the serial line, ten bits at the baud rate, in each direction. Times are planned
ahead of the clock, so that a thread that wakes late does not slow the line.
"""

import contextlib
import os
import select
import socket
import threading
import time
import tty
from collections import deque

from cotarget.emulators.ptu_d46.firmware import D46
from cotarget.emulators.serve import LOCAL, Closes, open_listener
from cotarget.errors import DeviceError

BYTE_S = 10 / 9600  # time of a byte, start, eight bits and stop, at the factory setting of the line [s]
TICK_S = 0.005  # period of asking an idle firmware for output, and of checking whether the ports close [s]
RECEIVE = 4096  # bytes
SEND_TIMEOUT_S = 1.0  # a TCP client that reads nothing for this time is dropped [s]


class Wire:
    """Bytes under way between a firmware and its client, each with the arrival time of its last bit."""

    def __init__(self, firmware: D46) -> None:
        self._firmware = firmware
        self._in: deque[tuple[float, int]] = deque()
        self._out: deque[tuple[float, int]] = deque()
        self._in_free = self._out_free = 0.0

    def feed(self, data: bytes, now: float) -> None:
        """Put bytes from the client on the wire now [s]."""
        for byte in data:
            self._in_free = max(self._in_free, now) + BYTE_S
            self._in.append((self._in_free, byte))

    def step(self, now: float) -> bytes:
        """Pass to the firmware the bytes that have arrived; return those that have arrived at the client."""
        while self._in and self._in[0][0] <= now:
            arrived, byte = self._in.popleft()
            self._firmware.receive(bytes([byte]))
            self._collect(arrived)
        self._collect(now)
        due = bytearray()
        while self._out and self._out[0][0] <= now:
            due.append(self._out.popleft()[1])
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
            self._out_free = max(self._out_free, ready) + BYTE_S
            self._out.append((self._out_free, byte))


class UnitPorts(Closes):
    """The ports of a unit, which serve one program at a time; a context manager.

    The TCP port is as of a serial device server. While it has a client, the pseudo-terminal is not served. A second
    client replaces the first, because one that vanished, such as by a pulled cable, would otherwise block the unit for
    ever. While the fault unplugged is on, there are no ports; afterwards the pseudo-terminal may have another name.

    Args:
        firmware: the unit.
        tcp: TCP port to listen at, 0 for any free one.
        host: address to listen at.

    Raises:
        DeviceError: the address is invalid or in use, or the machine has no pseudo-terminal left.
    """

    def __init__(self, firmware: D46, *, tcp: int = 0, host: str = LOCAL) -> None:
        self._firmware, self._wire = firmware, Wire(firmware)
        self._ends: tuple[int, int] | None = None  # emulator's and client's end; the latter stays open here too,
        self.port = ""  # because without any open client's end the emulator's fails
        self._listener: socket.socket | None = open_listener(host, tcp)
        self._address = host, int(self._listener.getsockname()[1])
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
        self._listener = self._listener or open_listener(*self._address)
        master, slave = os.openpty()
        tty.setraw(master)
        tty.setraw(slave)
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
        if arrived := self._wire.step(time.monotonic()):
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
                        self._wire.feed(data, time.monotonic())

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
