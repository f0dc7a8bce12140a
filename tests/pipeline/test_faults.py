"""The pipeline and what goes wrong: frames, the zoom camera, targets that are many, out of reach or not the chosen one.

Nothing ends in a crash, a head that runs away, or a Step that does not say what is wrong.
"""

import itertools
import math
from contextlib import nullcontext
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from cotarget.config import RigConfig as Config
from cotarget.config import SafetyConfig, SimConfig
from cotarget.control.selection import POLICIES, Chosen
from cotarget.detection import Detections
from cotarget.errors import CotargetError, DeviceError, StaleFrameError
from cotarget.evaluation import TruthDetector, true_calibration
from cotarget.fusion import FusionSettings
from cotarget.pipeline import GONE_S, STALE_S, WAIT_S, State, follow
from cotarget.rig import READ_TIMEOUT_S, Detection, Frame
from cotarget.sim.world import SimWorld
from tests.support.formula_rig import (
    BOOK,
    CALIBRATION,
    DELAY,
    FIXED,
    FRAME_S,
    LATENCY,
    RATE_HZ,
    STEP,
    WIDE,
    Both,
    FormulaRig,
    Seer,
    crossing,
    off,
    run,
    spans,
    still,
)
from tests.support.rigs import guarded, rig_of

FAULT = 1.5  # when it happens [s]; by then the target is followed
# The target crosses at 2 m/s, 10 m away. A command leads the head no farther than 0.15 s of the target's way, what the
# target has gone since its light fell, and its own way of braking.
RATE = 0.2
FARTHEST = RATE * (LATENCY + DELAY + 0.15 + FRAME_S) + RATE**2 / (2 * WIDE.pan.acceleration) + STEP


@dataclass
class Faulty:
    """A camera whose answers are changed on their way.

    Attributes:
        camera: the real one.
        change: makes another answer of ``read``, its arguments and the rig's time; by default none.
    """

    camera: object
    change: object = field(default=lambda read, t, newer_than, timeout: read(newer_than, timeout))

    def __getattr__(self, name):
        return getattr(self.camera, name)

    def read(self, newer_than=None, timeout=1.0):
        return self.change(self.camera.read, self.camera.rig.t, newer_than, timeout)


def attempt(rig, seer, seconds, selector=None, safe=False):
    """Follow until an error, behind the safety layer if asked; the Steps before it, and the error."""
    steps, error = [], None
    if safe:
        rig.head.halt = lambda: [axis.halt(rig.t) for axis in (rig.pan, rig.tilt)]
        rig.close = lambda: None
    try:
        with guarded(rig, SafetyConfig()) if safe else nullcontext(rig_of(rig)) as each:
            for step in follow(each, CALIBRATION, BOOK, seer, selector=selector, seconds=seconds):
                steps.append(step)
    except CotargetError as raised:
        error = raised
    assert "\n" not in str(error)
    return steps, error


def assert_it_comes_to_rest(rig, since):
    """The head goes on from where it was at a time for no longer than its last command says, and stands then."""
    way = rig.pose(math.inf)[0] - rig.pose(since)[0]
    assert abs(way) < FARTHEST
    assert rig.pan.motor(since + 0.5)[1] == 0.0
    assert all(
        low <= q <= high for q, (low, high) in zip(rig.pose(math.inf), (axis.range for axis in WIDE.axes), strict=True)
    )


# Frames of the fixed camera


def again(frames):
    """The same frame once more, whatever is asked for."""

    def change(read, t, newer_than, timeout):
        if t > FAULT:
            return frames[-1]
        frames.append(read(newer_than, timeout))
        return frames[-1]

    return change


def shifted(by):
    """Frames whose times jump by so much [s]."""

    def change(read, t, newer_than, timeout):
        known = newer_than is None or t <= FAULT + LATENCY + FRAME_S or math.isnan(newer_than - by)
        asked = newer_than if known else newer_than - by
        frame = read(asked, timeout)
        return replace(frame, t=frame.t + by) if frame.t > FAULT else frame

    return change


@pytest.mark.parametrize("safe", [False, True])
@pytest.mark.parametrize(("change", "message"), [
    (None, "no new frame"), (again, "its frames repeat, or its clock has jumped"),
    (shifted(-1.0), "its frames repeat, or its clock has jumped"), (shifted(100.0), "in the future; mind the clock"),
    (shifted(math.nan), "gave a frame of nan s"),
])  # fmt: skip
def test_frames_that_stop_repeat_or_jump_in_time_end_the_run(change, message, safe):
    rig = FormulaRig(dropped=(math.inf if change else FAULT, 100.0))
    if change:
        rig.fixed = Faulty(rig.fixed, change([]) if change is again else change)
    steps, error = attempt(rig, Seer(crossing), 5.0, safe=safe)
    assert isinstance(error, StaleFrameError)
    assert safe or message in str(error)  # the safety layer has words of its own
    assert steps[-1].state is State.FOLLOWING
    assert_it_comes_to_rest(rig, steps[-1].t)
    assert all(step.t < FAULT + LATENCY + 2 * FRAME_S for step in steps)  # none acts on them


@pytest.mark.parametrize(("spoil", "reported"), [
    (lambda last, frame: last, "frames repeat, or its clock has jumped, this one is 0.0"),
    (lambda last, frame: replace(frame, t=frame.t - 0.2), "frames repeat, or its clock has jumped, this one is 0.0"),
    (lambda last, frame: replace(frame, t=frame.t + 5.0), "in the future, mind the clock, this one is 0.0"),
])  # fmt: skip
@pytest.mark.parametrize("safe", [False, True])
def test_a_frame_that_repeats_or_jumps_is_passed_over_and_told(spoil, reported, safe):
    rig, frames, spoilt = FormulaRig(), [], []

    def change(read, t, newer_than, timeout):
        frame = read(newer_than, timeout)
        if t > FAULT and not spoilt:
            spoilt.append(spoil(frames[-1], frame))
            return spoilt[0]
        frames.append(frame)
        return frame

    rig.fixed = Faulty(rig.fixed, change)
    steps, error = attempt(rig, Seer(crossing), 3.0, safe=safe)
    assert error is None
    (said,) = [step for step in steps if "this one is" in step.reason]
    assert said.t == pytest.approx(FAULT + LATENCY, abs=2 * FRAME_S)
    assert spoilt[0].t not in {step.fixed.t for step in steps[steps.index(said) :]}
    if not safe:  # who reads for the safety layer says it in words of its own
        assert reported in said.reason
    assert np.max(np.diff([step.fixed.t for step in steps])) < 3 * FRAME_S
    assert {step.state for step in steps if step.t > FAULT} == {State.FOLLOWING}
    assert off(rig, crossing, rig.t) < RATE * FRAME_S


def test_time_that_leaps_for_all():
    """The program stood still for 5 s, and the target is elsewhere: it is a new one, and nothing is made of the gap."""
    rig, gone = FormulaRig(), []

    def change(read, t, newer_than, timeout):
        if t > FAULT and not gone:
            gone.append(t)
            rig.t += 5.0
        return read(newer_than, timeout)

    rig.fixed = Faulty(rig.fixed, change)
    steps = run(rig, Seer(lambda t: crossing(t) if t < 2 * FAULT else still(t)), 9.0)
    before, after = ([s for s in steps if (s.t <= gone[0]) == early] for early in (True, False))
    assert [state for state, _ in spans(after)][-1] is State.FOLLOWING
    assert [{s.target.id for s in part if s.target is not None} for part in (before, after)] == [{1}, {2}]
    assert off(rig, still, rig.t) < STEP
    there = rig.pose(math.inf)[0]
    low, high = sorted((before[-1].head.pan, there))
    assert all(low - FARTHEST < pan < high + FARTHEST for t, pan, *_ in rig.moves if t > gone[0])


def test_times_that_jitter():
    """A frame of a nanosecond after another is no reason to hurry."""
    rig, odd = FormulaRig(), []

    def change(read, t, newer_than, timeout):
        frame = read(newer_than, timeout)
        if newer_than is not None and len(odd) % 2:
            frame = replace(frame, t=newer_than + 1e-9)
        odd.append(frame)
        return frame

    rig.fixed = Faulty(rig.fixed, change)
    steps = run(rig, Seer(crossing), 3.0)
    assert steps[-1].state is State.FOLLOWING
    ways = np.diff([step.head.pan for step in steps])
    assert np.abs(ways[-20:]).max() < 2 * RATE * FRAME_S


@pytest.mark.parametrize("camera", ["fixed", "zoom"])
def test_frames_that_change_their_size(camera):
    rig = FormulaRig()

    def change(read, t, newer_than, timeout):
        frame = read(newer_than, timeout)
        return Frame(np.zeros((240, 320, 3), np.uint8), frame.t) if t > FAULT else frame

    setattr(rig, camera, Faulty(getattr(rig, camera), change))
    steps, error = attempt(rig, Seer(crossing), 5.0)
    assert isinstance(error, DeviceError)
    assert str(error).startswith(f"the {camera} camera gave a frame of 320x240")
    assert_it_comes_to_rest(rig, steps[-1].t)


def frozen(rig, camera, since=FAULT, repeated=True):
    """A rig one of whose cameras gives its first picture again from a fault on, with new times."""
    kept = []

    def change(read, t, newer_than, timeout):
        frame = read(newer_than, timeout)
        kept.append(frame.image)
        return replace(frame, image=kept[0].copy(), repeated=repeated) if t > since else frame

    setattr(rig, camera, Faulty(getattr(rig, camera), change))
    return rig


def test_a_picture_that_stays_the_same_is_told():
    """A server that repeats its last picture with new times: what is seen in it says nothing of what is there."""
    rig = frozen(FormulaRig(), "fixed")
    steps = run(rig, Seer(lambda t: crossing(min(t, FAULT))), FAULT + 3.0)
    reported = [step for step in steps if "the fixed camera has shown the same picture for" in step.reason]
    assert reported[0].t == pytest.approx(FAULT + READ_TIMEOUT_S + LATENCY, abs=2 * FRAME_S)
    assert reported == steps[-len(reported) :]
    assert rig.pan.motor(rig.t)[1] == 0.0


# The zoom camera


def blind(rig, since, until=math.inf, waits=0.0):
    """A rig whose zoom camera gives nothing in between, after making who asks wait for a part of the timeout."""

    def change(read, t, newer_than, timeout):
        if since <= t < until:
            rig.t += waits * timeout
            raise StaleFrameError("no frame from the zoom camera: it is lost; reconnecting")
        return read(newer_than, timeout)

    rig.zoom = Faulty(rig.zoom, change)
    return rig


@pytest.mark.parametrize("waits", [0.0, 1.0])
def test_a_zoom_camera_that_is_blind_for_a_while_stops_nothing(waits):
    """The wide view alone keeps the head on the target, and every Step says what is missing."""
    rig = blind(FormulaRig(), FAULT, FAULT + 1.0, waits)
    steps, errors = [], []
    for step in follow(rig_of(rig), CALIBRATION, BOOK, Seer(crossing), seconds=3.5):
        steps.append(step)
        errors.append(off(rig, crossing, step.t))
    without = [s for s in steps if FAULT <= s.t - waits * WAIT_S < FAULT + 1.0]
    last = [s for s in steps if s not in without and s.t < FAULT + 0.5][-1]
    assert len(without) == pytest.approx(1.0 * RATE_HZ, abs=1)  # at every frame of the wide view
    for step in without:
        assert step.state is State.FOLLOWING
        assert step.zoom is last.zoom
        assert "the zoom camera has shown nothing new for" in step.reason
        assert step.reason.endswith("it is lost, reconnecting")
        assert step.found is None
    assert not [s for s in steps if s not in without and "nothing new" in s.reason]
    assert steps[-1].zoom.t > last.zoom.t + 1.0
    assert np.mean(errors[steps.index(without[5]) :]) < RATE * FRAME_S / 4 + STEP  # as in test_loop, where it sees


def test_a_zoom_camera_that_repeats_its_frame_is_told():
    """Some frames the same are usual, where it is slower than the wide one."""
    rig, kept = FormulaRig(), []

    def change(read, t, newer_than, timeout):
        if t > FAULT:
            return kept[-1]
        kept.append(read(newer_than, timeout))
        return kept[-1]

    rig.zoom = Faulty(rig.zoom, change)
    steps = run(rig, Seer(crossing), 3.0)
    reported = [step for step in steps if "the zoom camera has shown nothing new for" in step.reason]
    assert reported[0].t == pytest.approx(FAULT + STALE_S, abs=2 * FRAME_S)
    assert reported == steps[-len(reported) :]
    assert {step.state for step in reported} == {State.FOLLOWING}


class Asked:
    """A finder that notes the times of the zoom frames that it is asked to look at, and finds nothing."""

    def __init__(self):
        self.times = []

    def store(self, frame, detection, mask=None):
        del frame, detection, mask

    def fixed_view_at(self, t):
        return t

    def find(self, frame, *expected):
        del expected
        self.times.append(frame.t)


def test_a_zoom_picture_that_stays_the_same_is_told_and_not_looked_at_again():
    """What an old picture shows beside the middle would lead the head off a target that the wide view still sees."""
    rig, asked = frozen(FormulaRig(), "zoom"), Asked()
    steps = run(rig, Seer(crossing), FAULT + 2.0, finder=lambda *_: asked)
    reported = [step for step in steps if "the zoom camera has shown the same picture for" in step.reason]
    assert reported[0].t == pytest.approx(FAULT + READ_TIMEOUT_S + LATENCY, abs=2 * FRAME_S)
    assert reported == steps[-len(reported) :]
    assert {step.state for step in reported} == {State.FOLLOWING}
    assert len(asked.times) > 1.0 * RATE_HZ  # until then at every frame
    assert asked.times[-1] == pytest.approx(FAULT, abs=2 * FRAME_S + LATENCY)


@pytest.mark.parametrize(("path", "since", "repeated"), [(crossing, FAULT, False), (still, 0.0, True)])
def test_pictures_that_stay_the_same_are_looked_at_where_the_cameras_work(path, since, repeated):
    """A video codec repeats the picture of a quiet scene to the last bit; nothing moves in one without noise."""
    rig, asked = FormulaRig(), Asked()
    for camera in ("fixed", "zoom"):
        frozen(rig, camera, since, repeated)
    steps = run(rig, Seer(path), FAULT + 2.0, finder=lambda *_: asked)
    assert asked.times[-1] == steps[-1].zoom.t
    assert not [step for step in steps if "the zoom camera has shown the same picture" in step.reason]


def test_a_zoom_camera_that_is_dead_for_good_is_an_error():
    rig = blind(FormulaRig(), FAULT)
    steps, error = attempt(rig, Seer(still), 30.0)
    assert isinstance(error, StaleFrameError)
    assert str(error).startswith("the zoom camera has shown nothing new for 10.")
    assert steps[-1].t == pytest.approx(FAULT + GONE_S, abs=0.2)
    assert all("nothing new" in step.reason for step in steps if step.t > FAULT + WAIT_S)
    assert rig.pan.motor(rig.t)[1] == 0.0


def test_a_zoom_camera_that_never_gave_a_frame_is_refused_before_anything_moves():
    rig = blind(FormulaRig(), 0.0)
    steps, error = attempt(rig, Seer(still), 5.0)
    assert isinstance(error, StaleFrameError)
    assert not steps
    assert not rig.moves


def test_a_zoom_frame_that_is_there_costs_no_time():
    """In the simulation, where every wait is time that passes."""
    config = Config(sim=SimConfig(scene="indoor", targets=("book",)))
    world = SimWorld(config, rendered=())
    truth, target = world.truth(), config.target("book")
    with guarded(world.rig, config.safety) as rig:
        detector = TruthDetector(truth, 0)
        steps = list(follow(rig, true_calibration(world), target, detector, seconds=1.0))
    assert [step.t - step.fixed.t for step in steps] == pytest.approx([config.sim.fixed.latency_s] * len(steps))
    assert all(step.zoom.t == pytest.approx(step.fixed.t) for step in steps)


# Targets that are many, out of reach, or not the chosen one


class Crowd:
    """Sees many books on a grid, 10 m away, all moving to the right and left in step."""

    mask = None

    def __init__(self, columns=10, rows=10, swing=0.3):
        v, u = np.mgrid[:rows, :columns].reshape(2, -1)
        self.places = np.stack([(u - (columns - 1) / 2) * 0.85, (v - (rows - 1) / 2) * 0.6, 10.0 + 0.0 * u], axis=1)
        self.swing = swing

    def at(self, number, t):
        return self.places[number] + (self.swing * math.sin(2 * t), 0.0, 0.0)

    def detect(self, frame, held=()):
        size = 686 * 0.234 / 10.0
        pixels = FIXED.project(np.array([self.at(n, frame.t) for n in range(len(self.places))]))
        return Detections([Detection(pixel, np.array([size, 1.4 * size]), 1.0) for pixel in pixels])


NUMBER = 77  # there are more tracks than are known in 3D


@pytest.mark.parametrize("choice", ["first", "number", "click"])
def test_of_a_hundred_moving_things_the_first_or_the_chosen_one_is_followed(choice):
    rig, crowd = FormulaRig(), Crowd()
    number = 0 if choice == "first" else NUMBER
    pixel = tuple(FIXED.project(crowd.at(number, 0.2))[0])
    selectors = {"number": Chosen(number=NUMBER + 1), "click": Chosen(pixel=pixel, click_part=8 / rig.fixed.size[0])}
    steps = run(rig, crowd, 2.5, selector=selectors.get(choice))
    assert FusionSettings.most_filters < NUMBER
    assert {step.target.id for step in steps if step.target is not None} == {number + 1}
    assert steps[-1].state is State.FOLLOWING
    assert len([track for track in steps[-1].tracks if track.confirmed]) == 100
    # It is measured at every frame, however many others there are.
    assert all(step.estimate.measured_t == step.fixed.t for step in steps if step.target is not None)
    assert off(rig, lambda t: crowd.at(number, t), rig.t) < 0.01
    assert len({round(pan, 1) for _, pan, *_ in rig.moves}) <= 3  # it does not go from one to the other


@pytest.mark.parametrize(("selector", "reported"), [
    (Chosen(number=7), "track 7 is not there"),
    (Chosen(pixel=(20.0, 30.0)), "no track at the click (20, 30)"),
])  # fmt: skip
def test_a_choice_that_meets_nobody_is_told(selector, reported):
    rig = FormulaRig()
    steps = run(rig, Seer(still), 1.0, selector=selector)
    assert {(step.state, step.reason) for step in steps} == {(State.SEARCHING, reported)}
    assert any(track.confirmed for track in steps[-1].tracks)
    assert not rig.moves


def test_a_chosen_target_that_has_gone_is_told():
    rig = FormulaRig()
    pixel = tuple(FIXED.project(np.array(still(0)))[0].round())
    steps = run(rig, Seer(still, lambda t: t < 1.0), 3.0, selector=Chosen(pixel=pixel))
    assert [state for state, _ in spans(steps)] == [
        State.SEARCHING,
        State.FOLLOWING,
        State.COASTING,
        State.LOST,
        State.SEARCHING,
    ]
    u, v = pixel
    assert steps[-1].reason == f"track 1, which was at the click ({u:g}, {v:g}), is not there any more"
    assert_it_comes_to_rest(rig, 1.0)


def test_a_chosen_target_that_was_hidden_for_long_is_followed_on():
    """Its track lives for 0.8 s; then it has another number, and is the same target."""
    rig = FormulaRig()
    hidden = run(rig, Seer(still, lambda t: not 1.0 <= t < 2.5), 5.0, selector=Chosen(number=1))
    assert [(state, number) for (state, number), _ in itertools.groupby(hidden, key=followed)][-2:] == [
        (State.SEARCHING, None),
        (State.FOLLOWING, 2),
    ]
    assert off(rig, still, rig.t) < STEP


def followed(step):
    return step.state, None if step.target is None else step.target.id


def far_and_near():
    """One book that is out of reach, from the start, and one within it later."""
    return Both(Seer(lambda t: (3.0, 0.4, 10.0)), Seer(lambda t: (-0.5, 0.4, 10.0), lambda t: t > 1.0))


@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_a_target_beyond_the_limits_keeps_the_head_from_no_other(policy):
    rig = FormulaRig(replace(WIDE, pan=replace(WIDE.pan, range=(-0.15, 0.15))))
    steps = run(rig, far_and_near(), 4.0, selector=POLICIES[policy]())
    alone = [step for step in steps if 0.3 < step.t < 1.0]
    assert {step.state for step in alone} == {State.UNREACHABLE}
    assert all("beyond the limits" in step.reason for step in alone)
    assert {(step.state, step.target.id) for step in steps if step.t > 2.0} == {(State.FOLLOWING, 2)}
    assert all(-0.15 <= pan <= 0.15 for _, pan, *_ in rig.moves)
    assert rig.pan.motor(rig.t)[1] == 0.0


def test_a_chosen_target_beyond_the_limits_is_not_exchanged():
    rig = FormulaRig(replace(WIDE, pan=replace(WIDE.pan, range=(-0.15, 0.15))))
    steps = run(rig, far_and_near(), 3.0, selector=Chosen(number=1))
    assert {(step.state, step.target.id) for step in steps if step.t > 0.3} == {(State.UNREACHABLE, 1)}
    assert not rig.moves
