"""What emulated devices share: faults that can be switched on, TCP servers, and JSON lines.

`TcpServer` serves each connection on a thread of its own.
"""

import contextlib
import json
import socket
import threading
from collections.abc import Callable, Iterable
from typing import Any, Self

from cotarget.errors import ConfigError, CotargetError, DeviceError, choices

LOCAL, HIGHEST_PORT = "127.0.0.1", 65535


class Closes:
    """What is closed at the end of a with block."""

    def close(self) -> None:
        """Release what is held; may be called again."""

    def __enter__(self) -> Self:
        """Return the object itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the object."""
        self.close()


class Faults:
    """The active faults of a device; safe to use from any thread.

    Args:
        known: names of all faults that the device has.
    """

    def __init__(self, known: Iterable[str]) -> None:
        self._known = frozenset(known)
        self._active = set[str]()  # no annotation: the method set hides the type
        self._changed = threading.Condition()

    def set(self, name: str, on: bool = True) -> None:
        """Switch a fault on or off.

        Raises:
            ConfigError: the device has no such fault.
        """
        if name not in self._known:
            raise ConfigError(f"unknown fault '{name}'; valid here: {choices(self._known)}")
        with self._changed:
            (self._active.add if on else self._active.discard)(name)
            self._changed.notify_all()

    def __contains__(self, name: str) -> bool:
        """Return whether a fault is on; a name that the device does not have is a bug in the device."""
        assert name in self._known, name
        with self._changed:
            return name in self._active

    def take(self, name: str) -> bool:
        """Return whether a fault is on, and switch it off: for faults that happen once."""
        with self._changed:
            on = name in self._active
            self._active.discard(name)
            return on

    def wait_while(self, name: str, timeout: float) -> bool:
        """Wait until a fault is off, at most ``timeout`` [s]; return whether it is off."""
        with self._changed:
            return self._changed.wait_for(lambda: name not in self._active, timeout)


# TCP servers


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


CHECK_S = 0.05  # period of checking whether the device is absent or the server closes [s]


class TcpServer(Closes):
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
