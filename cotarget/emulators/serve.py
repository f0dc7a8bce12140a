"""Transports of emulated devices: a pseudo-terminal as a serial port, a TCP port, and a server of JSON lines.

`SerialLine` and `TcpLine` serve an emulated unit, each with one firmware on one thread; a unit on both lines needs two
firmwares in front of the same axes. `Wire` gives every byte its time on the line, ten bits at the baud rate, in each
direction. Times are planned ahead of the clock, so that a thread that wakes late does not slow the line. `JsonLines`
answers one JSON object a line, for the board and for the control port.
"""

import abc
import contextlib
import fcntl
import json
import os
import random
import select
import socket
import socketserver
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Any, Protocol, Self

from cotarget.emulators.faults import Faults
from cotarget.errors import ConfigError, CotargetError, DeviceError

# Bytes on the wire

BITS = 10  # per byte: start, eight, stop
# Most bytes under way to the firmware; beyond that the sender must wait.
BACKLOG = 4096


class Firmware(Protocol):
    """The device behind a line, as `Wire` uses it."""

    faults: Faults

    @property
    def baud(self) -> int:
        """Baud rate of the serial port, from the byte after the last output on."""

    @property
    def byte_delay_s(self) -> float:
        """Pause after each sent byte [s]."""

    def set_baud(self, baud: int) -> None:
        """Set the baud rate of the serial port, for power-up too."""

    def receive(self, data: bytes) -> None:
        """Process bytes that arrive."""

    def output(self) -> bytes:
        """Take the bytes that are to be sent by now."""

    def connected(self) -> None:
        """Handle a new TCP client."""


class Wire:
    """Bytes under way between a firmware and its client, each with the arrival time of its last bit.

    Args:
        firmware: the device.
        paced: whether bytes take time.
    """

    def __init__(self, firmware: Firmware, paced: bool = True) -> None:
        self._firmware = firmware
        self._paced = paced
        self._noise = random.Random(0)
        self._baud = firmware.baud  # baud rate of the firmware's next output
        self._in: deque[tuple[float, int, int | None]] = deque()
        self._out: deque[tuple[float, int, int]] = deque()
        self._in_free = self._out_free = 0.0

    @property
    def room(self) -> int:
        """Number of further bytes that can be under way to the firmware."""
        return max(BACKLOG - len(self._in), 0)

    def feed(self, data: bytes, now: float, baud: int | None = None) -> None:
        """Put bytes from the client on the wire.

        Args:
            data: the bytes.
            now: when they were sent [s].
            baud: the client's baud rate; if it differs from the firmware's, noise arrives. None for the firmware's own.
        """
        for byte in data:
            took = BITS / (baud or self._firmware.baud) if self._paced else 0.0
            self._in_free = max(self._in_free, now) + took
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
        times = [way[0][0] for way in (self._in, self._out) if way]
        return min(times, default=None)

    def clear(self) -> None:
        """Drop the bytes under way, and the firmware's output."""
        self._in.clear()
        self._out.clear()
        self._firmware.output()

    def _collect(self, ready: float) -> None:
        """Put the firmware's output on the wire; a change of its baud rate applies from the next output on."""
        for byte in self._firmware.output():
            took = BITS / self._baud + self._firmware.byte_delay_s if self._paced else 0.0
            self._out_free = max(self._out_free, ready) + took
            self._out.append((self._out_free, byte, self._baud))
        self._baud = self._firmware.baud


# JSON lines

LONGEST_LINE = 65536  # bytes
HEARTBEAT = 0.1  # period of checking whether the server must end [s]


class JsonLines:
    """Server of any number of clients, each on a thread of its own; a context manager.

    Args:
        answer: makes the answer to an object; a `CotargetError`, or an error that a wrong object raises, becomes
            {"error": ...}.
        host: address to listen at.
        port: to listen at; 0 for any free port.

    Raises:
        DeviceError: the address is invalid or in use.
    """

    def __init__(self, answer: Callable[[Any], Any], host: str = "127.0.0.1", port: int = 0) -> None:
        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                while line := self.rfile.readline(LONGEST_LINE):
                    self.wfile.write(json.dumps(_answered(answer, line)).encode() + b"\n")

        try:
            self._server = _Server((host, port), Handler)
        except OSError as error:
            raise DeviceError(f"cannot listen at {host}:{port}: {error.strerror or error}") from None
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(HEARTBEAT,), name=f"JSON lines {self.port}", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Close the port and the connections; may be called again."""
        self._server.shutdown()
        self._server.hang_up()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> "JsonLines":
        """Return the server itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the server."""
        self.close()


class _Server(socketserver.ThreadingTCPServer):
    """TCP server that stores its clients, so that it can close their connections."""

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, *arguments: Any) -> None:
        self._clients: set[Any] = set()
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Store the client and serve it."""
        self._clients.add(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Drop the client and close its connection."""
        self._clients.discard(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a client that is gone."""

    def hang_up(self) -> None:
        """Close every connection."""
        for request in list(self._clients):
            self.shutdown_request(request)


def _answered(answer: Callable[[Any], Any], line: bytes) -> Any:
    try:
        return answer(json.loads(line))
    except CotargetError as error:
        return {"error": str(error)}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        return {"error": f"not understood: {type(error).__name__}: {error}"}


# Lines of a unit

# Period of asking an idle firmware for output, and of checking whether the line closes [s].
TICK_S = 0.005
# A TCP client that reads nothing for this time is dropped [s].
SEND_TIMEOUT_S = 1.0
SPEEDS = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}
CODES = {baud: code for code, baud in SPEEDS.items()}


def _wait(wire: Wire, readers: list[int]) -> list[int]:
    """Wait for input, for the next byte to arrive, or for a tick; return the readable descriptors."""
    due = wire.due()
    timeout = TICK_S if due is None else min(max(due - time.monotonic(), 0.0), TICK_S)
    return select.select(readers, [], [], timeout)[0]


def _baud(slave: int) -> int | None:
    """Return the baud rate that the client has set; None for baud 0, a line that was hung up."""
    return SPEEDS.get(termios.tcgetattr(slave)[5]) or None


class _Line(abc.ABC):
    """Common part of both lines: a thread that serves the unit until the line is closed."""

    def __init__(self, firmware: Firmware, wire: Wire) -> None:
        self._firmware, self._wire = firmware, wire
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=f"d46 {type(self).__name__}", daemon=True)

    def close(self) -> None:
        """End the thread and remove the port."""
        self._closing.set()
        self._thread.join()

    def __enter__(self) -> Self:
        """Return the line itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the line."""
        self.close()

    def _serve(self) -> None:
        while not self._closing.is_set():
            if "unplugged" in self._firmware.faults:
                self._unplug()
                self._firmware.faults.wait_while("unplugged", TICK_S)
            elif self._is_plugged_in():
                self._exchange()
            else:
                self._plug_in()
        self._unplug()

    @abc.abstractmethod
    def _is_plugged_in(self) -> bool:
        """Return whether the port exists."""

    @abc.abstractmethod
    def _plug_in(self) -> None:
        """Make the port."""

    @abc.abstractmethod
    def _unplug(self) -> None:
        """Remove the port; may be called again."""

    @abc.abstractmethod
    def _exchange(self) -> None:
        """Pass on the bytes that are due, and wait for more."""


class SerialLine(_Line):
    """A pseudo-terminal that behaves as a serial port with the unit at its end; a context manager.

    A client with another baud rate than the unit exchanges noise with it. While the fault unplugged is on, the port
    does not exist; afterwards there is one again, possibly with another name.

    Args:
        firmware: the unit.
        baud: set for the unit, as by an earlier `@`; None leaves the unit's. The port has it too, until a client sets
            another.

    Raises:
        ConfigError: there is no such baud rate.
        DeviceError: the machine has no pseudo-terminal left.
    """

    def __init__(self, firmware: Firmware, baud: int | None = None) -> None:
        if baud is not None and baud not in CODES:
            raise ConfigError(f"baud: {baud} is not one of: {', '.join(map(str, sorted(CODES)[1:]))}")
        if baud is not None:
            firmware.set_baud(baud)
        super().__init__(firmware, Wire(firmware))
        self._ends: tuple[int, int] | None = None  # emulator's and client's end; the latter stays open here too,
        self._port = ""  # because without any open client's end the emulator's fails
        try:
            self._plug_in()
        except OSError as error:
            raise DeviceError(f"no pseudo-terminal: {error.strerror}") from None
        self._thread.start()

    @property
    def port(self) -> str:
        """Name of the port; empty while unplugged."""
        return self._port

    def reserve(self) -> bool:
        """Lock the port against programs that lock it too; return False if one has the lock."""
        try:
            if self._ends is not None:
                fcntl.flock(self._ends[1], fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        return True

    def release(self) -> None:
        """Unlock the port."""
        with contextlib.suppress(OSError):  # unplugged meanwhile
            if self._ends is not None:
                fcntl.flock(self._ends[1], fcntl.LOCK_UN)

    def _is_plugged_in(self) -> bool:
        return self._ends is not None

    def _plug_in(self) -> None:
        master, slave = os.openpty()
        tty.setraw(master)
        tty.setraw(slave)
        attributes = termios.tcgetattr(slave)
        attributes[4] = attributes[5] = CODES[self._firmware.baud]
        termios.tcsetattr(slave, termios.TCSANOW, attributes)
        os.set_blocking(master, False)
        self._ends, self._port = (master, slave), os.ttyname(slave)

    def _unplug(self) -> None:
        if self._ends is not None:
            self._port = ""
            for end in self._ends:
                os.close(end)
            self._ends = None
        self._wire.clear()

    def _exchange(self) -> None:
        assert self._ends is not None
        master, slave = self._ends
        arrived = self._wire.step(time.monotonic(), _baud(slave))
        if arrived:
            with contextlib.suppress(BlockingIOError):  # without a reader a serial port loses bytes
                os.write(master, arrived)
        room = self._wire.room
        if master in _wait(self._wire, [master] if room else []):
            with contextlib.suppress(BlockingIOError):
                self._wire.feed(os.read(master, room), time.monotonic(), _baud(slave))


class TcpLine(_Line):
    """A TCP port with the unit behind it, as of a serial device server; a context manager.

    It serves one client at a time. A second client replaces the first, whose connection is closed: a client that
    vanished, such as by a pulled cable, would otherwise block the unit for ever. While the fault unplugged is on, the
    port is closed.

    Args:
        firmware: the unit.
        host: address to listen at; by default this machine only.
        port: to listen at; 0 for any free port.
        paced: whether bytes take their time on the unit's serial line.
        beside: another line to the same unit, which serves only one of the two at a time; None if there is none.

    Raises:
        DeviceError: the address is invalid or in use.
    """

    def __init__(
        self,
        firmware: Firmware,
        host: str = "127.0.0.1",
        port: int = 0,
        paced: bool = False,
        beside: SerialLine | None = None,
    ) -> None:
        super().__init__(firmware, Wire(firmware, paced))
        self._beside = beside
        self._client: socket.socket | None = None
        self.host, self.port = host, port
        try:
            self._listener: socket.socket | None = socket.create_server((host, port), backlog=1)
        except OSError as error:
            raise DeviceError(f"cannot listen at {host}:{port}: {error.strerror}") from None
        self.port = self._listener.getsockname()[1]
        self._thread.start()

    @property
    def url(self) -> str:
        """URL of the port for pyserial and rig.toml."""
        return f"socket://{self.host}:{self.port}"

    def _is_plugged_in(self) -> bool:
        return self._listener is not None

    def _plug_in(self) -> None:
        """Listen at the same port; if another program has it meanwhile, wait a tick."""
        try:
            self._listener = socket.create_server((self.host, self.port), backlog=1)
        except OSError:
            self._closing.wait(TICK_S)

    def _unplug(self) -> None:
        self._drop_client()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
            if self._beside is not None:
                self._beside.release()
        self._wire.clear()

    def _exchange(self) -> None:
        """Pass on the bytes that are due, and wait for more, or for a client."""
        assert self._listener is not None
        arrived = self._wire.step(time.monotonic())
        listener, client, room = self._listener, self._client, self._wire.room
        try:
            if client is not None and arrived:
                client.sendall(arrived)
            readers = [listener.fileno()] + ([client.fileno()] if client is not None and room else [])
            ready = _wait(self._wire, readers)
            if client is not None and client.fileno() in ready:
                data = client.recv(room)
                if not data:
                    self._drop_client()
                self._wire.feed(data, time.monotonic())
        except OSError:  # the client is gone, or reads nothing for longer than SEND_TIMEOUT_S
            self._drop_client()
            return
        if listener.fileno() in ready:
            self._drop_client()
            newcomer = listener.accept()[0]
            if self._beside is not None and not self._beside.reserve():
                newcomer.close()
                return
            self._client = newcomer
            self._client.settimeout(SEND_TIMEOUT_S)
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._firmware.connected()
