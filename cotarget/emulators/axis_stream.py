"""Sending pictures to one viewer: single, or as the parts of a stream, with whatever is to be wrong with them."""

import select
import socket
import threading
import time
from collections.abc import Callable
from http import HTTPStatus

from cotarget.emulators.axis_http import HttpError, reply_head
from cotarget.emulators.axis_pictures import Order, Pace, Pictures, damaged
from cotarget.emulators.faults import Faults
from cotarget.emulators.plant import Picture

BOUNDARY = "--myboundary"
# How often a sender that waits for something looks whether its server closes or its client has gone [s].
LOOK_S = 0.1
# How long the first picture of a camera is waited for [s].
FIRST_PICTURE_S = 2.0
# What is missing, or too much, of a length that is wrong [bytes].
LENGTH_ERROR = 777
# Faults that end streams which are under way.
ENDING = ("unauthorized", "busy", "refuse")


class Sender:
    """Sends pictures over one connection.

    Args:
        connection: to the client.
        pictures: of the server.
        faults: of the server.
        closing: set when the server closes.
        early_boundary: whether a boundary is sent at once after its picture, instead of just before the next.
        sent: told each part's picture index, and when its first byte is sent [s].
    """

    def __init__(
        self,
        connection: socket.socket,
        pictures: Pictures,
        faults: Faults,
        closing: threading.Event,
        early_boundary: bool,
        sent: Callable[[int, float], None] | None,
    ) -> None:
        self._connection, self._pictures, self._faults, self._closing = connection, pictures, faults, closing
        self._early, self._sent = early_boundary, sent

    def first(self, order: Order) -> Picture:
        """The newest picture of a camera.

        Raises:
            HttpError: it has none (503), or not of the size that is asked for (400).
        """
        deadline = time.monotonic() + FIRST_PICTURE_S
        while not self._closing.is_set() and time.monotonic() < deadline:
            if picture := self._pictures.wait(order.camera, -1, LOOK_S):
                self._pictures.check(order, picture)
                return picture
        raise HttpError(HTTPStatus.SERVICE_UNAVAILABLE)

    def snapshot(self, order: Order) -> None:
        """Send a single picture."""
        index, data = self._pictures.jpeg(order, self.first(order))
        headers, data = self._spoil(index, data)
        if not order.show_length:
            headers = headers[:1]
        self._send(reply_head(HTTPStatus.OK, headers), data, b"")

    def stream(self, order: Order) -> None:
        """Send pictures, always the newest next, until the order is fulfilled or nobody listens any more."""
        self.first(order)
        dashes = "--" if "dashed-boundary" in self._faults else ""
        kind = f"Content-Type: multipart/x-mixed-replace;boundary={dashes}{BOUNDARY[2:]}"
        opening = f"{BOUNDARY}\r\n" if self._early else ""
        self._connection.sendall(reply_head(HTTPStatus.OK, [kind]) + opening.encode())
        pace, last, count = Pace(order.rate_hz), -1, 0
        end = time.monotonic() + order.duration if order.duration else float("inf")
        while time.monotonic() < end and not (order.count and count == order.count) and self._goes_on():
            picture = self._pictures.wait(order.camera, last, LOOK_S)
            if picture is None:
                if self._gone():
                    return
                continue
            last = picture.index
            if not pace.due(time.monotonic()):
                continue
            index, data = self._pictures.jpeg(order, picture)
            last = max(last, index)
            if not self._part(index, data):
                return
            count += 1

    def _goes_on(self) -> bool:
        return not self._closing.is_set() and not any(name in self._faults for name in ENDING)

    def _part(self, index: int, data: bytes) -> bool:
        headers, data = self._spoil(index, data)
        head = "\r\n".join([*([] if self._early else [BOUNDARY]), *headers, "", ""])
        tail = f"\r\n{BOUNDARY}\r\n" if self._early else "\r\n"
        if self._sent is not None:
            self._sent(index, time.monotonic())
        return self._send(head.encode(), data, tail.encode())

    def _spoil(self, index: int, data: bytes) -> tuple[list[str], bytes]:
        """The headers and bytes of a picture, with the faults that are on."""
        length = len(data)
        if "wrong-length" in self._faults:  # by turns too long and too short
            length += LENGTH_ERROR if index % 2 else -LENGTH_ERROR
        if "corrupt" in self._faults:
            data = damaged(data, index)
        headers = ["Content-Type: image/jpeg", f"Content-Length: {max(length, 0)}"]
        return headers[:1] if "no-length" in self._faults else headers, data

    def _send(self, head: bytes, data: bytes, tail: bytes) -> bool:
        """Send a picture; whether the connection is still good for another."""
        whole, middle = head + data + tail, len(head) + len(data) // 2
        if "cut" in self._faults:
            self._connection.sendall(whole[:middle])
            return False
        if "stall" in self._faults:
            self._connection.sendall(whole[:middle])
            while not self._faults.wait_while("stall", LOOK_S):
                if not self._goes_on() or "cut" in self._faults or self._gone():
                    return False
            whole = whole[middle:]
        self._connection.sendall(whole)
        return True

    def _gone(self) -> bool:
        """Whether the client has closed its side; it is not expected to say anything."""
        readable, _, _ = select.select([self._connection], [], [], 0)
        return bool(readable) and not self._connection.recv(1, socket.MSG_PEEK)
