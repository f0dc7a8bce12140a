"""Sessions on a rig that draws its own boards: from knowing nothing to a calibration, and everything that can fail."""

import contextlib
import io
import itertools
import json
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from cotarget import __version__
from cotarget.board import draw_board
from cotarget.calibration.calibrate import calibrate
from cotarget.calibration.captures import INDEX, read_index
from cotarget.calibration.planning import GRID, Coverage, plan_poses
from cotarget.calibration.recorder import CaptureRecorder, with_stills
from cotarget.calibration.session import learn_fixed, learn_zoom
from cotarget.calibration.uncertainty import model_of
from cotarget.config import BoardConfig, parse_config
from cotarget.errors import CalibrationError, DeviceError, EmergencyStopError, HaltedError, StaleFrameError
from cotarget.geometry import pose
from cotarget.rig import Frame, ZoomState
from experiments.calibration.synthetic.aims import pointing_errors
from experiments.calibration.synthetic.rig import SIZE, Lens, Truth
from tests.support.rigs import alike, rig_of
from tests.support.simulated_clock import SimClock
from tests.support.synthetic_rig import PERIOD, SyntheticRig

BOARD = BoardConfig()


ROLLED = Truth(gamma=pose([-1.2, 0.1, -0.1], [1.0, 10.0, 40.0]), hand=pose([0.1, -0.15, 0.08], [2.0, 1.5, -38.0]))


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """One session with a rolled, toed-in zoom camera whose nominal focal length is wrong; its captures and progress."""
    truth = ROLLED
    directory = tmp_path_factory.mktemp("captures")
    progress = []
    rig = SyntheticRig(truth, reported=478 / 692)
    calibration = calibrate(
        rig, BOARD, captures_dir=directory, progress=lambda *args: progress.append(args), placements=18
    )
    return truth, calibration, directory, progress


def test_session_calibrates_an_unknown_rig(session):
    truth, calibration, _, _ = session
    errors = pointing_errors(calibration, truth, np.random.default_rng(5), 40)
    # Usual are 0.002 and 0.005 degrees; a mistake of numbering or of order is off by degrees.
    assert np.median(errors) < 0.01
    assert np.percentile(errors, 95) < 0.02


NEAR = np.radians(12.0)  # unknown distortion turns the first T by up to 8 degrees, the wrong pose of a board by tens


@pytest.mark.parametrize("truth", [
    ROLLED,
    # The board is first seen at the edge of the zoom image, where the unknown distortion bends it.
    Truth(
        gamma=pose([1.342, -0.244, 0.088], [-11.23, 12.68, -14.47]),
        hand=pose([0.114, 0.025, -0.015], [-3.08, -0.18, 15.43]),
        zoom=Lens(692.0, 693.0, 326.0, 235.0, (-0.25, 0.0, 0.0, 0.0, 0.0)),
    ),
], ids=["rolled", "aside"])  # fmt: skip
def test_the_first_model_of_a_session_is_near_the_truth(truth):
    """Each view of a flat board has two poses; with the wrong one T is turned by tens of degrees."""
    recorder = CaptureRecorder(SyntheticRig(truth, seed=6), BOARD)
    recorder.start()
    model = learn_zoom(recorder, learn_fixed(recorder, np.random.default_rng(6)))
    for found, true in ((model.head.T_zoom0_fixed, truth.gamma), (model.head.T_head_zoom, truth.hand)):
        assert (found.rotation * true.rotation.inv()).magnitude() < NEAR


def test_the_plan_covers_both_images_near_and_far(session):
    _, calibration, _, _ = session
    for camera in ("fixed", "zoom"):
        coverage = Coverage(SIZE)
        views = [view for view in calibration.views if view.camera == camera]
        for view in views:
            coverage.add(view.corners_px)
        corners = [coverage.counts[i : i + 2, j : j + 2].sum() for i in (0, GRID[0] - 2) for j in (0, GRID[1] - 2)]
        assert min(corners) > 0, f"the {camera} camera saw no board in one of its image's corners"
        assert np.mean(coverage.counts > 0) > 0.8
        widths = [np.ptp(view.corners_px, axis=0).max() for view in views]
        assert max(widths) > 1.8 * min(widths)
    assert calibration.residuals.pairs >= 8


def test_planned_head_poses_are_within_the_limits(session):
    model, T_fixed_board = model_of(session[1]), pose([-0.4, -0.25, 4.0], [0, 0, 0])

    def planned(limits):
        rng = np.random.default_rng(0)
        return np.array(plan_poses(model, T_fixed_board, BOARD, Coverage(SIZE), limits, 4, rng, 5.0))

    anywhere = planned(SyntheticRig().limits)
    assert anywhere.shape == (4, 2)
    low, high = anywhere.mean(axis=0) - 0.15, anywhere.mean(axis=0) + 0.15
    narrow = planned(alike((low[0], high[0]), (low[1], high[1]), 2.6, 3.6, 0.0009))
    assert len(narrow)
    assert ((narrow >= low) & (narrow <= high)).all()


def test_index_lists_every_image_at_once(tmp_path):
    """Also those of the placement that is under way: in the zoom stage one of them holds many."""
    recorder = CaptureRecorder(SyntheticRig(), BOARD, tmp_path)
    recorder.start()
    recorder.present(pose([-0.4, -0.25, 3.0], [0, 0, 0]))
    for count in range(1, 4):
        recorder.see_fixed()
        assert [capture.source for capture in read_index(tmp_path).captures] == sorted(
            path.name for path in tmp_path.glob("*.png")
        )
        assert len(read_index(tmp_path).captures) == count
    with pytest.raises(CalibrationError, match="already holds captures"):
        CaptureRecorder(SyntheticRig(), BOARD, tmp_path).start()


def test_session_writes_its_config_and_commands(tmp_path):
    config = parse_config({"hardware": {"fixed": {"password": "secret", "url": "http://me:secret@server"}}})
    rig = SyntheticRig()
    rig.config = config
    recorder = CaptureRecorder(rig, BOARD, tmp_path)
    recorder.start()
    recorder.present(pose([-0.4, -0.25, 3.0], [0, 20, 0]))
    recorder.turn(0.25, -0.1)
    session = json.loads((tmp_path / "session.json").read_text())
    assert session["versions"]["cotarget"] == __version__
    assert parse_config(session["config"]).hardware.zoom == config.hardware.zoom
    assert "secret" not in (tmp_path / "session.json").read_text()
    commands = [json.loads(line) for line in (tmp_path / "commands.jsonl").read_text().splitlines()]
    assert [each["do"] for each in commands] == ["zoom", "turn", "present", "turn"]
    assert commands[2]["asked"] == {
        "translation": [-0.4, -0.25, 3.0],
        "rotvec_deg": pytest.approx([0, 20, 0], abs=0.01),
    }
    assert commands[3]["asked"] == [0.25, -0.1]
    assert commands[3]["got"] == pytest.approx([0.25, -0.1], abs=1e-3)
    assert all(a["t"] <= b["t"] for a, b in itertools.pairwise(commands))


NARROW = alike((-0.4, 0.4), (-0.4, 0.4), 2.6, 3.6, 0.0009)


@pytest.mark.parametrize(("broken", "message"), [
    ({"short_of": 0.5}, "the head stands at"),
    ({"frozen_camera": True}, "zoom camera turned"),
    ({"reported": 0.4}, "the zoom lens reports a focal length of 267 px"),
    ({"reported": 3.0}, "the zoom lens reports a focal length of 2001 px"),
    ({"truth": Truth(gamma=pose([0, 0, 0], [0, 180, 0])), "limits": NARROW}, "the zoom camera does not see the board"),
    ({"board_config": BoardConfig(corners=(7, 6))}, "the fixed camera does not see the 9x6 board"),
])  # fmt: skip
def test_broken_rig_is_refused_in_one_line(broken, message):
    with pytest.raises(CalibrationError, match=message) as caught:
        calibrate(SyntheticRig(**broken), BOARD)
    assert "\n" not in str(caught.value)


def test_wrong_nominal_focal_length_is_corrected(session):
    shortest = session[1].zoom_head.lens.stops[0]
    assert shortest.focal_px[0] == pytest.approx(session[0].zoom.fx, rel=0.01)  # 8 placements know it to 0.2 %


@pytest.mark.parametrize("halts", [1, 2, 3])
def test_a_head_that_was_halted_on_its_way_is_sent_again(halts):
    """The halt raises no error, but the head stands short of its goal."""
    rig = SyntheticRig(halts=halts)
    with pytest.raises(CalibrationError, match="the head stands at") if halts > 2 else contextlib.nullcontext():
        CaptureRecorder(rig, BOARD).turn(0.5, 0.1)
        assert rig.pose == pytest.approx((0.5, 0.1), abs=rig.limits.pan.step)


class Failing:
    """A rig whose moves or frames fail the first times, as one in real time does on a busy machine."""

    def __init__(self, *, moves=(), frames=()):
        self.rig = SyntheticRig()
        self.sent, self.seen = [], []
        self.rig.head.move = self._failing(self.rig.head.move, list(moves), self.sent)
        for camera in (self.rig.fixed, self.rig.zoom):
            camera.read = self._failing(camera.read, list(frames), self.seen)

    def _failing(self, act, errors, log):
        def acts(*args, **options):
            log.append(args or options)
            if errors:
                raise errors.pop(0)
            return act(*args, **options)

        return acts


HALTED, LATE = HaltedError("the move was halted"), StaleFrameError("the newest frame is 0.70 s old")


@pytest.mark.parametrize("times", [1, 2, 3])
def test_a_move_that_the_watchdog_halted_is_commanded_again(tmp_path, times):
    made = Failing(moves=[HALTED] * times)
    with pytest.raises(HaltedError) if times > 2 else contextlib.nullcontext():
        CaptureRecorder(made.rig, BOARD, tmp_path).turn(0.5, 0.1)
        assert made.rig.pose == pytest.approx((0.5, 0.1), abs=made.rig.limits.pan.step)
    assert made.sent == [(0.5, 0.1)] * min(times + 1, 3)
    logged = [json.loads(line)["got"] for line in (tmp_path / "commands.jsonl").read_text().splitlines()]
    assert [got is None for got in logged] == [True] * times + [False] * (times < 3)


@pytest.mark.parametrize("error", [EmergencyStopError("emergency stop: a bird"), DeviceError("pan hit its limit")])
def test_a_head_that_was_stopped_is_not_sent_again(error):
    """Nor where the operator stops it while a frame is late."""
    made = Failing(moves=[error])
    with pytest.raises(type(error), match=str(error)):
        CaptureRecorder(made.rig, BOARD).turn(0.5, 0.1)
    assert made.sent == [(0.5, 0.1)]
    made = Failing(frames=[LATE, LATE])
    recorder = CaptureRecorder(made.rig, BOARD)
    recorder.turn(0.5, 0.1)
    made.sent.clear()

    def stopped(*wish, wait):
        made.sent.append(wish)
        raise error

    made.rig.head.move = stopped
    with pytest.raises(type(error), match=str(error)):
        recorder.see_zoom()
    assert (len(made.sent), len(made.seen)) == (1, 1)


@pytest.mark.parametrize("camera", ["fixed", "zoom"])
@pytest.mark.parametrize("times", [1, 2, 3])
def test_late_frame_is_read_again_after_the_head_is_sent_again(camera, times):
    made = Failing(frames=[LATE] * times)
    recorder = CaptureRecorder(made.rig, BOARD)
    recorder.turn(0.5, 0.1)
    pushed = made.rig.pose
    made.rig.pose = (0.4, 0.1)  # as after a halt
    with pytest.raises(StaleFrameError) if times > 2 else contextlib.nullcontext():
        {"fixed": recorder.see_fixed, "zoom": recorder.see_zoom}[camera](expected=False)
        assert made.rig.pose == pushed
    assert len(made.seen) == min(times + 1, 3)
    after = [each["newer_than"] for each in made.seen]
    assert all(a < b for a, b in itertools.pairwise(after))  # not the same old frame once more


@pytest.mark.parametrize(("real_time", "settle"), [(False, 0.05), (True, 0.5)])
def test_an_image_counts_some_time_after_the_head_stands(real_time, settle):
    made = Failing()
    made.rig.spec = replace(made.rig.spec, real_time=real_time)
    recorder = CaptureRecorder(made.rig, BOARD)
    recorder.turn(0.5, 0.1)
    recorder.see_fixed(expected=False)
    assert made.seen[0]["newer_than"] == pytest.approx(made.rig.arrives + settle)


class Interrupted:
    """A rig whose user presses Ctrl-C at its n-th frame, and whose board's holder is gone by then."""

    def __init__(self, frames):
        self.rig, self.log = SyntheticRig(), []
        read, present = self.rig.fixed.read, self.rig.board.present

        def interrupted(*args, **options):
            if self.rig.frames >= frames:
                raise KeyboardInterrupt
            return read(*args, **options)

        def gone(wish):
            if wish is None:
                self.log.append("board")
                raise DeviceError("the board holder is gone")
            present(wish)

        self.rig.fixed.read, self.rig.board.present = interrupted, gone
        self.rig.head.halt = lambda: self.log.append("halt")


@pytest.mark.parametrize("can_halt", [True, False])
def test_an_interrupted_session_halts_the_head_first_and_keeps_its_captures(tmp_path, caplog, can_halt):
    made = Interrupted(frames=6)
    halt = made.rig.head.halt

    def halts():
        halt()
        if not can_halt:
            raise DeviceError("the line is lost")

    made.rig.head.halt = halts
    with pytest.raises(KeyboardInterrupt):  # hidden by no error while the session is broken off
        calibrate(made.rig, BOARD, captures_dir=tmp_path)
    assert made.log == ["halt", "board"]
    assert (tmp_path / INDEX).exists()
    assert "while the session was broken off: the board holder is gone" in caplog.text


@pytest.mark.parametrize(("terminal", "given"), [(True, False), (False, False), (True, True)])
def test_calibration_shows_one_line_of_progress_on_a_terminal(terminal, given, monkeypatch):
    """By default; anything else gets it by a function of its own."""
    monkeypatch.setattr("sys.stderr", stderr := io.StringIO())
    stderr.isatty = lambda: terminal
    seen, rig = [], SyntheticRig()
    rig.board = SimpleNamespace(present=lambda T_fixed_board: None, patience=0.0)
    with pytest.raises(CalibrationError, match="does not see the 9x6 board"):
        calibrate(rig, BOARD, progress=(lambda *what: seen.append(what)) if given else None)
    shown = stderr.getvalue()
    assert bool(seen) == given
    assert ("looking for the board with the fixed camera" in shown) == (terminal and not given)


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


FACTOR = 10.2  # 3264 over 320: the PowerShot S5 IS
EXPOSED_AFTER = 0.3  # from asking for a still to its exposure [s]


class Viewfinder:
    """A camera with stills of another size than its viewfinder, in whose pixels focal lengths are."""

    size, focal_range = (320, 240), (334.0, 4013.0)

    def __init__(self, clock, still_size):
        self.clock, self.still_size, self.sent = clock, still_size, []

    def zoom(self, focal_px):
        self.sent.append(focal_px)
        return focal_px + 1.0

    def state(self):
        return ZoomState(500.0, True, 7.0)

    def capture(self):
        self.clock.sleep_until(self.clock.now() + EXPOSED_AFTER)
        return Frame(np.zeros((*self.still_size[::-1], 3), np.uint8), self.clock.now())


@pytest.fixture
def rig():
    clock = SimClock()
    zoom = Viewfinder(clock, (3264, 2448))
    return rig_of(SimpleNamespace(fixed=object(), zoom=zoom, head=object(), clock=clock, board=object()))


def test_stills_change_only_the_zoom_camera(rig):
    closed = []
    rig = replace(rig, release=lambda: closed.append(True))
    assert with_stills(replace(rig, zoom=Viewfinder(rig.clock, Viewfinder.size))).zoom.size == Viewfinder.size
    with with_stills(rig) as stills:
        assert (stills.fixed, stills.head, stills.clock, stills.board) == (rig.fixed, rig.head, rig.clock, rig.board)
        assert not closed
    assert closed == [True]


def test_focal_lengths_are_in_pixels_of_the_still(rig):
    stills = with_stills(rig)
    zoom, spec = stills.zoom, stills.spec.zoom
    assert (spec.size, spec.focal_range) == (zoom.size, zoom.focal_range)
    assert zoom.size == zoom.still_size == (3264, 2448)
    assert zoom.focal_range == pytest.approx((334.0 * FACTOR, 4013.0 * FACTOR))
    assert zoom.zoom(6800.0) == pytest.approx(6800.0 + FACTOR)  # the lens really reaches one pixel more
    assert rig.zoom.sent == pytest.approx([6800.0 / FACTOR])
    assert zoom.state() == ZoomState(pytest.approx(500.0 * FACTOR), True, 7.0)


def test_frames_are_stills_taken_after_the_wanted_time(rig):
    """As when a head has just stopped, and its vibrations are to be over."""
    zoom = with_stills(rig).zoom
    for frame in (zoom.read(), zoom.capture(), zoom.read(newer_than=0.0)):
        assert frame.image.shape == (2448, 3264, 3)
    assert zoom.read(newer_than=102.0, timeout=5.0).t == pytest.approx(102.0 + EXPOSED_AFTER)


def test_still_wanted_too_far_ahead_is_refused(rig):
    with pytest.raises(StaleFrameError):
        with_stills(rig).zoom.read(newer_than=109.0, timeout=5.0)
    assert rig.clock.now() == 100.0
