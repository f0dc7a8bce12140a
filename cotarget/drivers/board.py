"""The calibration board before real cameras, held by a person or by a program at a socket.

The program's protocol is one JSON object a line. `{"present": {"translation": [x, y, z], "rotvec_deg": [rx, ry, rz]}}`
requests the board at T_fixed_board [m, degrees], `{"present": null}` no board, and `{"swing": {...}}` a board that
swings along its x axis until the next request. The answer `{"ok": true}` comes when that is done, `{"error": "..."}` if
it is not possible.
"""

import contextlib
import json
import re
import socket
import sys
from typing import Annotated, BinaryIO, TextIO

import numpy as np

from cotarget.errors import DeviceError
from cotarget.geometry import RigidTransform, pose_dict
from cotarget.schema import Check, model

PERSONS_PATIENCE = 60.0  # time to walk there, turn the board and hold it still [s]
CONNECT_TIMEOUT, ANSWER_TIMEOUT = 3.0, 60.0  # a robot arm may take its time [s]
LONGEST_ANSWER = 65536  # bytes
TURNED_DEG = 5.0  # a smaller rotation is not mentioned to a person


SOCKET = re.compile(r"socket://(\[[0-9A-Fa-f:.]+\]|[^:/\s]+):(\d+)/?")


def socket_address(url: str) -> tuple[str, int] | None:
    """Parse host and port of "socket://host:port"; None for anything else."""
    match = SOCKET.fullmatch(url)
    return None if match is None else (match[1].strip("[]"), int(match[2]))


def _presenter(presenter: str) -> str:
    if presenter != "person" and socket_address(presenter) is None:
        raise ValueError(f"'{presenter}' is neither person nor like socket://host:port")
    return presenter


@model
class BoardSettings:
    """How the calibration board is presented.

    Attributes:
        presenter: "person", who is asked on the terminal to hold it, or a program at "socket://host:port".
    """

    presenter: Annotated[str, Check(_presenter)] = "person"


def make_board(config: BoardSettings) -> "PersonBoard | SocketBoard":
    """Make the configured holder of the board: a person, or a program at a socket, which is connected to when asked."""
    address = socket_address(config.presenter)
    return PersonBoard(sys.stderr) if address is None else SocketBoard(*address)


def probe(config: BoardSettings) -> str:
    """Check that the board's holder is there, without a request for the board; describe the holder.

    Raises:
        DeviceError: no program listens at the socket.
    """
    board = make_board(config)
    if isinstance(board, PersonBoard):
        return "a person"
    with contextlib.closing(board):
        board.connect()
    return f"a program at {config.presenter}"


class PersonBoard:
    """A person who holds the board where a printed text says."""

    patience = PERSONS_PATIENCE

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        """Print where to hold the board, or that it is not needed any more."""
        self._say("take the board away" if T_fixed_board is None else in_words(T_fixed_board))

    def swing(self, T_fixed_board: RigidTransform) -> None:
        """Print where to swing the board."""
        self._say(f"{in_words(T_fixed_board)}; swing it left and right by 15 cm, to and fro in two seconds")

    def close(self) -> None:
        """Do nothing; a person has no connection."""

    def _say(self, text: str) -> None:
        print(f"\n{text}", file=self._out, flush=True)


class SocketBoard:
    """A program at a socket that holds the board: a robot, or an emulated rig.

    The first request connects to it, because only a calibration needs it.

    Raises:
        DeviceError: no program listens there, it is gone, or a pose is not possible.
    """

    patience = 0.0

    def __init__(self, host: str, port: int) -> None:
        self._address, self._name = (host, port), f"socket://{host}:{port}"
        self._opened: tuple[socket.socket, BinaryIO] | None = None

    def connect(self) -> tuple[socket.socket, BinaryIO]:
        """Connect to the program, if that is not done yet; give the connection and what reads its lines."""
        if self._opened is None:
            try:
                connection = socket.create_connection(self._address, timeout=CONNECT_TIMEOUT)
            except OSError as error:
                raise DeviceError(
                    f"hardware.board.presenter: no program holds a board at {self._name}: {error.strerror or error}"
                ) from None
            connection.settimeout(ANSWER_TIMEOUT)
            self._opened = connection, connection.makefile("rb")
        return self._opened

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        """Request the board at a pose, or no board, and wait until that is done."""
        self._ask("present", T_fixed_board)

    def swing(self, T_fixed_board: RigidTransform) -> None:
        """Request a board that swings about a pose."""
        self._ask("swing", T_fixed_board)

    def close(self) -> None:
        """Close the connection."""
        for each in self._opened or ():
            each.close()

    def _ask(self, what: str, T_fixed_board: RigidTransform | None) -> None:
        request = None if T_fixed_board is None else pose_dict(T_fixed_board)
        connection, lines = self.connect()
        try:
            connection.sendall(json.dumps({what: request}).encode() + b"\n")
            line = lines.readline(LONGEST_ANSWER)
        except OSError as error:
            raise DeviceError(f"{self._name}: the board's holder does not answer: {error}") from None
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError):  # the latter for endless brackets
            said = f"said {line[:40]!r}" if line else "is gone"
            raise DeviceError(f"{self._name}: the board's holder {said}") from None
        if not (isinstance(answer, dict) and answer.get("ok") is True):
            reason = answer.get("error", "no reason given") if isinstance(answer, dict) else answer
            raise DeviceError(f"{self._name}: the board cannot be held there: {reason}")


def in_words(T_fixed_board: RigidTransform) -> str:
    """Describe a board pose to a person: place of its first corner, and rotation, as seen by the fixed camera."""
    x, y, z = T_fixed_board.translation
    normal = T_fixed_board.rotation.as_matrix()[:, 2]
    yaw, pitch = np.degrees(np.arctan2(normal[0], normal[2])), np.degrees(np.arctan2(normal[1], normal[2]))
    across = np.degrees(np.arctan2(T_fixed_board.rotation.as_matrix()[1, 0], T_fixed_board.rotation.as_matrix()[0, 0]))
    turns = [
        f"{abs(angle):.0f} degrees {way}"
        for angle, way in (
            (yaw, "with its right edge nearer" if yaw > 0 else "with its left edge nearer"),
            (pitch, "with its lower edge nearer" if pitch > 0 else "with its upper edge nearer"),
            (across, "clockwise in its plane" if across > 0 else "anticlockwise in its plane"),
        )
        if abs(angle) >= TURNED_DEG
    ]
    side, height = ("right" if x > 0 else "left"), ("below" if y > 0 else "above")
    return (
        f"hold the board {z:.1f} m ahead of the fixed camera, its first corner {abs(x):.1f} m to the {side} and "
        f"{abs(y):.1f} m {height} the middle of the view, "
        + ("facing the camera" if not turns else "turned " + ", ".join(turns))
    )
