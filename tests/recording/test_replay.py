"""Replays: bit-exact for the same pipeline, by time for another, and as far as the folder is whole."""

import collections
import dataclasses
import itertools
import json
import math
import re
import shutil
import subprocess
import sys
import threading

import numpy as np
import pytest

from cotarget.backends import check, describe, open_recording, open_rig
from cotarget.calibration import Calibration
from cotarget.cli.main import main
from cotarget.config import RigConfig, SafetyConfig, parse_config
from cotarget.control.selection import Chosen
from cotarget.detection import make_detector
from cotarget.errors import ConfigError, CotargetError, DeviceError, HaltedError, StaleFrameError
from cotarget.estimation import Estimate
from cotarget.pipeline import FollowSettings, State, follow
from cotarget.recording.recorder import Recorder
from cotarget.recording.replay import RecordingEndedError, Replay, until_end
from cotarget.rig import PanTiltState
from cotarget.sim.world import SimWorld
from tests.support.commands import true_calibration
from tests.support.recorded_run import (
    CONFIG,
    LIMITS,
    RATE_HZ,
    SETTINGS,
    SIZE,
    STEP,
    Bright,
    ToyCamera,
    ToyDevices,
    ToyZoomCamera,
    calibration,
    calibration_file,
    record,
    run,
    toy_rig,
)
from tests.support.rigs import guarded

SECONDS = 2.0
DEADLINE_S = 60.0  # for a thread or process that should answer at once


def assert_same(then, now, where="step"):
    """Equal to the last bit, through dataclasses and arrays."""
    assert type(then) is type(now), where
    if isinstance(then, Estimate):  # what it was made with comes from other files
        assert_same((then.t, then.state, then.state_covariance), (now.t, now.state, now.state_covariance), where)
    elif dataclasses.is_dataclass(then):
        for field in dataclasses.fields(then):
            assert_same(getattr(then, field.name), getattr(now, field.name), f"{where}.{field.name}")
    elif isinstance(then, tuple | list):
        assert len(then) == len(now), where
        for i, (a, b) in enumerate(zip(then, now, strict=True)):
            assert_same(a, b, f"{where}[{i}]")
    elif isinstance(then, np.ndarray):
        assert np.array_equal(then, now), where
    else:
        assert then == now or (then != then and now != now), where


def replay(folder, change=lambda rig: rig, **options):
    """The steps of a replay until the recording ends, and how its commands differ."""
    recording = open_recording(folder)
    played = Replay(recording)
    options = {"seconds": math.inf} | options
    steps = list(until_end(run(change(played.rig), Calibration.load(recording.calibration), **options)))
    return steps, played.differences


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording, which tests do not change, and its steps."""
    folder = tmp_path_factory.mktemp("recorded")
    steps = record(folder / "run", calibration_file(folder), seconds=SECONDS)
    return folder / "run", steps


@pytest.fixture
def copy(recorded, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(recorded[0], tmp_path / "copy")


def lines(folder):
    return (folder / "log.jsonl").read_bytes().splitlines(keepends=True)


def test_the_same_pipeline_replays_to_the_last_bit(recorded):
    folder, steps = recorded
    recording = open_recording(folder)
    assert (recording.target, recording.ending, recording.truncated, recording.notes) == ("bird", "complete", False, ())
    assert recording.steps == len(steps) == 50 + 2  # a frame each 40 ms, the first at once and one under way at the end
    assert recording.seconds == pytest.approx(SECONDS, abs=0.05)
    assert {step.state for step in steps} >= {State.FOLLOWING, State.COASTING}
    again, differences = replay(folder)
    for then, now in zip(steps, again, strict=True):
        assert_same(then, now)
    assert differences.same
    assert differences.moves > 30
    assert differences.zooms > 2
    limited, _ = replay(folder, seconds=SECONDS)  # the recorded clock ends the run as it did then
    assert len(limited) == len(steps)


class Repeating(ToyZoomCamera):
    """Gives each picture three times, and says so the third time."""

    def read(self, newer_than=None, timeout=1.0):
        frame = super().read(newer_than, timeout)
        return dataclasses.replace(frame, repeated=round(frame.t * self.rate_hz) % 3 == 2)

    def expose(self, index):
        return super().expose(index // 3)


def test_frames_are_repeated_as_their_camera_said(tmp_path):
    """Earlier versions compared the pictures: where the log does not say otherwise, a replay does."""
    devices = ToyDevices()
    devices.zoom = Repeating(devices, "zoom", RATE_HZ)
    steps = record(tmp_path / "run", calibration_file(tmp_path), devices, seconds=1.0)
    again, differences = replay(tmp_path / "run")
    assert_same(steps, again)
    assert differences.same
    assert {step.zoom.repeated for step in steps} == {True, False}
    log = lines(tmp_path / "run")
    assert {b"repeated" in line for line in log if b"zoom.read" in line} == {True, False}
    (tmp_path / "run" / "log.jsonl").write_bytes(re.sub(rb', "repeated": \w+', b"", b"".join(log)))
    older, _ = replay(tmp_path / "run")
    same = [np.array_equal(a.zoom.image, b.zoom.image) for a, b in itertools.pairwise(steps)]
    assert [step.zoom.repeated for step in older] == [False, *same]


class Counting(ToyCamera):
    """Gives frames at uneven times, counts them, and loses every tenth."""

    def read(self, newer_than=None, timeout=1.0):
        frame = super().read(newer_than, timeout)
        index = round(frame.t * self.rate_hz)
        return dataclasses.replace(frame, t=frame.t + 0.03 * (index % 2), number=index + index // 10)


def test_frames_that_a_camera_counts_are_skipped_by_their_numbers(tmp_path):
    """By the rate of 25 Hz every interval of 70 ms would hide one, and those that are lost would be none."""
    devices = ToyDevices()
    devices.fixed = Counting(devices, "fixed", RATE_HZ)
    steps = record(tmp_path / "run", calibration_file(tmp_path), devices, seconds=1.2)
    numbers = [step.fixed.number for step in steps]
    assert [step.skipped for step in steps] == [0, *np.diff(numbers) - 1]
    assert sum(step.skipped for step in steps) in (2, 3)
    again, differences = replay(tmp_path / "run")
    assert differences.same
    assert [step.skipped for step in again] == [step.skipped for step in steps]


def test_a_rig_in_real_time_replays_to_the_last_bit(tmp_path):
    """Its watchdog's thread reads the clock all the time and changes nothing."""
    path = calibration_file(tmp_path)
    steps = record(tmp_path / "run", path, ToyDevices(real_time=True), seconds=0.5)
    again, differences = replay(tmp_path / "run")
    assert_same(steps, again)
    assert differences.same


def shifted(rig, pan=0.0, focal_px=0.0, every=1):
    """A rig that gets other commands for head and lens, or only each n-th move."""
    zoom, head, count = Proxy(rig.zoom), Proxy(rig.head), itertools.count(1)
    zoom.zoom = lambda wanted: rig.zoom.zoom(wanted + focal_px)
    head.move = lambda p, t, speed=None: (p, t) if next(count) % every else rig.head.move(p + pan, t, speed)
    return dataclasses.replace(rig, zoom=zoom, head=head)


class Proxy:
    def __init__(self, device):
        self._device = device

    def __getattr__(self, name):
        return getattr(self._device, name)


def differences_of(folder, **change):
    recording = open_recording(folder)
    played = Replay(recording)
    calibration, bird = Calibration.load(recording.calibration), CONFIG.target("bird")
    with guarded(played.rig, CONFIG.safety) as safe:
        steps = follow(shifted(safe, **change), calibration, bird, Bright(), seconds=math.inf, settings=SETTINGS)
        assert list(until_end(steps))
    return played.differences


def test_commands_that_differ_are_counted_and_measured(recorded):
    """Commands are compared before they are rounded to steps: 0.01 rad are 0.573 degrees."""
    same = differences_of(recorded[0])
    assert same.same
    turned = differences_of(recorded[0], pan=0.01)
    assert (turned.moves, turned.moves_differing, turned.zooms_differing) == (same.moves, same.moves, 0)
    assert turned.largest_deg == pytest.approx(0.573, abs=0.0005)
    assert (turned.missing, turned.extra) == (0, 0)
    moved = [step.index for step, before in zip(recorded[1][1:], recorded[1], strict=False)
             if step.head_commands > before.head_commands]  # fmt: skip
    assert (turned.frames, turned.frames_differing, turned.first_frame) == (len(recorded[1]), len(moved), moved[0])
    assert turned.first_s == pytest.approx(recorded[1][moved[0]].fixed.t - recorded[1][0].fixed.t, abs=1 / RATE_HZ)
    zoomed = differences_of(recorded[0], focal_px=7.0)
    assert zoomed.zooms_differing > 0
    assert zoomed.largest_px >= 7.0
    halved = differences_of(recorded[0], every=2)
    assert (halved.moves, halved.missing) == (same.moves // 2, same.moves - same.moves // 2)
    assert not halved.same
    assert halved.first_frame == moved[0]
    others = halved.moves_differing + halved.zooms_differing + halved.extra  # by the time that the others took
    assert len(moved[::2]) <= halved.frames_differing <= len(moved[::2]) + others


@pytest.fixture(scope="module")
def recording_of_track_2(tmp_path_factory):
    """A recording of a run that follows the second track alone, which appears late."""
    folder = tmp_path_factory.mktemp("track_2")
    path = calibration_file(folder)
    selector = Chosen(number=2)
    with Recorder(folder / "run", CONFIG, path, "bird", selector) as recorder:
        steps = list(run(recorder.wrap(toy_rig()), Calibration.load(path), SECONDS, selector=selector))
    assert {step.target.id for step in steps if step.target} == {2}
    return folder / "run"


@pytest.fixture
def replayed(recording_of_track_2, tmp_path, monkeypatch, capsys):
    """Function that runs `cotarget replay` on a copy: exit status, JSON and stderr."""
    monkeypatch.setattr("cotarget.detection.make_detector", lambda *_: Bright())
    folder = shutil.copytree(recording_of_track_2, tmp_path / "copy")

    def command(*options):
        status = main(["replay", str(folder), *options])
        out, err = capsys.readouterr()
        return status, json.loads(out) if out else None, err

    command.folder = folder
    return command


def test_the_command_selects_the_target_as_the_recorded_run_did(replayed):
    status, result, said = replayed("--check")
    assert (status, result["differences"]["frames_differing"]) == (0, 0)
    assert "differ" not in said
    assert result["differences"]["frames"] == result["steps"] > 40


def test_the_command_reports_differences_and_fails_with_check(replayed):
    status, result, said = replayed("--policy", "first-come")
    found = result["differences"]
    assert status == 0
    line = f"cotarget replay: the commands of {found['frames_differing']} of {result['steps']} frames differ"
    assert said.splitlines()[-1].startswith(line)
    assert f"from frame {found['first_frame']} ({found['first_s']:.2f} s) on" in said
    assert f"{found['moves_differing']} of {found['moves']} moves differ, by {found['largest_deg']:.3g} degrees" in said
    assert f"{found['zooms_differing']} of {found['zooms']} focal lengths, by {found['largest_px']:.3g} px" in said
    assert found["first_frame"] < 20  # the first bird is believed by then
    assert replayed("--policy", "first-come", "--check")[:2] == (1, result)


def test_a_recording_without_a_selector_replays_as_first_come(replayed):
    path = replayed.folder / "recording.json"
    table = json.loads(path.read_text())
    edit("whom", {})(replayed.folder)
    then = replayed("--policy", "first-come")
    path.write_text(json.dumps({key: value for key, value in table.items() if key != "whom"}))
    assert replayed() == then


@pytest.mark.parametrize("table", [
    {"policy": "by-name"}, {"policy": 3}, {"click": [500.0, 3.0]}, {"click": [float("nan"), 3.0]}, {"click": [1.0]},
    {"click": [10**400, 3.0]}, {"track": 0}, {"track": 1, "policy": "first-come"}, None,
])  # fmt: skip
def test_an_invalid_selector_is_refused(replayed, table):
    edit("whom", table)(replayed.folder)
    status, _, err = replayed()
    assert status == 1
    assert re.match(r"cotarget replay: (.*recording\.json: whom: |the recorded (policy|click))", err)
    assert err.count("\n") == 1


def write_log(folder, rows, end="complete"):
    """Put a log written by hand into a recording."""
    head = lines(folder)[0].decode()
    text = "".join(json.dumps(row) + "\n" for row in rows)
    (folder / "log.jsonl").write_text(head + text + (json.dumps({"end": end}) + "\n" if end else ""))


def fixed(at, number=0):
    return {
        "call": "fixed.read",
        "at": at,
        "args": [None, 1.0],
        "result": [at - 0.06],
        "image": f"fixed/{number:06}.png",
    }


def zoomed(at, number):
    return {"call": "zoom.read", "at": at, "args": [None, 1.0], "result": [at - 0.06], "image": f"zoom/{number:06}.png"}


def head_at(t, pan, moving=False):
    return {"call": "head.state", "at": t, "result": [pan, -pan, moving, t]}


@pytest.fixture
def by_hand(copy):
    """Write a log by hand whose frames are the first of the recording."""

    def write(rows, end="complete"):
        sizes = [{"bytes": (copy / row["image"]).stat().st_size} if "image" in row else {} for row in rows]
        write_log(copy, [row | size for row, size in zip(rows, sizes, strict=True)], end)
        return Replay(open_recording(copy))

    return write


def test_a_call_that_was_not_recorded_is_answered_by_time(by_hand):
    played = by_hand([
        head_at(10.0, 0.0), fixed(10.0, 0), zoomed(10.02, 0), head_at(10.1, 0.1, True),
        {"call": "zoom.state", "at": 10.0, "result": [100.0, False, 10.0]},
        {"call": "zoom.state", "at": 11.0, "result": [200.0, False, 11.0]},
        fixed(10.2, 1), zoomed(10.22, 1), fixed(10.3, 2), head_at(10.5, 0.5), fixed(11.0, 3), fixed(11.1, 4),
    ])  # fmt: skip
    rig = played.rig
    assert rig.fixed.read().t == pytest.approx(9.94)
    assert rig.clock.now() == 10.0
    assert rig.head.state() == PanTiltState(0.1, -0.1, True, 10.1)  # as recorded, though not asked yet
    rig.clock.sleep_until(10.3)
    state = rig.head.state()  # half-way between 0.1 at 10.1 and 0.5 at 10.5
    assert (state.pan, state.tilt, state.moving, state.t) == (pytest.approx(0.3), pytest.approx(-0.3), True, 10.3)
    assert rig.zoom.read().t == pytest.approx(9.96)  # the one recorded between these frames
    assert rig.zoom.read().t == pytest.approx(10.16)  # the newest by now
    with pytest.raises(StaleFrameError, match=r"within 0\.2 s"):
        rig.zoom.read(newer_than=10.2, timeout=0.2)
    assert rig.clock.now() == pytest.approx(10.5)
    assert rig.fixed.read(newer_than=9.94).t == pytest.approx(10.24)  # the newest by now, not the next
    assert rig.fixed.read(newer_than=10.24, timeout=2.0).t == pytest.approx(10.94)
    assert rig.zoom.state().focal_px == 200.0
    with pytest.raises(StaleFrameError):
        rig.fixed.read(newer_than=10.94, timeout=0.01)  # the next came 0.1 s later
    assert rig.head.move(0.7 * STEP, 9.0) == pytest.approx((STEP, math.floor(0.5 / STEP) * STEP))
    assert rig.zoom.zoom(5000.0) == 1200.0
    assert rig.fixed.size == rig.zoom.still_size == SIZE
    assert rig.board.patience == 0
    assert (played.differences.extra, played.differences.missing) == (2, 0)
    rig.fixed.read()
    with pytest.raises(RecordingEndedError, match=r"copy: the recording ends here, at 11\.10 s") as caught:
        rig.fixed.read()
    assert "\n" not in str(caught.value)
    rig.head.halt()  # closing goes on


@pytest.mark.parametrize(("error", "kind", "message"), [
    (["StaleFrameError", "no frame"], StaleFrameError, "^no frame$"),
    (["OSError", "the cable is out"], DeviceError, "^OSError: the cable is out$"),
    (["choices", "a function of that module"], DeviceError, "^choices: a function"),
])  # fmt: skip
def test_a_recorded_error_is_raised_again(by_hand, error, kind, message):
    played = by_hand([
        {"call": "head.state", "at": 1.0, "error": error},
        {"call": "head.move", "at": 1.1, "args": [0.1, 0.2, None, False], "error": error},
        {"call": "fixed.read", "at": 1.2, "args": [None, 1.0], "error": error},
    ], end="an accident")  # fmt: skip
    rig = played.rig
    with pytest.raises(kind, match=message):
        rig.head.state()
    with pytest.raises(kind, match=message):
        rig.head.move(0.1, 0.2)
    with pytest.raises(kind, match=message):
        rig.fixed.read()
    assert (played.differences.moves, played.differences.same) == (1, True)
    with pytest.raises(RecordingEndedError):
        rig.head.state()  # the run broke off here


class GarbledError(HaltedError):
    """An error that a driver defines."""


def test_an_error_of_another_module_is_replayed_as_its_nearest_base_class(tmp_path):
    path, failing = calibration_file(tmp_path), {("head.move", 1): GarbledError("it was halted on its way")}
    with Recorder(tmp_path / "run", CONFIG, path, "bird") as recorder, recorder.wrap(toy_rig(failing)) as rig:
        rig.fixed.read()
        with pytest.raises(GarbledError):
            rig.head.move(0.1, 0.2, wait=True)
    (row,) = [json.loads(line) for line in lines(tmp_path / "run") if b"error" in line]
    assert (row["error"], row["error_class"]) == (["GarbledError", "it was halted on its way"], "HaltedError")
    rig = Replay(open_recording(tmp_path / "run")).rig
    rig.fixed.read()
    with pytest.raises(HaltedError, match=r"^it was halted on its way$"):
        rig.head.move(0.1, 0.2, wait=True)


def test_a_replayed_rig_has_the_recorded_spec(tmp_path):
    path, rig = calibration_file(tmp_path), toy_rig(real_time=True)
    other = dataclasses.replace(rig.spec.head, delay_s=0.3)
    rig = dataclasses.replace(rig, spec=dataclasses.replace(rig.spec, head=other))
    record(tmp_path / "run", path, rig, seconds=0.2)
    assert Replay(open_recording(tmp_path / "run")).rig.spec == rig.spec
    config = RigConfig(backend="replay", recording=tmp_path / "run", safety=SafetyConfig(pan_deg=(-10.0, 10.0)))
    limits = dataclasses.replace(
        LIMITS, pan=dataclasses.replace(LIMITS.pan, range=(math.radians(-10.0), math.radians(10.0)))
    )
    spec = dataclasses.replace(rig.spec, head=dataclasses.replace(other, limits=limits))
    assert describe(config) == spec
    with open_rig(config) as played:
        assert played.spec == spec


def collect(steps, into):
    for step in steps:
        into.append(step)  # steps before a failure stay


@pytest.mark.parametrize("failing", [
    dict.fromkeys([("fixed.read", n) for n in range(20, 1000)], StaleFrameError("no frame within 1 s")),
    {("head.move", 5): DeviceError("the head does not answer")},
    {("zoom.read", 9): OSError("input/output error")},
    {("head.move", 8): KeyboardInterrupt()},
])  # fmt: skip
def test_the_error_that_ended_a_run_ends_its_replay(tmp_path, failing):
    path = calibration_file(tmp_path)
    error = next(iter(failing.values()))
    steps = []
    with pytest.raises(type(error)), Recorder(tmp_path / "run", CONFIG, path, "bird") as recorder:
        collect(run(recorder.wrap(toy_rig(failing, real_time=True)), Calibration.load(path)), steps)
    recording = open_recording(tmp_path / "run")
    assert not recording.truncated
    assert recording.ending == f"{type(error).__name__}: {error}".removesuffix(": ")
    assert recording.ending in recording.notes[0]
    played, again = Replay(recording), []
    expected = error if isinstance(error, CotargetError) else CotargetError()
    with pytest.raises(type(expected), match=str(error) or "the recording ends here"):
        collect(run(played.rig, Calibration.load(path)), again)
    assert_same(steps, again)
    assert played.differences.same


def test_a_halt_by_another_thread_is_logged_and_does_not_change_the_replay(tmp_path):
    path = calibration_file(tmp_path)
    steps = []
    with Recorder(tmp_path / "run", CONFIG, path, "bird") as recorder:
        rig = recorder.wrap(toy_rig())
        for step in run(rig, Calibration.load(path), seconds=0.5):
            steps.append(step)
            watchdog = threading.Thread(target=lambda: rig.clock.now() and rig.head.halt())
            watchdog.start()
            watchdog.join(DEADLINE_S)
    rows = [json.loads(line) for line in lines(tmp_path / "run")]
    assert [row["call"] for row in rows if "aside" in row] == ["head.halt"] * len(steps)
    again, differences = replay(tmp_path / "run")
    assert_same(steps, again)
    assert differences.same


def asked_aside(rig):
    answers = []
    thread = threading.Thread(target=lambda: answers.extend([rig.clock.now(), rig.head.state(), rig.head.halt()]))
    thread.start()
    thread.join(DEADLINE_S)
    return answers


def test_calls_of_another_thread_are_answered_by_time(by_hand):
    played = by_hand([head_at(10.0, 0.0), fixed(10.0), head_at(10.1, 0.1), {"call": "head.halt", "at": 10.1}])
    rig = played.rig
    rig.fixed.read()
    assert asked_aside(rig) == [10.0, PanTiltState(0.0, 0.0, False, 10.0), None]
    assert rig.head.state().pan == 0.1


def cut(folder, kept):
    (folder / "log.jsonl").write_bytes(kept)
    return open_recording(folder)


def test_a_log_that_is_cut_anywhere_replays_its_complete_steps(recorded, copy):
    """Cut within each line of a step and at the ends of the lines: all steps but the last one or two are left."""
    whole, (_, steps) = lines(copy), recorded
    frames = [i for i, line in enumerate(whole) if b"fixed.read" in line]
    for end in range(frames[20], frames[21] + 1):
        for kept in (0, 1, len(whole[end]) - 1):
            recording = cut(copy, b"".join(whole[:end]) + whole[end][:kept])
            assert recording.truncated
            assert recording.steps == (20 if end > frames[20] else 19), (end, kept)
            assert len(recording.notes) == 1
            assert re.search(r"0\.[78]\d s", recording.notes[0])
    again, differences = replay(copy)
    assert_same(steps[:20], again)
    assert differences.same
    assert replay(copy, seconds=0.3)[1].same


def damage_line(folder):
    whole = lines(folder)
    frame = [i for i, line in enumerate(whole) if b"fixed.read" in line][20]
    whole[frame + 1] = b'{"call": "clock.now", "at": 1e' + whole[frame + 1][30:]
    (folder / "log.jsonl").write_bytes(b"".join(whole))


def remove_image(folder):
    (folder / "fixed" / "000020.png").unlink()


def shorten_image(folder):
    path = folder / "fixed" / "000020.png"
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize(("damage", "said", "left"), [
    (damage_line, r"line \d+ of log.jsonl is damaged", 20),
    (remove_image, r"fixed/000020.png is missing", 19),
    (shorten_image, r"fixed/000020.png is damaged", 19),
])  # fmt: skip
def test_a_damaged_recording_replays_up_to_the_damage(recorded, copy, damage, said, left):
    damage(copy)
    recording = open_recording(copy)
    assert recording.truncated
    (note,) = recording.notes
    assert re.search(said, note)
    assert "\n" not in note
    assert_same(recorded[1][:left], replay(copy)[0])


def test_a_file_of_the_right_size_that_is_no_image_ends_the_replay(copy):
    path = copy / "fixed" / "000020.png"
    path.write_bytes(bytes(path.stat().st_size))
    with pytest.raises(DeviceError, match=r"000020\.png: is damaged") as caught:
        replay(copy)
    assert "\n" not in str(caught.value)


def test_a_missing_zoom_image_is_replaced_by_the_one_before(recorded, copy):
    """No decision follows from it, so the commands are the same."""
    (copy / "zoom" / "000003.png").unlink()
    (copy / "zoom" / "000000.png").unlink()
    recording = open_recording(copy)
    assert not recording.truncated
    assert re.match(r"\d+ frames of the zoom camera", recording.notes[0])
    again, differences = replay(copy)
    assert differences.same
    assert [step.zoom.t for step in again] == [step.zoom.t for step in recorded[1]]
    images = dict.fromkeys(id(step.zoom.image) for step in recorded[1])
    before = [step for step in recorded[1] if id(step.zoom.image) == list(images)[2]][-1]
    assert np.array_equal(again[before.index + 1].zoom.image, before.zoom.image)
    assert not again[0].zoom.image.any()  # nothing came before
    assert again[0].zoom.image.shape == recorded[1][0].zoom.image.shape


def edit(key, value):
    def change(folder):
        table = json.loads((folder / "recording.json").read_text())
        table[key] = value
        (folder / "recording.json").write_text(json.dumps(table))

    return change


def put(name, data):
    return lambda folder: (folder / name).write_bytes(data)


def test_a_recording_of_a_world_that_is_refused_today_can_be_replayed(copy):
    """As an earlier version wrote it; a replay simulates nothing."""
    config = json.loads((copy / "recording.json").read_text())["config"]
    for camera in ("fixed", "zoom"):  # of which the principal point was not moved with the size, at that time
        config["sim"][camera] |= {"size": [320, 240], "center_px": [326.0, 239.0], "exposure_s": 1.0}
    with pytest.raises(ConfigError, match=r"center_px: \(326, 239\) is not in the 320x240 image"):
        check(parse_config(config))
    edit("config", config)(copy)
    assert open_recording(copy).config.sim.zoom.center_px == (326.0, 239.0)
    config["sim"]["fixed"]["rate_hz"] = 0.0  # by which a replay goes
    edit("config", config)(copy)
    with pytest.raises(ConfigError, match=r"sim\.fixed\.rate_hz: 0"):
        open_recording(copy)


@pytest.mark.parametrize(("spoil", "named"), [
    (shutil.rmtree, "copy: "),
    (lambda folder: (folder / "recording.json").unlink(), "recording.json"),
    (edit("schema", 2), "recording.json: schema 2"),
    (edit("schema", True), "recording.json: schema True"),
    (edit("target", "yeti"), "'yeti'"),
    (edit("target", ["bird"]), "recording.json: target"),
    (edit("config", {"lasers": 1}), "recording.json: unknown key 'lasers'"),
    (edit("config", []), "recording.json: config"),
    (put("recording.json", b"{"), "recording.json: "),
    (put("recording.json", b"\xff"), "recording.json: "),
    (put("recording.json", b"[1]"), "recording.json: "),
    (put("recording.json", b"{}"), "recording.json: missing key 'schema'"),
    (put("recording.json", b'{"schema": 1, "cotarget": "0"}'), "missing key 'target'; needed here: config, cotarget"),
    (lambda folder: (folder / "calibration.json").unlink(), "calibration.json: "),
    (lambda folder: (folder / "log.jsonl").unlink(), "log.jsonl"),
    (put("log.jsonl", b""), "copy: "),
    (put("log.jsonl", b'{"rig": {}}\n'), "line 1 of log.jsonl is damaged: missing key 'fixed_size'"),
    (put("log.jsonl", b'{"rig": []}\n'), "line 1 of log.jsonl"),
    (put("log.jsonl", b"\x00" * 100), "copy: "),
    (lambda folder: write_log(folder, [fixed(1.0)], end=None), "copy: "),
])  # fmt: skip
def test_a_folder_that_is_no_recording_is_refused(copy, spoil, named):
    spoil(copy)
    with pytest.raises(ConfigError) as caught:
        open_recording(copy)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_is_no_recording(copy):
    with pytest.raises(ConfigError, match=r"log\.jsonl: "):
        open_recording(copy / "log.jsonl")


def test_a_recording_by_another_version_has_a_note(copy):
    edit("cotarget", "0.0.7")(copy)
    assert "0.0.7" in open_recording(copy).notes[0]


def test_random_damage_raises_nothing_but_cotarget_errors(copy):
    """Random bytes in the log and the description: refused, cut short or replayed."""
    rng = np.random.default_rng(5)
    whole = {name: (copy / name).read_bytes() for name in ("log.jsonl", "recording.json")}
    short = b"".join(whole["log.jsonl"].splitlines(keepends=True)[:40])
    outcomes = collections.Counter()
    for _ in range(100):
        name = "log.jsonl" if rng.random() < 0.8 else "recording.json"
        data = bytearray(short if name == "log.jsonl" else whole[name])
        for place in rng.integers(0, len(data), rng.integers(1, 4)):
            data[place] = rng.choice(bytearray(b'0123456789-.eE",:{}[]\n ntfabr\x00\xff'))
        (copy / "log.jsonl").write_bytes(short)
        (copy / name).write_bytes(bytes(data))
        try:
            recording = open_recording(copy)
        except ConfigError as error:
            outcomes["several lines" if "\n" in str(error) else "refused"] += 1
        else:
            try:
                list(until_end(run(Replay(recording).rig, calibration())))
                outcomes["replayed"] += 1
            except CotargetError:
                outcomes["ended"] += 1
        (copy / name).write_bytes(whole[name])
    assert outcomes.keys() >= {"refused", "replayed"}, outcomes
    assert outcomes["several lines"] == 0


KILLED_AFTER = 17  # steps


def test_a_killed_run_replays_up_to_its_last_complete_step(tmp_path):
    """SIGKILL while it records: every step that it printed is there, but for the last."""
    command = [sys.executable, "-m", "tests.support.recorded_run", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        late = threading.Timer(DEADLINE_S, process.kill)  # then its lines end
        late.start()
        try:
            for _ in range(KILLED_AFTER):
                assert process.stdout.readline()
        finally:
            late.cancel()
            late.join()
            process.kill()
    recording = open_recording(tmp_path / "recording")
    assert recording.truncated
    assert recording.steps > KILLED_AFTER - 2  # at most the last one was not complete
    assert len(recording.notes) == 1
    again, differences = replay(tmp_path / "recording")
    assert len(again) == recording.steps
    assert differences.same


@pytest.mark.slow
@pytest.mark.render
def test_a_simulated_run_is_replayed_to_the_last_bit(tmp_path):
    config = parse_config({"sim": {"scene": "indoor", "targets": ["book"], "seed": 3}})
    target, settings = config.target("book"), FollowSettings()
    path = tmp_path / "exact.json"
    true_calibration(config).save(path)

    def steps(rig, config, calibration, target, seconds):
        detector = make_detector(target, rig.spec.fixed.rate_hz)
        with guarded(rig, config.safety) as safe:
            yield from follow(safe, calibration, target, detector, seconds=seconds, settings=settings)

    with Recorder(tmp_path / "run", config, path, "book") as recorder:
        rig = recorder.wrap(SimWorld(config).rig)
        then = list(steps(rig, config, Calibration.load(path), target, 1.2))
    recording = open_recording(tmp_path / "run")
    known, again = recording.config, Replay(recording)
    calibration = Calibration.load(recording.calibration)
    now = list(until_end(steps(again.rig, known, calibration, known.target(recording.target), math.inf)))
    assert State.FOLLOWING in {step.state for step in then}
    assert_same(then, now)
    assert again.differences.same
