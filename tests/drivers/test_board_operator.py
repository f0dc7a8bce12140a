"""Who holds the board before real cameras: what a person reads, and the socket protocol, byte for byte."""

import contextlib
import io
import socket
import threading

import numpy as np
import pytest

from cotarget.drivers.board import BoardSettings, PersonBoard, SocketBoard, in_words, make_board, probe
from cotarget.emulators.serve import JsonLines
from cotarget.errors import DeviceError
from cotarget.geometry import pose

DEADLINE_S = 30.0  # for what should come at once


@pytest.mark.parametrize(
    ("translation", "rotvec_deg", "words"),
    [
        ([0.8, -0.3, 3.2], [0, 0, 0], ["3.2 m ahead", "0.8 m to the right", "0.3 m above", "facing the camera"]),
        ([-0.5, 0.2, 2.0], [0, 30, 0], ["0.5 m to the left", "0.2 m below", "30 degrees with its right edge nearer"]),
        ([0, 0, 2.0], [0, -30, 0], ["30 degrees with its left edge nearer"]),
        ([0, 0, 2.0], [30, 0, 0], ["30 degrees with its upper edge nearer"]),
        ([0, 0, 2.0], [-30, 0, 0], ["30 degrees with its lower edge nearer"]),
        ([0, 0, 2.0], [0, 0, 90], ["90 degrees clockwise in its plane"]),
        ([0, 0, 2.0], [0, 0, -90], ["90 degrees anticlockwise in its plane"]),
    ],
)
def test_a_person_reads_where_to_hold_the_board(translation, rotvec_deg, words):
    said = in_words(pose(translation, rotvec_deg))
    assert all(word in said for word in words)


@pytest.mark.parametrize(("axis", "corner"), [([0, 30, 0], [0.8, 0, 0]), ([30, 0, 0], [0, -0.5, 0])])
def test_the_named_edges_are_the_nearer_ones(axis, corner):
    """A turn about y (down) by +30 degrees takes x, to the right, towards -z, to the camera; one about x takes -y."""
    first, other = pose([0, 0, 2.0], axis).apply([[0.0, 0, 0], corner])[:, 2]
    assert other < first


def test_a_person_has_patience_and_reads_all_requests():
    out = io.StringIO()
    board = PersonBoard(out)
    assert board.patience > 10
    for request in (board.present, board.swing):
        request(pose([0, 0, 2.0], [0, 0, 0]))
    board.present(None)
    board.close()
    assert out.getvalue().count("\n") == 6
    assert "swing it" in out.getvalue()
    assert "take the board away" in out.getvalue()


def test_a_board_is_held_by_a_person_unless_a_socket_is_named():
    assert isinstance(make_board(BoardSettings()), PersonBoard)
    assert probe(BoardSettings()) == "a person"


@pytest.mark.wire
def test_a_program_is_asked_in_json_and_its_refusal_is_an_error():
    heard = []

    def answer(said):
        heard.append(said)
        return {"ok": True} if said.get("present", said) is None else {"error": "out of reach"}

    with JsonLines(answer) as server:
        settings = BoardSettings(f"socket://127.0.0.1:{server.port}")
        assert str(server.port) in probe(settings)
        with contextlib.closing(make_board(settings)) as board:
            assert board.patience == 0
            board.present(None)
            for request in (board.present, board.swing):
                with pytest.raises(DeviceError, match="out of reach"):
                    request(pose([1, 2, 3], [10, 20, 30]))
    assert heard[0] == {"present": None}
    for said, what in zip(heard[1:], ("present", "swing"), strict=True):
        np.testing.assert_allclose(said[what]["translation"], [1, 2, 3])
        np.testing.assert_allclose(said[what]["rotvec_deg"], [10, 20, 30])


@pytest.mark.wire
@pytest.mark.parametrize(
    ("answer", "said"), [(None, "is gone"), (b"[" * 60000 + b"\n", r"\[\[\["), (b"[]\n", "cannot be held there")]
)
def test_a_program_that_does_not_answer_as_it_should(answer, said):
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(DEADLINE_S)
        with contextlib.closing(SocketBoard("127.0.0.1", server.getsockname()[1])) as board:

            def serve():
                client, _ = server.accept()
                client.recv(1000)
                client.sendall(answer or b"")
                client.close()

            threading.Thread(target=serve, daemon=True).start()
            with pytest.raises(DeviceError, match=said):
                board.present(None)
        port = server.getsockname()[1]
    gone = SocketBoard("127.0.0.1", port)  # is asked for nothing yet, as by a rig that only follows
    with pytest.raises(DeviceError, match=r"^hardware\.board\.presenter: "):
        gone.present(None)
