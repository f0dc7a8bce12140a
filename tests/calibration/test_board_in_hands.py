"""A session waits for the person who brings the board, and no longer than that takes."""

from dataclasses import dataclass, replace

import numpy as np

from cotarget.board import draw_board
from cotarget.calibration.recorder import CaptureRecorder
from cotarget.config import BoardConfig
from cotarget.geometry import pose
from cotarget.rig import Frame
from tests.support.synthetic_rig import PERIOD, SyntheticRig


@dataclass
class SlowHands:
    """Moves the board from the old pose to the requested one within three seconds, as people do."""

    rig: SyntheticRig
    patience: float = 20.0

    def present(self, T_fixed_board):
        rig = self.rig
        old = rig.placed[-1][1]
        start = T_fixed_board if old is None else old
        for k in range(1, 61):
            s = k / 60
            between = (1 - s) * start.translation + s * T_fixed_board.translation
            turned = start.rotation * (start.rotation.inv() * T_fixed_board.rotation) ** s
            rig.placed.append((rig.t + 3 * s, pose(between, turned.as_rotvec(degrees=True))))


def started(rig):
    recorder = CaptureRecorder(rig, rig.board_config)
    recorder.start()
    return recorder


def test_session_waits_until_a_held_board_is_still():
    rig = SyntheticRig()
    rig.board = SlowHands(rig)
    rig.placed.append((0.0, pose([-0.4, -0.25, 3.0], [0, 0, 0])))
    recorder, begun = started(rig), rig.t
    recorder.present(pose([-0.1, -0.1, 3.0], [0, 20, 0]))
    assert 3.0 < rig.t - begun < 6.0
    assert recorder.see_fixed() is not None


def test_session_stops_waiting_for_a_board_after_its_patience():
    rig = SyntheticRig()
    rig.board = replace(rig.board, patience=5.0)
    recorder, begun = started(rig), rig.t
    recorder.present(pose([0, 0, -3.0], [0, 0, 0]))
    assert 5.0 <= rig.t - begun < 7.0


def test_shaking_hands_count_as_still_whatever_the_image_size():
    """A board in an image of 2560 px that moves to and fro by 0.25 px of 640."""
    rig = SyntheticRig()
    rig.board = replace(rig.board, patience=20.0)
    rig.fixed.size = (2560, 1920)
    board = draw_board(rig.board_config, 160)

    def read(newer_than, timeout):
        rig.t = max(rig.t, newer_than) + PERIOD
        rig.frames += 1
        return Frame(np.roll(board, rig.frames % 2 + 60 * (len(rig.placed) - 1), axis=1), rig.t)

    rig.fixed.read = read
    recorder, begun = started(rig), rig.t
    recorder.present(pose([0, 0, 2.0], [0, 0, 0]))
    assert rig.t - begun < 2.0


def test_a_charuco_board_seen_in_part_counts_as_still():
    board = BoardConfig("charuco", (8, 6), 0.1)
    rig = SyntheticRig(board_config=board)
    rig.board = replace(rig.board, patience=20.0)
    before, after = (draw_board(board, 40)[:, left:] for left in (150, 170))  # without two columns of corners

    def read(newer_than, timeout):
        rig.t = max(rig.t, newer_than) + PERIOD
        return Frame(before if len(rig.placed) == 1 else after, rig.t)

    rig.fixed.read = read
    recorder, begun = started(rig), rig.t
    recorder.present(pose([0, 0, 2.0], [0, 0, 0]))
    assert rig.t - begun < 2.0
