"""Transports of emulated devices: TCP servers, JSON lines, and the ports of a unit on a serial line.

`TcpServer` serves each connection on a thread of its own. `UnitPorts` serves a firmware on a pseudo-terminal, on TCP or
on both, by one thread. `Wire` gives every byte its time on the serial line, ten bits at the baud rate, in each
direction. Times are planned ahead of the clock, so that a thread that wakes late does not slow the line.
"""

import contextlib
import json
import os
import random
import select
import socket
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol, Self

from cotarget.emulators.faults import Faults
from cotarget.errors import CotargetError, DeviceError

LOCAL, HIGHEST_PORT = "127.0.0.1", 65535


def open_listener(host: str, port: int) -> socket.socket:
    """Open a listening socket.

    Raises:
        DeviceError: the address is invalid or in use.
    """
    if not 0 <= port <= HIGHEST_PORT:
        raise DeviceError(f"cannot listen at {host}:{port}: a port is a number from 0 to {HIGHEST_PORT}")
    try:
        return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        reason = (error.strerror or str(error)).partition(" (")[0]
        raise DeviceError(f"cannot listen at {host}:{port}: {reason}") from None


# TCP servers

CHECK_S = 0.05  # period of checking whether the device is absent or the server closes [s]


class TcpServer:
    """A TCP server that serves each connection on a thread of its own; a context manager.

    Args:
        serve: serves a connection, which is closed afterwards; an OSError ends it.
        host: address to listen at.
        port: to listen at; 0 for any free port.
        absent: returns whether the device is unplugged now, which closes the port; called every `CHECK_S`.

    Attributes:
        closing: set when the server closes; long waits in ``serve`` must end then.

    Raises:
        DeviceError: the address is invalid or in use.
    """

    def __init__(
        self,
        serve: Callable[[socket.socket], None],
        host: str = LOCAL,
        port: int = 0,
        absent: Callable[[], bool] = lambda: False,
    ) -> None:
        self._serve, self._absent = serve, absent
        self._listener: socket.socket | None = open_listener(host, port)
        self.host, self.port = host, int(self._listener.getsockname()[1])
        self.closing = threading.Event()
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._threads: list[threading.Thread] = []
        self._acceptor = threading.Thread(target=self._accept, name=f"port {self.port}", daemon=True)
        self._acceptor.start()

    def close(self) -> None:
        """Close the port and the connections, and wait for the threads; may be called again."""
        self.closing.set()
        self._acceptor.join()
        self._disconnect()
        for thread in self._threads:
            thread.join()

    def __enter__(self) -> Self:
        """Return the server itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the server."""
        self.close()

    def _accept(self) -> None:
        while not self.closing.is_set():
            if self._absent():
                self._disconnect()
                self.closing.wait(CHECK_S)
                continue
            try:
                self._listener = self._listener or open_listener(self.host, self.port)
            except DeviceError:  # another program has the port for now
                self.closing.wait(CHECK_S)
                continue
            self._listener.settimeout(CHECK_S)
            with contextlib.suppress(OSError):  # no client in time, or it is gone already
                self._start(self._listener.accept()[0])

    def _start(self, connection: socket.socket) -> None:
        connection.settimeout(None)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._lock:
            self._open.add(connection)
        thread = threading.Thread(target=self._run, args=(connection,), name=f"client {self.port}", daemon=True)
        self._threads = [*(other for other in self._threads if other.is_alive()), thread]
        thread.start()

    def _run(self, connection: socket.socket) -> None:
        try:
            with contextlib.suppress(OSError):  # the client is gone
                self._serve(connection)
        finally:
            with self._lock:
                self._open.discard(connection)
                connection.close()

    def _disconnect(self) -> None:
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        with self._lock:
            for connection in self._open:
                with contextlib.suppress(OSError):  # the client is gone
                    connection.shutdown(socket.SHUT_RDWR)


LONGEST_LINE = 65536  # of JSON lines [bytes]


class JsonLines(TcpServer):
    """Server of JSON lines, one object each; a context manager.

    Args:
        answer: makes the answer to an object; a `CotargetError`, or an error that a wrong object raises, becomes
            {"error": ...}.
        host: address to listen at.
        port: to listen at; 0 for any free port.

    Raises:
        DeviceError: the address is invalid or in use.
    """

    def __init__(self, answer: Callable[[Any], Any], host: str = LOCAL, port: int = 0) -> None:
        self._answer = answer
        super().__init__(self._serve_lines, host, port)

    def _serve_lines(self, connection: socket.socket) -> None:
        with connection.makefile("rb") as lines:
            while line := lines.readline(LONGEST_LINE):
                connection.sendall(json.dumps(self._answered(line)).encode() + b"\n")

    def _answered(self, line: bytes) -> Any:
        try:
            return self._answer(json.loads(line))
        except CotargetError as error:
            return {"error": str(error)}
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            return {"error": f"not understood: {type(error).__name__}: {error}"}


# The serial line

BITS = 10  # of a byte: start, eight, stop


class Firmware(Protocol):
    """The device behind a serial line."""

    faults: Faults

    @property
    def baud(self) -> int:
        """Baud rate of the serial port, from the byte after the last output on."""

    @property
    def byte_delay_s(self) -> float:
        """Pause after each sent byte [s]."""

    def receive(self, data: bytes) -> None:
        """Process bytes that arrive."""

    def output(self) -> bytes:
        """Take the bytes that are to be sent by now."""

    def connected(self) -> None:
        """Handle a new TCP client."""


class Wire:
    """Bytes under way between a firmware and its client, each with the arrival time of its last bit."""

    def __init__(self, firmware: Firmware) -> None:
        self._firmware = firmware
        self._noise = random.Random(0)
        self._baud = firmware.baud  # of the firmware's next output
        self._in: deque[tuple[float, int, int | None]] = deque()
        self._out: deque[tuple[float, int, int]] = deque()
        self._in_free = self._out_free = 0.0

    def feed(self, data: bytes, now: float, baud: int | None = None) -> None:
        """Put bytes from the client on the wire now [s].

        If the client's baud rate differs from the firmware's, noise arrives; None is the firmware's own.
        """
        for byte in data:
            self._in_free = max(self._in_free, now) + BITS / (baud or self._firmware.baud)
            self._in.append((self._in_free, byte, baud))

    def step(self, now: float, baud: int | None = None) -> bytes:
        """Pass to the firmware the bytes that have arrived; return those at a client with this baud rate."""
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
        """Return when the next byte arrives at either end [s]; None if none is under way."""
        return min((way[0][0] for way in (self._in, self._out) if way), default=None)

    def clear(self) -> None:
        """Drop the bytes under way, and the firmware's output."""
        self._in.clear()
        self._out.clear()
        self._firmware.output()

    def _collect(self, ready: float) -> None:
        """Put the firmware's output on the wire; a change of its baud rate applies from the next output on."""
        for byte in self._firmware.output():
            self._out_free = max(self._out_free, ready) + BITS / self._baud + self._firmware.byte_delay_s
            self._out.append((self._out_free, byte, self._baud))
        self._baud = self._firmware.baud


# Ports of a unit

TICK_S = 0.005  # period of asking an idle firmware for output, and of checking whether the ports close [s]
RECEIVE = 4096  # bytes
SEND_TIMEOUT_S = 1.0  # a TCP client that reads nothing for this time is dropped [s]
SPEEDS = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}
CODES = {baud: code for code, baud in SPEEDS.items()}


class UnitPorts:
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

    def __init__(self, firmware: Firmware, *, serial: bool = True, tcp: int | None = None, host: str = LOCAL) -> None:
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

    def __enter__(self) -> Self:
        """Return the ports themselves."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the ports."""
        self.close()

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
        attributes[4] = attributes[5] = CODES[self._firmware.baud]
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
            self._firmware.connected()

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
            self._wire.clear()
