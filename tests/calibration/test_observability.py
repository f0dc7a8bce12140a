"""What views leave undetermined: null spaces of a rig made of numbers, differentiated numerically, in words."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cotarget.calibration.observability import name_directions, weak_directions
from cotarget.camera import Intrinsics
from cotarget.errors import CalibrationError
from cotarget.geometry import RigidTransform, Rotation, pose
from experiments.calibration.synthetic.rig import Truth

POSE = ("rx", "ry", "rz", "tx", "ty", "tz")
LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
SIGMA_PX = 0.2
STEP = 1e-6  # rad and m
GRID = np.array([[x, y, 0.0] for y in np.linspace(-0.3, 0.3, 6) for x in np.linspace(-0.4, 0.4, 8)])  # [m]


def moved(T, step):
    return RigidTransform.from_components(T.translation + step[3:], Rotation.from_rotvec(step[:3]) * T.rotation)


def without_boards(by_shared, by_board):
    """Normal matrix of the shared parameters, every view's own board eliminated; lists of derivatives."""
    total = 0
    for S, B in zip(by_shared, by_board, strict=True):
        Q = np.linalg.qr(B)[0]
        S = S - Q @ (Q.T @ S)
        total = total + S.T @ S
    return total


def lens_normal(board_poses, focal=692.0):
    """Of fx fy cx cy k1 k2 p1 p2, from OpenCV's derivatives."""
    K = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1.0]])
    parts = []
    for T in board_poses:
        J = cv2.projectPoints(GRID, T.rotation.as_rotvec(), T.translation, K, np.array([-0.1, 0, 0, 0, 0.0]))[1]
        parts.append((J[:, 6:14], J[:, :6]))
    return without_boards(*zip(*parts, strict=True))


LENS_NAMES = [f"fixed.{name}" for name in LENS]


def test_boards_facing_the_camera_leave_its_focal_length_open():
    flat = [pose([x, y, 3.0], [0, 0, turn]) for x, y, turn in ((0.5, 0.3, 0), (-0.6, 0.2, 40), (0.1, -0.5, -70))]
    weak = weak_directions(lens_normal(flat), LENS_NAMES, SIGMA_PX**2)
    text = name_directions(LENS_NAMES, weak)
    assert text.startswith("the fixed camera's focal length")
    assert "tilt the boards" in text
    tilted = [pose([0.1, 0.1, 3.0], [a, b, 0]) for a, b in ((30, 0), (0, 30), (-30, 20), (20, -30))]
    assert not len(weak_directions(lens_normal(flat + tilted), LENS_NAMES, SIGMA_PX**2))


HAND_NAMES = [f"T_head_zoom.{name}" for name in POSE] + ["head.axis_offset", "head.squareness"]


def hand_normal(angles):
    """Of T_head_zoom, axis offset and squareness; two boards that the fixed camera sees as well place themselves."""
    truth = Truth()
    parts = []
    for board in (pose([0.3, -0.1, 3.5], [10, -20, 5]), pose([-0.8, 0.3, 6.0], [20, 15, 0])):

        def seen(step, board=board):
            at = replace(truth, hand=moved(truth.hand, step[:6]), dz=truth.dz + step[6], eps=truth.eps + step[7])
            x = moved(board, step[8:]).apply(GRID)
            images = [at.fixed.project(x)] + [at.zoom.project(at.in_zoom(x, *q)) for q in angles]
            return np.concatenate(images).ravel()

        J = np.stack([(seen(STEP * e) - seen(-STEP * e)) / (2 * STEP) for e in np.eye(14)], axis=1)
        parts.append((J[:, :8], J[:, 8:]))
    return without_boards(*zip(*parts, strict=True))


def lens_of(focal_px, size=(640, 480)):
    return Intrinsics(size, (focal_px, focal_px), (0.0, 0.0))


OF_HEAD = ("axis offset", "squareness")


def test_limits_of_use_scale_with_the_focal_length():
    """At 7000 px k1 hardly bends the image."""
    boards = [
        pose([x, y, z], [a, b, 0])
        for x, y, z, a, b in (
            (0.3, 0.1, 20, 30, 0),
            (-0.3, 0.2, 25, 0, 30),
            (0.2, -0.1, 15, -30, 20),
            (0, 0, 18, 20, -30),
        )
    ]
    normal = lens_normal(boards, 7000.0)
    assert "distortion" in name_directions(LENS_NAMES, weak_directions(normal, LENS_NAMES, SIGMA_PX**2))
    lenses = {"fixed": lens_of(7000.0)}
    weak = weak_directions(normal, LENS_NAMES, SIGMA_PX**2, lenses)
    assert "distortion" not in name_directions(LENS_NAMES, weak, lenses)


@pytest.mark.parametrize("width", [640, 1920, 3264])
@pytest.mark.parametrize(("edge_px", "undetermined"), [(49.0, False), (51.0, True)])
def test_limits_of_use_scale_with_the_image(width, edge_px, undetermined):
    """Of a lens in 640 x 480 px, whose edge is 360 px from the middle, or the same lens with finer pixels."""
    times = width / 640
    lenses = {"fixed": lens_of(600.0 * times, (width, width * 3 // 4))}
    for name, sigma in (("fixed.k1", edge_px / (600 * 0.6**3)), ("fixed.cx", edge_px * times)):
        weak = weak_directions(np.array([[1 / sigma**2]]), [name], 1.0, lenses)
        assert bool(len(weak)) == undetermined
    small = np.array([[0.2 * edge_px * times, 0.5]])  # little of the first one's limit, all of the other's
    assert "principal" not in name_directions(["fixed.cx", "T_zoom0_fixed.tx"], small, lenses)


@pytest.mark.parametrize(("angles", "begins", "free"), [
    ([(0.0, 0.0), (0.2, 0.0), (-0.3, 0.0)], "only pan moved",
     ("position along the pan axis", "rotation about the pan axis", *OF_HEAD, "add tilt")),
    ([(0.0, 0.0), (0.0, 0.2), (0.0, -0.1)], "only tilt moved",
     ("position along the tilt axis", "rotation about the tilt axis", *OF_HEAD, "add pan")),
    ([(0.0, 0.0)], "T_head_zoom's position, T_head_zoom's rotation", OF_HEAD),
    ([(0.0, 0.0), (0.2, 0.0), (-0.3, 0.1), (0.1, 0.25)], "", ()),
])  # fmt: skip
def test_head_that_moves_too_little_is_named(angles, begins, free):
    text = name_directions(HAND_NAMES, weak_directions(hand_normal(angles), HAND_NAMES, SIGMA_PX**2))
    assert text.startswith(begins)
    assert all(words in text for words in free)
    assert bool(text) == bool(begins)


@pytest.mark.parametrize(("name", "free", "add"), [
    ("T_zoom0_fixed.tz", "T_zoom0_fixed's position", "near and far"),
    ("zoom[2].pupil", "the zoom camera's stop 2's pupil's shift", "near and far at that focal length"),
    ("zoom.k1", "the zoom camera's distortion", "corners"), ("head.pan_scale", "the head's scale of pan", "add pan"),
    ("T_head_zoom.tz", "T_head_zoom's position", "nearer"),
])  # fmt: skip
def test_single_undetermined_parameter_is_named_with_advice(name, free, add):
    names = ["fixed.fx", name]
    text = name_directions(names, weak_directions(np.diag([1.0, 0.0]), names, 0.0))
    assert text.startswith(f"{free} is free; ")
    assert add in text


def test_no_direction_has_no_name_and_unknown_parameters_are_refused():
    assert name_directions(["fixed.fx"], np.empty((0, 1))) == ""
    with pytest.raises(CalibrationError, match=r"'fixed\.k9' is no parameter"):
        weak_directions(np.eye(1), ["fixed.k9"], 1.0)
