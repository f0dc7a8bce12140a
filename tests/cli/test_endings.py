"""Files of commands that end early, exit statuses, and warnings at the end of a run."""

import csv
import json
import signal
from dataclasses import replace
from datetime import UTC, datetime

import av
import numpy as np
import pytest

import cotarget.detect_video  # noqa: F401  # before the fixture replaces the detectors that it imports
from cotarget.backends import OPENERS
from cotarget.cli.pipeline_run import FEW, MANY, LensAtItsEnd, Reasons, StepCounts
from cotarget.config import DEFAULT_TARGETS, RigConfig
from cotarget.errors import DeviceError
from cotarget.evaluation import true_calibration
from cotarget.files import CsvFile
from cotarget.geometry import pose
from cotarget.pipeline import State
from cotarget.sim.world import SimWorld
from cotarget.video import Film, FilmWriter
from tests.support.commands import OLD, call, refused
from tests.support.recorded_run import Bright, ToyDevices, calibration_file, toy_rig
from tests.support.rigs import rig_of, with_zoom_head
from tests.support.steps import step

FOLLOW = ("follow", "--rig", "rig.toml", "--calibration", "rig_calibration.json", "--target", "bird",
          "--csv", "out.csv", "--video", "out.mp4")  # fmt: skip
EARLY = "; out.mp4 holds what there was until then; out.csv holds what there was until then\n"
FRAMES = 9  # before it ends


class WatchedRig(ToyDevices):
    """Notes the table's content when the rig is closed, which must be after a halt."""

    def __init__(self, folder, failing):
        super().__init__(failing)
        self.path, self.written = folder / "out.csv", []

    def close(self):
        assert self.calls["head.halt"]
        self.written.append(self.path.read_text())
        super().close()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a rig, a calibration and an earlier result."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cotarget.detection.make_detector", lambda *_: Bright())
    (tmp_path / "rig.toml").write_text('[sim]\ntargets = ["bird"]\n[safety]\nstop_file = "stop"\n')
    calibration_file(tmp_path)
    (tmp_path / "out.csv").write_text(OLD)
    return tmp_path


def frames_of(path):
    with Film(path) as film:
        return len(list(film))


def rows_of(path):
    return len(path.read_text().splitlines()) - 1


LIMIT = ("--seconds", "20")


@pytest.mark.parametrize(("error", "more", "status", "said"), [
    (KeyboardInterrupt(), LIMIT, 130, f"cotarget follow: interrupted{EARLY}"),
    (KeyboardInterrupt(), (), 0, ""),  # which is how a run without a length ends
    (KeyboardInterrupt(), ("--seconds", "inf"), 0, ""),
    (SystemExit(143), (), 143, f"cotarget follow: terminated{EARLY}"),
    (DeviceError("the camera is gone"), (), 1, f"cotarget follow: the camera is gone{EARLY}"),
])  # fmt: skip
def test_follow_halts_the_head_then_keeps_the_steps_so_far(folder, capsys, monkeypatch, error, more, status, said):
    error.__dict__.pop("__notes__", None)
    rig = WatchedRig(folder, {("fixed.read", FRAMES + 1): error})
    monkeypatch.setitem(OPENERS, "sim", lambda *_: rig_of(rig))
    ended, out, err = call(capsys, *FOLLOW, *more)
    assert (ended, err) == (status, said)
    if isinstance(error, KeyboardInterrupt):
        assert json.loads(out)["steps"] == FRAMES
    else:
        assert out == ""
    assert rig.written == [OLD]
    assert rows_of(folder / "out.csv") == frames_of(folder / "out.mp4") == FRAMES
    assert not [path for path in folder.iterdir() if ".part" in path.name]


def test_ctrl_c_while_a_row_is_written_leaves_table_film_and_count_of_the_same_steps(folder, capsys, monkeypatch):
    """The signal comes after the row and before the step is counted and drawn."""
    write, rows = CsvFile.write, []

    def interrupted(table, row):
        write(table, row)
        rows.append(row)
        if len(rows) == FRAMES:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(CsvFile, "write", interrupted)
    monkeypatch.setitem(OPENERS, "sim", lambda *_: toy_rig({}))
    status, out, err = call(capsys, *FOLLOW)
    assert (status, err) == (0, "")
    assert json.loads(out)["steps"] == rows_of(folder / "out.csv") == frames_of(folder / "out.mp4") == FRAMES


@pytest.mark.parametrize("failing", ["head.move", "fixed.read"])
def test_recording_of_a_failed_device_is_replayed_to_its_end(folder, capsys, caplog, monkeypatch, failing):
    """The halts of the recorded run failed too."""
    lost = DeviceError("the line is lost")
    accident = {(failing, FRAMES): lost} | {("head.halt", number): lost for number in range(1, 50)}
    monkeypatch.setitem(OPENERS, "sim", lambda *_: toy_rig(accident))
    assert call(capsys, *FOLLOW, "--record", "run")[0] == 1
    caplog.clear()
    steps = rows_of(folder / "out.csv")
    status, out, err = call(capsys, "replay", "run", "--check")
    assert (status, err) == (0, "run: the run was ended by DeviceError: the line is lost\n")
    assert json.loads(out)["steps"] == steps > 0
    assert not caplog.records


def test_failed_halt_is_reported_after_ctrl_c(folder, capsys, monkeypatch):
    failing = {("fixed.read", FRAMES): KeyboardInterrupt()}
    failing |= {("head.halt", number): DeviceError("the head is gone") for number in range(1, 50)}
    monkeypatch.setitem(OPENERS, "sim", lambda *_: toy_rig(failing))
    status, out, err = call(capsys, *FOLLOW)
    assert (status, out) == (1, "")
    assert "the head is gone" in err


def test_run_without_a_step_keeps_the_old_table(folder, capsys, monkeypatch):
    monkeypatch.setitem(OPENERS, "sim", lambda *_: toy_rig({("fixed.read", 1): DeviceError("gone")}))
    assert refused(capsys, *FOLLOW) == "cotarget follow: gone"
    assert (folder / "out.csv").read_text() == OLD
    assert not (folder / "out.mp4").exists()


def test_interrupted_detect_keeps_the_tracks_so_far(folder, capsys, monkeypatch):
    with FilmWriter(folder / "film.mp4", 25.0) as film:
        for index in range(2 * FRAMES):
            film.write(ToyDevices().fixed.expose(index), index / 25)
    seen = []

    def detect(self, frame, held=(), plain=Bright.detect):
        seen.append(frame.t)
        if len(seen) > FRAMES:
            raise KeyboardInterrupt
        return plain(self, frame)

    monkeypatch.setattr(Bright, "detect", detect)
    monkeypatch.setattr("cotarget.detect_video.make_detector", lambda *_: Bright())
    status, out, err = call(capsys, "detect", "film.mp4", *FOLLOW[-6:])
    assert (status, out, err) == (130, "", f"cotarget detect: interrupted{EARLY}")
    assert frames_of(folder / "out.mp4") == FRAMES
    assert 0 < rows_of(folder / "out.csv") <= FRAMES


def test_follow_reports_why_a_target_was_not_followed(folder, capsys, monkeypatch):
    """The bird, 10 to 15 degrees off the axis, is beyond the limits of a head that turns by one degree."""
    with (folder / "rig.toml").open("a") as file:
        file.write("pan_deg = [-1, 1]\n")
    monkeypatch.setitem(OPENERS, "sim", lambda *_: toy_rig())
    status, out, err = call(capsys, *FOLLOW, "--seconds", "1")
    assert status == 4
    printed = json.loads(out)
    assert list(printed["reasons"].values()) == sorted(printed["reasons"].values(), reverse=True)
    [line] = err.splitlines()
    beyond, count = next((name, count) for name, count in printed["reasons"].items() if "beyond the limits" in name)
    assert beyond.startswith("the point needs pan #, tilt #")
    assert line.startswith("cotarget follow: ")
    assert f"{count} of {printed['steps']} frames: the point needs pan " in line
    assert "beyond the limits pan -1 to 1," in line


@pytest.mark.parametrize(("states", "status"), [
    ({State.UNREACHABLE: 100, State.LOST: 12}, 4),  # out of reach as long as it is seen, and lost afterwards
    ({State.UNREACHABLE: 100, State.FOLLOWING: 1}, 0),
    ({State.FOLLOWING: 4, State.UNCONFIRMED: 5}, 3),  # 4 wrong matches confirm nothing
    ({State.FOLLOWING: 5, State.UNCONFIRMED: 5}, 0),
])  # fmt: skip
def test_exit_status_depends_on_followed_and_confirmed_steps(states, status):
    counts, plain = StepCounts(), step(0.0)
    for state, count in states.items():
        for _ in range(count):
            counts.see(replace(plain, state=state, found=plain.found if state is State.FOLLOWING else None))
    assert counts.exit_status == status
    assert counts.warning == ""


HARDWARE = """
backend = "hardware"
[hardware.head]
port = "/dev/none"
[hardware.fixed]
url = "http://camera"
size = [640, 480]
[safety]
stop_file = "stop"
"""


class SlowDevices(ToyDevices):
    """Devices of which every frame takes 100 ms more, so that every third frame of 25 Hz is used."""

    def count(self, what):
        super().count(what)
        if what == "fixed.read":
            self.t += 0.1


@pytest.mark.parametrize("backend", ["sim", "hardware"])
def test_skipped_frames_are_counted_and_keep_their_time_in_table_and_film(folder, capsys, monkeypatch, backend):
    if backend == "hardware":
        (folder / "rig.toml").write_text(HARDWARE)
    monkeypatch.setitem(OPENERS, backend, lambda *_: rig_of(SlowDevices()))
    status, out, err = call(capsys, *FOLLOW, "--seconds", "3", "--insist")  # no unit's lens is like the toy's
    printed = json.loads(out)
    with (folder / "out.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    times = np.array([float(row["t_fixed_s"]) for row in rows])
    frames = round((times[-1] - times[0]) * 25) + 1
    assert (status, printed["skipped"]) == (0, frames - len(rows))
    assert [int(row["skipped"]) for row in rows[1:]] == list(np.round(np.diff(times) * 25).astype(int) - 1)
    assert rows[0]["skipped"] == "0"
    assert frames > 2 * len(rows) > 50
    assert f"cotarget follow: {printed['skipped']} of {frames} frames of the fixed camera were skipped" in err
    with Film(folder / "out.mp4") as film:
        assert [frame.t for frame in film] == pytest.approx(list(times - times[0]), abs=1e-3)
    with av.open(str(folder / "out.mp4")) as film:
        created = film.metadata.get("creation_time")
    if backend == "sim":
        assert (printed["started"], created) == (None, None)
        assert {row["utc"] for row in rows} == {""}
        return
    by_the_wall = [datetime.fromisoformat(row["utc"]) for row in rows]
    seconds = [(each - by_the_wall[0]).total_seconds() for each in by_the_wall]
    assert seconds == pytest.approx(list(times - times[0]), abs=2e-3)  # written in milliseconds
    assert (by_the_wall[0] - datetime.fromisoformat(printed["started"])).total_seconds() == 0
    assert abs((datetime.now(UTC) - by_the_wall[0]).total_seconds()) < 60
    assert abs((datetime.fromisoformat(created) - by_the_wall[0]).total_seconds()) < 1.01  # in whole seconds


def reasons_of(*runs):
    """Reasons of runs of steps: their number, their reason, and whether they have a target."""
    reasons, plain = Reasons(), step(0.0)
    for count, reason, seen in runs:
        for _ in range(count):
            reasons.see(replace(plain, reason=reason, target=plain.target if seen else None))
    return reasons


@pytest.mark.parametrize(("runs", "said"), [
    ([(500, "nothing is detected", False)], ""),  # reported by the hint
    ([(300, "nothing is detected", False), (100, "", True)], ""),
    ([(10, "what is detected is not confirmed yet", False), (90, "", True), (40, "zoom: unsure", True)], ""),
    ([(60, "", True), (50, "out of sight for 0.5 s; looked for where it should be", True)], ""),
    ([(3, "", True), (MANY - 1, "zoom: unsure", True)], ""),  # so short a run tells nothing
    ([(50, "", True), (FEW - 1, "both views make it 0.1 m", True)], ""),
    ([(1000, "", True), (40, "both views make it 0.1 m", True)], ""),
    ([(83, "", True), (60, "needs pan 3", True), (7, "needs pan 9.5", True)], "67 of 150 frames: needs pan 9.5"),
    ([(90, "a is 1; b", True), (10, "b", True)], "100 of 100 frames: b; 90 of 100 frames: a is 1"),
    ([(50, "", True), (FEW, "both views make it 0.1 m", True)], f"{FEW} of 55 frames: both views make it 0.1 m"),
    ([(10, "", True), (40, "out of sight for 2 s", True)], "40 of 50 frames: out of sight for 2 s"),
    ([(10, "says\n1 thing", True)], "10 of 10 frames: says 1 thing"),
])  # fmt: skip
def test_frequent_reasons_are_reported_in_order_and_usual_ones_are_not(runs, said):
    assert reasons_of(*runs).warning == said


def test_reasons_are_counted_without_their_numbers():
    both, one = "needs pan -4.20, tilt 1.06 or pan 173.18, tilt -1.5e-05 degrees", "needs pan 3, tilt 10.6 degrees"
    table = reasons_of((2, "a 1; zoom: unsure", True), (3, "a 2", True), (1, both, True), (2, one, True)).table
    assert table == {"a #": 5, "needs pan #, tilt # degrees": 3, "zoom: unsure": 2}
    assert list(reasons_of((1, "12 px/s of 640x480", True)).table) == ["# px/s of #x#"]
    address = "'ptpip:127.0.0.1:4001:4001' is gone for 3.5 s"
    assert list(reasons_of((1, address, True)).table) == [address.replace("3.5", "#")]


@pytest.mark.parametrize(("limited", "range_m", "steps", "shown_px"), [
    # 8000 px show the 0.8 m of a bird at 100 m 64 px large, and at 45 m 142 px large, which is nearly as wanted.
    (True, 100.0, MANY, "64 px"),
    (True, 100.0, MANY - 1, None),
    (False, 100.0, MANY, None),
    (True, 45.0, MANY, None),
])  # fmt: skip
def test_lens_at_its_end_is_reported(limited, range_m, steps, shown_px):
    lens, plain = LensAtItsEnd("bird", DEFAULT_TARGETS["bird"]), step(0.0)
    aim = replace(plain.aim, focal_px=8000.0, range=range_m, limited=limited)
    for _ in range(steps):
        lens.see(replace(plain, aim=aim))
    lens.see(replace(plain, aim=None))
    assert bool(lens.warning) == (shown_px is not None)
    assert (shown_px or "") in lens.warning


RIG = """
[sim]
scene = "indoor"
targets = ["book"]
[sim.fixed]
rate_hz = 12.5
size = [320, 240]
[sim.zoom]
rate_hz = 12.5
size = [320, 240]
[sim.effects]
noise = false
jpeg = false
blur = false
[targets.book]
wanted_px = 80
"""


@pytest.mark.render
@pytest.mark.parametrize("wrong", ["size", pytest.param("calibration", marks=pytest.mark.slow)])
def test_target_missing_in_the_close_up_is_unconfirmed(tmp_path, capsys, wrong):
    """The book is found at once, the lens needs a second, and 3 s without a sight are unconfirmed."""
    calibration = true_calibration(SimWorld(RigConfig(), rendered=()))
    if wrong == "calibration":
        calibration = with_zoom_head(calibration, T_zoom0_fixed=pose([0.3, 0.1, 0.1], [-2, 2, 1]))
    (tmp_path / "rig.toml").write_text(RIG + ("size = 2.3\n" if wrong == "size" else ""))  # it is 0.234 m wide
    calibration.save(tmp_path / "c.json")
    command = ("follow", "--rig", tmp_path / "rig.toml", "--calibration", tmp_path / "c.json", "--target", "book")
    status, out, err = call(capsys, *command, "--seconds", 5.0, "--insist")
    assert status == 3
    assert json.loads(out)["states"]["unconfirmed"] > 3
    assert "not found where the zoom camera should show it" in err
    assert len(err.splitlines()) == 1
