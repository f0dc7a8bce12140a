"""Who holds the calibration board before real cameras: a person who is told where, or a program at a socket.

The program's protocol is one JSON object a line: `{"present": {"translation": [x, y, z], "rotvec_deg": [rx, ry, rz]}}`
asks for the board at T_fixed_board [m, degrees], `{"present": null}` for no board, `{"swing": {...}}` for one that
swings along its x axis until the next wish. The answer `{"ok": true}` comes when it is so, `{"error": "..."}` when it
cannot be.
"""

import json
import socket
import sys
from typing import Protocol, TextIO

import numpy as np

from cotarget.config import HardwareBoard, socket_address
from cotarget.errors import DeviceError
from cotarget.geometry import RigidTransform, pose_dict
from cotarget.rig import Board

PERSONS_PATIENCE = 60.0  # to walk there, turn the board and hold it still [s]
CONNECT_TIMEOUT, ANSWER_TIMEOUT = 3.0, 60.0  # a robot arm may take its time [s]
LONGEST_ANSWER = 65536  # bytes
TURNED_DEG = 5.0  # a board turned by less faces the camera, to a person


class ClosingBoard(Board, Protocol):
    """A board whose holder is to be let go."""

    def close(self) -> None:
        """Let go; more than once does no harm."""


def make_board(config: HardwareBoard) -> ClosingBoard:
    """Open who holds the board.

    Raises:
        DeviceError: nobody is there.
    """
    address = socket_address(config.presenter)
    return PersonBoard(sys.stderr) if address is None else SocketBoard(*address)


def probe(config: HardwareBoard) -> str:
    """Look whether somebody is there to hold the board, without asking for it; who.

    Raises:
        DeviceError: nobody is there.
    """
    make_board(config).close()
    return "a person" if socket_address(config.presenter) is None else f"a program at {config.presenter}"


class PersonBoard:
    """A person, who reads where to hold the board."""

    patience = PERSONS_PATIENCE

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        """Say where to hold the board, or that it is not needed any more."""
        self._say("take the board away" if T_fixed_board is None else in_words(T_fixed_board))

    def swing(self, T_fixed_board: RigidTransform) -> None:
        """Say where to swing the board."""
        self._say(f"{in_words(T_fixed_board)}; swing it left and right by 15 cm, to and fro in two seconds")

    def close(self) -> None:
        """There is nothing to let go."""

    def _say(self, text: str) -> None:
        print(f"\n{text}", file=self._out, flush=True)


class SocketBoard:
    """A program at a socket: a robot, or an emulated rig.

    Raises:
        DeviceError: nobody listens there.
    """

    patience = 0.0

    def __init__(self, host: str, port: int) -> None:
        self._name = f"socket://{host}:{port}"
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_TIMEOUT)
        except OSError as error:
            raise DeviceError(
                f"hardware.board.presenter: nobody holds a board at {self._name}: {error.strerror or error}"
            ) from None
        self._socket.settimeout(ANSWER_TIMEOUT)
        self._lines = self._socket.makefile("rb")

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        """Ask for the board and wait until it is there.

        Raises:
            DeviceError: it cannot be, or the program is gone.
        """
        self._ask("present", T_fixed_board)

    def swing(self, T_fixed_board: RigidTransform) -> None:
        """Ask for the board to swing.

        Raises:
            DeviceError: it cannot, or the program is gone.
        """
        self._ask("swing", T_fixed_board)

    def close(self) -> None:
        """Hang up."""
        self._lines.close()
        self._socket.close()

    def _ask(self, what: str, T_fixed_board: RigidTransform | None) -> None:
        request = None if T_fixed_board is None else pose_dict(T_fixed_board)
        try:
            self._socket.sendall(json.dumps({what: request}).encode() + b"\n")
            line = self._lines.readline(LONGEST_ANSWER)
        except OSError as error:
            raise DeviceError(f"{self._name}: the board's holder does not answer: {error}") from None
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError):  # the latter of brackets without end
            said = f"said {line[:40]!r}" if line else "is gone"
            raise DeviceError(f"{self._name}: the board's holder {said}") from None
        if not (isinstance(answer, dict) and answer.get("ok") is True):
            reason = answer.get("error", "no reason given") if isinstance(answer, dict) else answer
            raise DeviceError(f"{self._name}: the board cannot be held there: {reason}")


def in_words(T_fixed_board: RigidTransform) -> str:
    """Tell a person where the board's first corner goes, and how the board is turned, as the fixed camera sees it."""
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
