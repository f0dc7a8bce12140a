"""Who holds the board before real cameras: what a person reads, and the socket protocol, byte for byte."""

import io
import json
import socket
import threading
from dataclasses import replace

import numpy as np
import pytest

from cotarget.calibration.session import CaptureRecorder
from cotarget.drivers.board import BoardSettings, PersonBoard, SocketBoard, in_words, make_board
from cotarget.emulators.serve import JsonLines
from cotarget.errors import DeviceError
from cotarget.geometry import pose
from tests.support.synthetic_rig import SyntheticRig, _Board

DEADLINE_S = 30.0  # for what should come at once


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        (
            pose([0.8, -0.3, 3.2], [0, 0, 0]),
            "3.2 m ahead of the fixed camera, its first corner 0.8 m to the right and 0.3 m above "
            "the middle of the view, facing the camera",
        ),
        (
            pose([-0.5, 0.2, 2.0], [0, 30, 0]),
            "0.5 m to the left and 0.2 m below the middle of the view, turned 30 degrees",
        ),
        (pose([0, 0, 2.0], [0, 0, 90]), "turned 90 degrees clockwise in its plane"),
    ],
)
def test_a_person_is_told_where(wanted, words):
    assert words in in_words(wanted)


def test_the_nearer_edge_is_told_right():
    """A turn about y (down) by +30 degrees takes x, to the right, towards -z: to the camera."""
    wanted = pose([0, 0, 2.0], [0, 30, 0])
    left, right = wanted.apply([[0.0, 0, 0], [0.8, 0, 0]])[:, 2]
    assert right < left
    assert "with its right edge nearer" in in_words(wanted)
    wanted = pose([0, 0, 2.0], [30, 0, 0])
    upper, lower = wanted.apply([[0.0, 0, 0], [0, 0.5, 0]])[:, 2]
    assert upper < lower
    assert "with its upper edge nearer" in in_words(wanted)


def test_a_person_has_patience_and_reads_all_wishes():
    out = io.StringIO()
    board = PersonBoard(out)
    assert board.patience > 10
    board.present(pose([0, 0, 2.0], [0, 0, 0]))
    board.present(None)
    board.close()
    assert out.getvalue().count("\n") == 4
    assert "take the board away" in out.getvalue()


@pytest.mark.wire
def test_a_program_is_asked_in_json_and_its_refusal_is_an_error():
    heard = []

    def answer(said):
        heard.append(said)
        return {"ok": True} if said["present"] is None else {"error": "out of reach"}

    with JsonLines(answer) as server:
        board = make_board(BoardSettings(f"socket://127.0.0.1:{server.port}"))
        assert board.patience == 0
        board.present(None)
        with pytest.raises(DeviceError, match="the board cannot be held there: out of reach"):
            board.present(pose([1, 2, 3], [10, 20, 30]))
        board.close()
    assert heard[0] == {"present": None}
    np.testing.assert_allclose(heard[1]["present"]["translation"], [1, 2, 3])
    np.testing.assert_allclose(heard[1]["present"]["rotvec_deg"], [10, 20, 30])


@pytest.mark.wire
def test_nobody_there_and_nobody_any_more_are_errors():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        board = SocketBoard("127.0.0.1", port)
        server.settimeout(DEADLINE_S)
        client, _ = server.accept()
        threading.Thread(target=lambda: (client.recv(1000), client.close()), daemon=True).start()
        with pytest.raises(DeviceError, match="is gone"):
            board.present(None)
        board.close()
    with pytest.raises(DeviceError, match="nobody holds a board at socket://"):
        SocketBoard("127.0.0.1", port)


@pytest.mark.wire
def test_brackets_without_end_are_no_answer():
    with socket.create_server(("127.0.0.1", 0)) as server:
        board = SocketBoard("127.0.0.1", server.getsockname()[1])
        server.settimeout(DEADLINE_S)
        client, _ = server.accept()
        client.sendall(b"[" * 60000 + b"\n")
        with pytest.raises(DeviceError, match=r"the board's holder said b'\[\[\["):
            board.present(None)
        board.close()
        client.close()


@pytest.mark.wire
def test_what_is_no_json_is_answered_and_the_server_goes_on():
    with (
        JsonLines(lambda said: {"twice": 2 * said["n"]}) as server,
        socket.create_connection(("127.0.0.1", server.port), DEADLINE_S) as client,
        client.makefile("rwb") as lines,
    ):
        for said in (b"nonsense\n", b"[" * 60000 + b"\n", b'{"m": 1}\n', b'{"n": 2}\n'):
            lines.write(said)
            lines.flush()
        *refused, well = (json.loads(lines.readline()) for _ in range(4))
    assert all("not understood" in reply["error"] for reply in refused)
    assert well == {"twice": 4}


class SlowHands(_Board):
    """Moves the board from the old pose to the wish within three seconds, as people do."""

    def present(self, T_fixed_board):
        rig = self.rig
        old = rig.placed[-1][1]
        start = T_fixed_board if old is None else old
        for k in range(1, 61):
            s = k / 60
            between = (1 - s) * start.translation + s * T_fixed_board.translation
            turned = start.rotation * (start.rotation.inv() * T_fixed_board.rotation) ** s
            rig.placed.append((rig.t + 3 * s, pose(between, turned.as_rotvec(degrees=True))))


def test_a_board_in_hands_is_waited_for():
    rig = SyntheticRig()
    rig.board = SlowHands(rig, patience=20.0)
    rig.placed.append((0.0, pose([-0.4, -0.25, 3.0], [0, 0, 0])))
    recorder = CaptureRecorder(rig, rig.board_config)
    recorder.start()
    begun = rig.t
    recorder.present(pose([-0.1, -0.1, 3.0], [0, 20, 0]))
    assert 3.0 < rig.t - begun < 6.0
    assert recorder.see_fixed() is not None


def test_a_board_that_nobody_brings_is_not_waited_for_without_end():
    rig = SyntheticRig()
    rig.board = replace(rig.board, patience=5.0)
    recorder = CaptureRecorder(rig, rig.board_config)
    recorder.start()
    begun = rig.t
    recorder.present(pose([0, 0, -3.0], [0, 0, 0]))
    assert 5.0 <= rig.t - begun < 7.0
