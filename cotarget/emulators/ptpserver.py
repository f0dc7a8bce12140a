"""A PTP/IP responder: one TCP port, one initiator at a time, an emulated device behind it.

The session is packets in, packets out; around it stand the sockets and threads, and those faults that happen on the
line: "hung" answers nothing, "slow" answers a second late, "cut" breaks the connection once in the middle of data, and
for as long as the device is ``absent`` nobody listens.
"""

import contextlib
import itertools
import socket
import threading
from collections.abc import Callable, Iterable, Iterator

from cotarget.emulators.faults import Faults
from cotarget.emulators.ptp import PARAMETERS, Code, PtpDevice, PtpError
from cotarget.emulators.ptpip import (
    Data,
    InitCommand,
    InitEvent,
    Kind,
    Packet,
    PacketReader,
    Probe,
    Request,
    StartData,
    data_phase,
    event,
    init_command_ack,
    init_fail,
    packet,
    response,
)
from cotarget.errors import DeviceError

LINE_FAULTS = ("hung", "slow", "cut")
LOOK_S = 0.05  # between looks at whether the device is absent
SLOW_S = 1.0  # that a slow answer takes; libgphoto2 waits for 2.5 s
SUCCESSION_S = 1.0  # that a caller waits for the one before to be gone
RECEIVE = 1 << 16  # bytes
LONGEST_DATA = 1 << 20  # bytes that an operation may bring along; a property's value takes a few
# libgphoto2 sends a request and its data apart and without TCP_NODELAY: unless the first is acknowledged at once, which
# is an option of Linux, the second leaves 40 ms late.
QUICK_ACK: int | None = getattr(socket, "TCP_QUICKACK", None)
HIGHEST_PORT = 65535
REJECTED, BUSY = 1, 2  # reasons of a refusal


class CommandSession:
    """The transactions of one command connection.

    Args:
        device: does the operations.
        deaf: whether to do and answer nothing now.
    """

    def __init__(self, device: PtpDevice, deaf: Callable[[], bool] = lambda: False) -> None:
        self._device, self._deaf = device, deaf
        self._request: Request | None = None  # whose data is not all there
        self._total = -1  # bytes of that data, as announced; -1 before it is
        self._data = bytearray()

    def receive(self, received: Packet) -> list[bytes]:
        """Take a packet of the initiator; the packets to send back, if any.

        Raises:
            PtpError: the packet makes no sense now.
        """
        waiting = self._request
        match received:
            case Request() if waiting is None:
                if not received.sends_data:
                    return self._operate(received, b"")
                self._request, self._total, self._data = received, -1, bytearray()
            case StartData() if waiting is not None and self._total < 0 and received.transaction == waiting.transaction:
                if received.total > LONGEST_DATA:
                    raise PtpError(f"PTP/IP: {received.total} bytes are too much data")
                self._total = received.total
            case Data() if waiting is not None and self._total >= 0 and received.transaction == waiting.transaction:
                self._data += received.data
                if len(self._data) > self._total:
                    raise PtpError(f"PTP/IP: more data came than the {self._total} bytes announced")
                if received.last:
                    return self._complete(waiting)
            case Probe(answer=False):
                return [packet(Kind.PROBE_RESPONSE)]
            case Request() | StartData() | Data() | InitCommand() | InitEvent():
                raise PtpError(f"PTP/IP: a packet out of turn: {type(received).__name__}")
        return []

    def _complete(self, request: Request) -> list[bytes]:
        self._request = None
        if len(self._data) < self._total:
            return [response(Code.INCOMPLETE_TRANSFER, request.transaction)]
        return self._operate(request, bytes(self._data))

    def _operate(self, request: Request, data: bytes) -> list[bytes]:
        if self._deaf():
            return []
        missing = PARAMETERS - len(request.parameters)
        answer = self._device.operate(request.code, request.parameters + (0,) * missing, data)
        phase: Iterable[bytes] = () if answer.data is None else data_phase(request.transaction, answer.data)
        return [*phase, response(answer.code, request.transaction, answer.parameters)]


class PtpIpServer:
    """Listens on one port for command and event connections of one initiator at a time.

    Args:
        device: the device.
        guid: its 16 bytes.
        name: how it calls itself.
        faults: knows those of `LINE_FAULTS`.
        absent: whether the device is unplugged or off now; asked every `LOOK_S`.
        host: where to listen.
        port: where to listen; 0 for any.

    Raises:
        DeviceError: nobody can listen there.
    """

    def __init__(
        self,
        device: PtpDevice,
        guid: bytes,
        name: str,
        faults: Faults,
        absent: Callable[[], bool],
        host: str,
        port: int,
    ) -> None:
        self._device, self._guid, self._name = device, guid, name
        self._faults, self._absent = faults, absent
        if not 0 <= port <= HIGHEST_PORT:
            raise DeviceError(f"cannot listen on {host}:{port}: a port is a number from 0 to {HIGHEST_PORT}")
        try:
            self._listener: socket.socket | None = listen(host, port)
        except OSError as error:
            raise DeviceError(f"cannot listen on {host}:{port}: {error.strerror or error}") from None
        self._address: tuple[str, int] = self._listener.getsockname()[:2]
        self._closing = threading.Event()
        self._numbers = itertools.count(1)
        self._changed = threading.Condition()  # guards what follows
        self._open: set[socket.socket] = set()
        self._caller: int | None = None  # number of the command connection
        self._ears: dict[int, socket.socket] = {}  # event connections by the number of their command connection
        self._threads: list[threading.Thread] = []
        self._acceptor = threading.Thread(target=self._accept, daemon=True)
        self._acceptor.start()

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._address[1]

    def send_event(self, code: int, parameters: Iterable[int]) -> None:
        """Send an event to the initiator, if there is one that listens."""
        with self._changed:
            ear = None if self._caller is None else self._ears.get(self._caller)
        if ear is not None and "hung" not in self._faults:
            with contextlib.suppress(OSError):
                ear.sendall(event(code, parameters))

    def close(self) -> None:
        """Stop listening, break the connections, and wait for the threads."""
        self._closing.set()
        self._acceptor.join()
        self._hang_up()
        for thread in self._threads:
            thread.join()

    def _accept(self) -> None:
        while not self._closing.is_set():
            if self._absent():
                self._hang_up()
                self._closing.wait(LOOK_S)
            elif self._listener is None:
                try:
                    self._listener = listen(*self._address)
                except OSError:  # somebody else has the port for now
                    self._closing.wait(LOOK_S)
            else:
                with contextlib.suppress(TimeoutError):
                    self._welcome(self._listener.accept()[0])
        self._stop_listening()

    def _welcome(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.settimeout(None)
        with self._changed:
            self._open.add(connection)
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        self._threads.append(threading.Thread(target=self._serve, args=(connection,), daemon=True))
        self._threads[-1].start()

    def _stop_listening(self) -> None:
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _hang_up(self) -> None:
        self._stop_listening()
        with self._changed:
            for connection in self._open:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def _serve(self, connection: socket.socket) -> None:
        try:
            with contextlib.suppress(OSError, PtpError):
                packets = self._packets(connection)
                match next(packets, None):
                    case InitCommand():
                        self._command(connection, packets)
                    case InitEvent(number):
                        self._events(connection, packets, number)
        finally:
            with self._changed:
                self._open.discard(connection)
            connection.close()

    def _packets(self, connection: socket.socket) -> Iterator[Packet]:
        reader = PacketReader()
        while True:
            if QUICK_ACK is not None:
                connection.setsockopt(socket.IPPROTO_TCP, QUICK_ACK, 1)
            received = connection.recv(RECEIVE)
            if not received:
                return
            yield from reader.feed(received)

    def _command(self, connection: socket.socket, packets: Iterator[Packet]) -> None:
        number = next(self._numbers)
        with self._changed:
            # A client that leaves and comes back at once is faster than the end of its first connection is noticed.
            if not self._changed.wait_for(lambda: self._caller is None, SUCCESSION_S):
                connection.sendall(init_fail(BUSY))
                return
            self._caller = number
        try:
            self._send(connection, [init_command_ack(number, self._guid, self._name)])
            session = CommandSession(self._device, lambda: "hung" in self._faults)
            for received in packets:
                self._send(connection, session.receive(received))
        finally:
            self._device.disconnected()
            with self._changed:
                self._caller = None
                self._changed.notify_all()

    def _events(self, connection: socket.socket, packets: Iterator[Packet], number: int) -> None:
        with self._changed:
            known = number == self._caller and number not in self._ears
            if known:
                self._ears[number] = connection
        if not known:
            connection.sendall(init_fail(REJECTED))
            return
        try:
            self._send(connection, [packet(Kind.INIT_EVENT_ACK)])
            for received in packets:
                if received == Probe():
                    self._send(connection, [packet(Kind.PROBE_RESPONSE)])
        finally:
            with self._changed:
                del self._ears[number]

    def _send(self, connection: socket.socket, packets: list[bytes]) -> None:
        if not packets or "hung" in self._faults:
            return
        if "slow" in self._faults:
            self._closing.wait(SLOW_S)
        answer = b"".join(packets)
        if len(packets) > 1 and self._faults.take("cut"):
            connection.sendall(answer[: len(answer) // 2])
            raise PtpError("PTP/IP: cut")
        connection.sendall(answer)


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens and whose accept() takes `LOOK_S` at most."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.create_server((host, port), family=family)
    listener.settimeout(LOOK_S)
    return listener
