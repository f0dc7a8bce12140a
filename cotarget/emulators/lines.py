"""What an emulated pan-tilt unit is reached by: a pseudo-terminal in place of a serial line, and a TCP port.

Each line serves one firmware from one thread of its own; a unit that is to be on both needs two firmwares in front of
the same axes.
"""

import abc
import contextlib
import fcntl
import os
import select
import socket
import termios
import threading
import time
import tty
from types import TracebackType
from typing import Self

from cotarget.emulators.d46_wire import Firmware, Wire
from cotarget.errors import ConfigError, DeviceError

# How often a firmware that is told nothing is asked for what it says by itself, and a close is noticed [s].
TICK_S = 0.005
# A TCP client that reads nothing for so long is dropped [s].
SEND_TIMEOUT_S = 1.0
SPEEDS = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}
CODES = {baud: code for code, baud in SPEEDS.items()}


def _wait(wire: Wire, readers: list[int]) -> list[int]:
    """Wait for something to read, for the next byte to arrive, or for a tick; return what can be read."""
    due = wire.due()
    timeout = TICK_S if due is None else min(max(due - time.monotonic(), 0.0), TICK_S)
    return select.select(readers, [], [], timeout)[0]


def _baud(slave: int) -> int | None:
    """What the client has set; None on a line that was hung up, which is baud 0."""
    return SPEEDS.get(termios.tcgetattr(slave)[5]) or None


class _Line(abc.ABC):
    """What both kinds of line have in common: a thread that serves the unit from when it is started to the close."""

    def __init__(self, firmware: Firmware, wire: Wire) -> None:
        self._firmware, self._wire = firmware, wire
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=f"d46 {type(self).__name__}", daemon=True)

    def close(self) -> None:
        """Take the port away."""
        self._closing.set()
        self._thread.join()

    def __enter__(self) -> Self:
        """Give the line itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Take the port away."""
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
        """Whether the port is there."""

    @abc.abstractmethod
    def _plug_in(self) -> None:
        """Let the port be there."""

    @abc.abstractmethod
    def _unplug(self) -> None:
        """Let it be there no longer; more than once does no harm."""

    @abc.abstractmethod
    def _exchange(self) -> None:
        """Pass on what is due, and wait for more."""


class SerialLine(_Line):
    """A pseudo-terminal that behaves as a serial port with the firmware's unit at its end; a context manager.

    A client that sets another baud than the unit's exchanges noise with it. While the fault unplugged is on, the port
    is gone; afterwards there is one again, maybe under another name.

    Args:
        firmware: the unit.
        baud: to set the unit to, as if `@` had done so before; None leaves it as it is. The port is there with it too,
            until a client sets another.

    Raises:
        ConfigError: there is no such baud.
        DeviceError: the machine has no pseudo-terminal left.
    """

    def __init__(self, firmware: Firmware, baud: int | None = None) -> None:
        if baud is not None and baud not in CODES:
            raise ConfigError(f"baud: {baud} is not one of: {', '.join(map(str, sorted(CODES)[1:]))}")
        if baud is not None:
            firmware.set_baud(baud)
        super().__init__(firmware, Wire(firmware))
        self._ends: tuple[int, int] | None = None  # the emulator's and the client's; ours of the latter stays open,
        self._port = ""  # or the former would fail whenever no client has it open
        try:
            self._plug_in()
        except OSError as error:
            raise DeviceError(f"no pseudo-terminal: {error.strerror}") from None
        self._thread.start()

    @property
    def port(self) -> str:
        """Name of the port to open; empty while unplugged."""
        return self._port

    def reserve(self) -> bool:
        """Keep programs that lock the port from opening it, unless one has; whether none has."""
        try:
            if self._ends is not None:
                fcntl.flock(self._ends[1], fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        return True

    def release(self) -> None:
        """Let programs open the port again."""
        with contextlib.suppress(OSError):  # unplugged just now
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
            with contextlib.suppress(BlockingIOError):  # nobody reads: a serial port loses bytes then
                os.write(master, arrived)
        room = self._wire.room
        if master in _wait(self._wire, [master] if room else []):
            with contextlib.suppress(BlockingIOError):
                self._wire.feed(os.read(master, room), time.monotonic(), _baud(slave))


class TcpLine(_Line):
    """A TCP port with the firmware's unit behind it, as of a serial device server; a context manager.

    One client at a time. A second takes the first one's place, because a client that vanished without a word, its cable
    pulled, would keep the unit for ever otherwise; the first finds its connection closed. While the fault unplugged is
    on, nobody listens.

    Args:
        firmware: the unit.
        host: address to listen at; this machine only by default.
        port: to listen at; 0 for a free one.
        paced: whether bytes take the time that they would take on the unit's serial line.
        beside: another line to the same unit, which serves either; None where there is none.

    Raises:
        DeviceError: the address cannot be listened at.
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
        """How pyserial and a rig's config name it."""
        return f"socket://{self.host}:{self.port}"

    def _is_plugged_in(self) -> bool:
        return self._listener is not None

    def _plug_in(self) -> None:
        """Listen at the same port; if another has taken it meanwhile, wait for it."""
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
        """Also waits for a client."""
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
