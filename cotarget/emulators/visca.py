"""An emulated pan-tilt-zoom camera that takes VISCA over IP, in front of two axes and a lens.

`ViscaCamera` is the firmware: it takes one message and answers it. `ViscaServer` is its network: UDP with Sony's header
and its numbers, UDP bare, and TCP bare, served by one thread. Faults can be switched on (`VISCA_FAULTS`).

Sources: Sony's EVI-D70 and SRG-300H manuals, PTZOptics' VISCA over IP command list.
"""

import contextlib
import math
import random
import select
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from cotarget.emulators.plant import AxisPlant, LensPlant
from cotarget.emulators.serve import LOCAL, Closes, Faults, open_listener
from cotarget.emulators.zoom_block import ZoomBlock
from cotarget.errors import DeviceError

VISCA_FAULTS = (
    "silence",  # it answers nothing, and obeys nothing
    "lost-packets",  # three datagrams of ten are lost, either way
    "lost-stop",  # the next stop is lost
    "lost-stop-answer",  # the answer to the next stop is lost
    "lost-move-answer",  # the answer to the next move is lost
    "late-answers",  # each answer takes 0.4 s
    "garbage",  # noise before each answer
    "constant-number",  # all answers have the number 1
    "three-numbers",  # it falls silent after three messages, until its counter is reset
    "wrong-number",  # the next message is refused for its number
    "five-nibbles",  # pan has five nibbles
    "seven-nibbles",  # pan and tilt together have fifteen nibbles, as no camera's
    "keeps-sockets",  # a command under way keeps its socket until it is done or cancelled
    "buffer-full",  # every command is refused
    "not-executable",  # every command but a stop is refused
    "standby",
    "no-pan-tilt",  # a camera with a zoom alone
    "no-zoom",
    "no-header",  # it does not listen at the port with Sony's header
)
# Counts a degree, and indices of speeds [degrees/s] from 0 on.
SPEEDS_PTZOPTICS = (
    (0.3, 1, 1.5, 2.2, 2.4, 2.6, 2.8, 3, 3.2, 3.4, 3.8, 4.5, 6, 9, 15, 19, 25, 32, 38, 45, 58, 75, 88, 105, 120),
    (0.3, 1, 1.5, 2.2, 3.6, 4.7, 6, 8, 10, 12, 15, 18, 23, 30, 39, 48, 59, 69, 80),
)
SPEEDS_EVI = (
    (0, 2, 2.4, 3, 3.7, 4.7, 6.1, 7.4, 9.1, 11, 14, 18, 22, 27, 34, 42, 52, 65, 81, 100),
    (0, 2, 2.4, 3, 3.7, 4.7, 6.1, 7.4, 9.1, 11, 14, 18, 22, 27, 34, 42, 52, 65, 81),
)
# Zoom numbers and magnifications of a block of 25 x; digital zoom, which would go on, is not emulated.
BLOCK = ZoomBlock((
    (0x0000, 1.0), (0x1781, 2.0), (0x213B, 3.0), (0x2752, 4.0), (0x2BB3, 5.0), (0x315D, 7.0), (0x362C, 10.0),
    (0x3AFA, 15.0), (0x3DF8, 20.0), (0x4000, 25.0),
))  # fmt: skip
TELE = 0x4000


@dataclass(frozen=True)
class ViscaModel:
    """A model of camera.

    Attributes:
        count_deg: angle of a count of pan and tilt [degrees].
        speeds: of pan and of tilt by index [degrees/s].
        pan: lowest and highest position [counts].
        tilt: lowest and highest position [counts].
        highest_deg_s: no axis is faster [degrees/s].
        acceleration_deg_s2: of both axes [degrees/s^2].
    """

    count_deg: float = 1 / 14.4
    speeds: tuple[tuple[float, ...], tuple[float, ...]] = SPEEDS_PTZOPTICS
    pan: tuple[int, int] = (-2448, 2448)
    tilt: tuple[int, int] = (-432, 1296)
    highest_deg_s: float = math.inf
    acceleration_deg_s2: float = 400.0


# Counts a degree and speeds by the names that rig.toml has for them.
UNITS: Mapping[str, tuple[float, tuple[tuple[float, ...], tuple[float, ...]]]] = {
    "ptzoptics": (1 / 14.4, SPEEDS_PTZOPTICS),
    "evi_d70": (170 / 2267, SPEEDS_EVI),
    "evi_d80": (170 / 7707, SPEEDS_EVI),
}
ACKNOWLEDGED, DONE, FAILED = 0x40, 0x50, 0x60
SYNTAX, FULL, CANCELLED, NO_SOCKET, NOT_NOW = 0x02, 0x03, 0x04, 0x05, 0x41
Reply = Callable[[bytes], None]


class RefusedError(Exception):
    """A command is refused; its argument is VISCA's code."""


@dataclass
class Running:
    """A command under way in one of the sockets."""

    axes: str  # "head" or "lens"
    reply: Reply


def signed(data: bytes) -> int:
    """Decode nibbles in two's complement of their width."""
    value = 0
    for nibble in data:
        if nibble > 0xF:
            raise RefusedError(SYNTAX)
        value = value << 4 | nibble
    return value - (1 << 4 * len(data)) if data[0] > 7 else value


def spread(value: int, width: int) -> bytes:
    """Encode an integer in nibbles."""
    return bytes(value >> 4 * (width - 1 - place) & 0xF for place in range(width))


class ViscaCamera:
    """Firmware of the camera.

    Args:
        pan: axis, in counts.
        tilt: axis, in counts.
        lens: the lens.
        model: units, ranges and speeds.
        faults: those that are on.
    """

    def __init__(self, pan: AxisPlant, tilt: AxisPlant, lens: LensPlant, model: ViscaModel, faults: Faults) -> None:
        self._axes, self._lens, self._model, self._faults = (pan, tilt), lens, model, faults
        self._running: dict[int, Running] = {}  # by socket
        self._on = self._was_on = True
        self._zoomed = (-1, 0)  # the lens's position that a zoom number led to, and the number
        self.digital_zoom = True

    @property
    def is_on(self) -> bool:
        """Whether it is not in standby."""
        return self._on and "standby" not in self._faults

    def receive(self, message: bytes, reply: Reply) -> None:
        """Take a message with its end; call ``reply`` with each answer, also later from `tick`."""
        match list(message):
            case [0x81, 0x09, *question, 0xFF]:
                self._answer(bytes(question), reply)
            case [0x81, 0x01, 0x00, 0x01, 0xFF]:
                self._running.clear()
                reply(bytes([0x90, DONE, 0xFF]))
            case [0x81, 0x01, *order, 0xFF]:
                self._obey(bytes(order), reply)
            case [0x81, cancel, 0xFF] if cancel >> 4 == 2:
                self._cancel(cancel & 0xF, reply)
            case _:
                reply(bytes([0x90, FAILED, SYNTAX, 0xFF]))

    def tick(self) -> bool:
        """Report the completion of commands whose axes have come to rest; return whether any is under way.

        A camera that goes into standby stops.
        """
        if self._was_on and not self.is_on:
            self._halt()
        self._was_on = self.is_on
        for place, running in list(self._running.items()):
            if running.axes == "lens" or not any(axis.moving() for axis in self._axes):
                del self._running[place]
                running.reply(bytes([0x90, DONE | place, 0xFF]))
        return bool(self._running)

    def _answer(self, question: bytes, reply: Reply) -> None:
        try:
            reply(bytes([0x90, DONE]) + self._value(question) + b"\xff")
        except RefusedError as error:
            reply(bytes([0x90, FAILED, error.args[0], 0xFF]))

    def _value(self, question: bytes) -> bytes:
        match question.hex():
            case "0002":
                return bytes.fromhex("00 20 05 11 01 23 02")  # vendor, model, ROM, sockets
            case "0400":
                return bytes([2 if self.is_on else 3])
            case "0406":
                return bytes([2 if self.digital_zoom else 3])
            case "0612" if "no-pan-tilt" not in self._faults:
                self._refuse_standby()
                wide = 5 if "five-nibbles" in self._faults else 4
                pan, tilt = (axis.position() for axis in self._axes)
                more = bytes(7) if "seven-nibbles" in self._faults else b""
                return spread(pan, wide) + spread(tilt, 4) + more
            case "0611" if "no-pan-tilt" not in self._faults:
                return bytes(len(speeds) - 1 for speeds in self._model.speeds)
            case "0447" if "no-zoom" not in self._faults:
                self._refuse_standby()
                return spread(self._zoom_number(), 4)
        raise RefusedError(SYNTAX)

    def _obey(self, order: bytes, reply: Reply) -> None:
        is_stop = order[:2] == b"\x06\x01" and order[4:] == b"\x03\x03"
        try:
            if "buffer-full" in self._faults:
                raise RefusedError(FULL)
            if not is_stop and "not-executable" in self._faults:
                raise RefusedError(NOT_NOW)
            if len(self._running) == 2 and "keeps-sockets" in self._faults and not is_stop:
                raise RefusedError(FULL)
            axes = self._execute(order)
        except RefusedError as error:
            reply(bytes([0x90, FAILED, error.args[0], 0xFF]))
            return
        for place, running in list(self._running.items()):
            if (
                running.axes == axes and "keeps-sockets" not in self._faults
            ):  # a new command takes the place of the one under way
                del self._running[place]
                running.reply(bytes([0x90, FAILED | place, CANCELLED, 0xFF]))
        place = next((each for each in (1, 2) if each not in self._running), 1)
        reply(bytes([0x90, ACKNOWLEDGED | place, 0xFF]))
        if axes == "none":
            reply(bytes([0x90, DONE | place, 0xFF]))
        else:
            self._running[place] = Running(axes, reply)

    def _cancel(self, place: int, reply: Reply) -> None:
        running = self._running.pop(place, None)
        if running is None:
            reply(bytes([0x90, FAILED | place, NO_SOCKET, 0xFF]))
            return
        if running.axes == "head":
            self._halt()
        reply(bytes([0x90, FAILED | place, CANCELLED, 0xFF]))

    def _execute(self, order: bytes) -> str:
        """Start an order; return what it moves, "head", "lens" or "none"."""
        if order[:2] == b"\x04\x00" and len(order) == 3:
            self._on = order[2] == 2
            return "none"
        if order[:1] == b"\x06" and "no-pan-tilt" in self._faults:
            raise RefusedError(SYNTAX)
        self._refuse_standby()
        match list(order):
            case [0x06, 0x01, pan, tilt, across, up]:
                self._drive(pan, tilt, across, up)
                return "head"
            case [0x06, 0x02 | 0x03 as how, pan, tilt, *goals] if len(goals) in (8, 9):
                ends = signed(bytes(goals[:-4])), signed(bytes(goals[-4:]))
                if how == 0x03:
                    ends = self._axes[0].position() + ends[0], self._axes[1].position() + ends[1]
                self._go(ends, (pan, tilt))
                return "head"
            case [0x06, 0x04 | 0x05]:
                self._go((0, 0), (0xFF, 0xFF))
                return "head"
            case [0x04, 0x47, *where] if len(where) == 4 and "no-zoom" not in self._faults:
                number = min(signed(bytes(where)) & 0xFFFF, TELE)
                self._zoomed = self._lens_position(number), number
                self._lens.command(self._zoomed[0])
                return "lens"
            case [0x04, 0x07, way] if "no-zoom" not in self._faults:
                self._lens.command({0: self._lens.position(), 3: 0}.get(way >> 4 or way, self._lens.last))
                return "lens"
            case [0x04, 0x06, on]:
                self.digital_zoom = on == 2
                return "none"
        raise RefusedError(SYNTAX)

    def _refuse_standby(self) -> None:
        if not self.is_on:
            raise RefusedError(NOT_NOW)

    def _drive(self, pan: int, tilt: int, across: int, up: int) -> None:
        """Turn at speeds until a limit or a stop: 1 is left or up, 2 right or down, 3 a stop."""
        if not {across, up} <= {1, 2, 3}:
            raise RefusedError(SYNTAX)
        ranges = (self._model.pan, self._model.tilt)
        ends = {1: ranges[0][0], 2: ranges[0][1]}.get(across), {1: ranges[1][1], 2: ranges[1][0]}.get(up)
        for axis, end, index, speeds in zip(self._axes, ends, (pan, tilt), self._model.speeds, strict=True):
            if end is None:
                axis.halt(self._acceleration)
            else:
                axis.command(end, self._speed(speeds, index), self._acceleration)

    def _go(self, goals: tuple[int, int], indices: tuple[int, int]) -> None:
        rows = zip(self._axes, goals, indices, self._model.speeds, (self._model.pan, self._model.tilt), strict=True)
        for axis, goal, index, speeds, (lowest, highest) in rows:
            axis.command(min(max(goal, lowest), highest), self._speed(speeds, index), self._acceleration)

    def _halt(self) -> None:
        for axis in self._axes:
            axis.halt(self._acceleration)

    @property
    def _acceleration(self) -> float:
        return self._model.acceleration_deg_s2 / self._model.count_deg

    def _speed(self, speeds: tuple[float, ...], index: int) -> float:
        return min(speeds[min(index, len(speeds) - 1)], self._model.highest_deg_s) / self._model.count_deg

    def _lens_position(self, number: int) -> int:
        """Return the lens's position of a zoom number; its positions are even in the logarithm of the focal length."""
        return round(BLOCK.share(number) * self._lens.last)

    def _zoom_number(self) -> int:
        if self._lens.position() == self._zoomed[0]:
            return self._zoomed[1]
        return round(BLOCK.number(self._lens.position() / self._lens.last))


# The network

TICK_S = 0.005  # period of looking for completed commands [s]
LATE_S = 0.4
LOST = 0.3  # of the datagrams, by the fault lost-packets
RECEIVE, LONGEST = 4096, 64  # bytes
COMMANDS, REPLY, CONTROL, CONTROL_REPLY = (0x0100, 0x0110), 0x0111, 0x0200, 0x0201
DRIVE, ABSOLUTE = b"\x06\x01", b"\x06\x02"
NOISE = bytes.fromhex("00 13 37 FF")


class ViscaServer(Closes):
    """The camera's ports, served by one thread; a context manager.

    Args:
        camera: the firmware.
        faults: those that are on.
        host: address to listen at.
        ports: of UDP with Sony's header, UDP bare and TCP; 0 for any free one.

    Attributes:
        ports: as they were opened.

    Raises:
        DeviceError: a port cannot be opened.
    """

    def __init__(
        self, camera: ViscaCamera, faults: Faults, host: str = LOCAL, ports: tuple[int, int, int] = (0, 0, 0)
    ) -> None:
        self._camera, self._faults, self.host = camera, faults, host
        self._numbers: dict[tuple[str, int], int] = {}  # the last number of each client
        self._clients: dict[socket.socket, bytes] = {}  # of TCP, with the begin of a message
        self._delayed: list[tuple[float, Callable[[], None]]] = []
        self._luck = random.Random(0)
        with contextlib.ExitStack() as opened:
            self._sony, self._bare = (opened.enter_context(_open_udp(host, port)) for port in ports[:2])
            self._listener = opened.enter_context(open_listener(host, ports[2]))
            opened.pop_all()
        self.ports = tuple(each.getsockname()[1] for each in (self._sony, self._bare, self._listener))
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"visca {self.ports[0]}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and close the ports; may be called again."""
        self._closing.set()
        self._thread.join()
        for each in (self._sony, self._bare, self._listener, *self._clients):
            each.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            sources = [self._sony, self._bare, self._listener, *self._clients]
            for source in select.select(sources, [], [], TICK_S)[0]:
                with contextlib.suppress(OSError):  # a client is gone
                    self._serve(source)
            self._camera.tick()
            now = time.monotonic()
            due = [send for t, send in self._delayed if t <= now]
            self._delayed = [each for each in self._delayed if each[0] > now]
            for send in due:
                send()

    def _serve(self, source: socket.socket) -> None:
        if source is self._listener:
            client = self._listener.accept()[0]
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients[client] = b""
        elif source is self._sony:
            self._serve_sony(*source.recvfrom(RECEIVE))
        elif source is self._bare:
            data, client = source.recvfrom(RECEIVE)
            for message in data.split(b"\xff")[:-1]:
                if not self._is_lost(message):
                    self._take(message + b"\xff", lambda answer: source.sendto(answer, client))
        else:
            self._serve_tcp(source)

    def _serve_tcp(self, client: socket.socket) -> None:
        try:
            data = client.recv(RECEIVE)
        except OSError:
            data = b""
        if not data:
            del self._clients[client]
            client.close()
            return
        *messages, rest = (self._clients[client] + data).split(b"\xff")
        self._clients[client] = rest[-LONGEST:]
        for message in messages:
            if "silence" not in self._faults:
                self._take(message + b"\xff", client.sendall, is_stream=True)

    def _serve_sony(self, data: bytes, client: tuple[str, int]) -> None:
        if "no-header" in self._faults or len(data) < 9:
            return
        kind, length, number = (int.from_bytes(part, "big") for part in (data[:2], data[2:4], data[4:8]))
        payload = data[8:]

        def answer(payload: bytes, kind: int = REPLY) -> None:
            said = 1 if "constant-number" in self._faults else number
            head = kind.to_bytes(2, "big") + len(payload).to_bytes(2, "big") + said.to_bytes(4, "big")
            self._sony.sendto(head + payload, client)

        if length != len(payload):
            answer(b"\x0f\x02", CONTROL_REPLY)
        elif kind == CONTROL:
            self._numbers[client] = 0
            if "silence" not in self._faults:
                answer(b"\x01", CONTROL_REPLY)
        elif kind in COMMANDS:
            if "three-numbers" in self._faults and number > 3:
                return
            if self._is_lost(payload):
                return
            if number <= self._numbers.get(client, -1) or self._faults.take("wrong-number"):
                answer(b"\x0f\x01", CONTROL_REPLY)
                return
            self._numbers[client] = number
            self._take(payload, answer)

    def _is_lost(self, message: bytes) -> bool:
        return "silence" in self._faults or self._loses() or (message[2:4] == DRIVE and self._faults.take("lost-stop"))

    def _loses(self) -> bool:
        """Draw whether a datagram gets lost."""
        return "lost-packets" in self._faults and self._luck.random() < LOST

    def _take(self, message: bytes, send: Callable[[bytes], object], is_stream: bool = False) -> None:
        """Pass a message to the firmware, and its answers on, as far as the faults leave them."""
        loses = (message[2:4] == DRIVE and self._faults.take("lost-stop-answer")) or (
            message[2:4] == ABSOLUTE and self._faults.take("lost-move-answer")
        )

        def reply(answer: bytes) -> None:
            if loses or "silence" in self._faults or (not is_stream and self._loses()):
                return
            if "garbage" in self._faults:
                _quietly(send, NOISE)
            if "late-answers" in self._faults:
                self._delayed.append((time.monotonic() + LATE_S, lambda: _quietly(send, answer)))
            else:
                _quietly(send, answer)

        self._camera.receive(message, reply)


def _quietly(send: Callable[[bytes], object], answer: bytes) -> None:
    with contextlib.suppress(OSError):  # the client is gone
        send(answer)


def _open_udp(host: str, port: int) -> socket.socket:
    """Open a UDP socket.

    Raises:
        DeviceError: the address is invalid or in use.
    """
    opened = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    # Programs that bind the camera's port on all addresses can then share it, as on another machine.
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        opened.bind((host, port))
    except OSError as error:
        opened.close()
        raise DeviceError(f"cannot listen at {host}:{port}: {error.strerror or error}") from None
    return opened
