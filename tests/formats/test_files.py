"""Files of v0.1.0 load, and are written today with the same keys: calibrations, captures, recordings, tables, stops."""

import dataclasses
import json
import math
import re
import shutil
import threading
import tomllib
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest

from cotarget import errors
from cotarget.backends import open_recording
from cotarget.calibration import Calibration
from cotarget.cli.main import main
from cotarget.config import parse_config
from cotarget.demo import summary
from cotarget.drivers.interlock import PositionLostMarker
from cotarget.errors import CalibrationError, CotargetError, DeviceError, EmergencyStopError
from cotarget.geometry import pose
from cotarget.metrics import read_rows, score, write_rows
from cotarget.recording.recorder import Recorder
from cotarget.recording.replay import Replay
from cotarget.rig import AxisLimits, Frame, PanTiltLimits, PanTiltState, ZoomState
from cotarget.safety.stop_file import refuse_if_stopped
from cotarget.track_metrics import read_labels, read_tracks
from tests.formats.lists import (
    CAPTURES_DEG,
    CAPTURES_FOCAL,
    CAPTURES_M,
    COMMANDS,
    COMMANDS_DEG,
    COMMANDS_PX,
    CORNERS_PX,
    DETECTED_PX,
    KEYS,
    OLD,
    PRINTED,
    SAME,
    UNKNOWN,
    VIEWS,
    assert_close,
    assert_keys,
    assert_listed,
    columns,
    copy_old,
    header,
    keys_in,
    last_list,
    leaves,
    listed,
    listed_keys,
    read,
    read_lines,
    run,
    table_rows,
)
from tests.support.rigs import alike, rig_of


@pytest.fixture
def old(tmp_path, monkeypatch):
    return copy_old(tmp_path, monkeypatch)


# --- calibration.json ---


def test_v010_calibration_loads():
    """That all of it is written again as it was is tested below."""
    then, found = read(OLD / "calibration.json"), Calibration.load(OLD / "calibration.json")
    lens, head = found.zoom_head.lens, found.zoom_head
    assert found.fixed.lens.focal_px == (then["fixed"]["fx"], then["fixed"]["fy"])
    assert found.fixed.lens.center_px == (then["fixed"]["cx"], then["fixed"]["cy"])
    assert found.fixed.lens.distortion == tuple(then["fixed"]["distortion"])
    assert (found.fixed.size, lens.size, found.pitch_mm) == ((640, 480), (320, 240), 0.018)
    assert lens.nominal_px == pytest.approx((1000 / 3, 2500 / 3))
    assert (lens.stops[1].focal_px[0], lens.pupil[1]) == tuple(then["zoom"]["stops"][1][key] for key in ("fx", "pupil"))
    for name in ("T_zoom0_fixed", "T_head_zoom"):
        T = getattr(head, name)
        assert T.translation == pytest.approx(then[name]["translation"])
        assert np.degrees(T.rotation.as_rotvec()) == pytest.approx(then[name]["rotvec_deg"])
    assert head.axes.axis_offset == then["head"]["axis_offset"]
    assert np.degrees([head.axes.squareness, found.jitter]) == pytest.approx(
        [then["head"]["squareness_deg"], then["head"]["jitter_deg"]]
    )
    assert len(found.residuals.rejected) == 6
    assert np.array_equal(found.covariance.matrix, then["covariance"]["matrix"])
    for view, table in zip(found.views, then["views"], strict=True):
        corners = [(math.nan, math.nan) if corner is None else corner for corner in table["corners_px"]]
        assert np.array_equal(view.corners_px, corners, equal_nan=True)
    assert any(not view.seen.all() for view in found.views)  # a corner that is not seen is null


def test_v010_calibrations_by_other_methods_load():
    photos, sequential = (Calibration.load(OLD / f"calibration_{name}.json") for name in ("photos", "sequential"))
    assert (photos.zoom_head.T_head_zoom, photos.pitch_mm, photos.residuals.handeye_rms_px) == (None, None, None)
    assert (sequential.covariance, sequential.held_out) == (None, None)
    plain = Calibration.load(OLD / "calibration_plain.json")
    assert (plain.residuals, plain.covariance, plain.board, plain.views) == (None, None, None, ())


@pytest.mark.parametrize("name", ["calibration", "calibration_photos", "calibration_sequential", "calibration_plain"])
def test_calibration_json_is_written_as_before(name, tmp_path):
    then = read(OLD / f"{name}.json")
    Calibration.load(OLD / f"{name}.json").save(tmp_path / "now.json")
    now = read(tmp_path / "now.json")
    assert_keys("calibration_json.txt", now, may_lack=["provenance."])
    before, after = (dict(enumerate(leaves(each))) for each in (then, now))
    assert [key for key, _ in before.values()] == [key for key, _ in after.values()]
    for place, (key, value) in before.items():
        if isinstance(value, float):  # angles are kept in radians
            assert after[place][1] == pytest.approx(value, rel=1e-12, abs=1e-15), key
        elif key not in ("T_zoom0_fixed.rotvec_deg", "T_head_zoom.rotvec_deg"):
            assert after[place][1] == value, key


def test_a_covariance_has_the_listed_parameters(tmp_path):
    table = read(OLD / "calibration.json")
    table["covariance"]["parameters"][0] = UNKNOWN
    (tmp_path / "c.json").write_text(json.dumps(table))
    with pytest.raises(CalibrationError) as caught:
        Calibration.load(tmp_path / "c.json")
    assert_listed(
        "covariance_parameters.txt", {re.sub(r"\[\d+]", "[N]", name) for name in last_list(str(caught.value))}
    )


def test_v010_calibration_aims_as_before(old, capsys):
    arguments = ["--pixel", 400, 200, "--depth", 9, "--target", "book", "--wanted-px", 60, "--rig", "rig_captures.toml"]
    now, then = run(capsys, "aim", "--calibration", "calibration.json", *arguments), read(old / "printed" / "aim.json")
    assert_close(now, then, SAME)
    assert_listed("printed.txt", {f"aim: {key}" for key in keys_in(now)}, begins="aim:")


# --- captures ---


# Which a calibration from saved captures does not have.
OF_SESSIONS = [
    f"provenance.{key}" for key in ("rig", "seed", "placements", "stops", "far_placements", "focal_range_px")
]


def test_v010_captures_are_calibrated(old, capsys):
    now = run(capsys, "calibrate", "--from", "captures", "--out", "now.json")
    then = read(old / "printed" / "calibrate.json")
    assert now["fixed_views"] == pytest.approx(then["fixed_views"], abs=VIEWS)
    assert now["zoom_views"] == pytest.approx(then["zoom_views"], abs=VIEWS)
    for key in ("fixed_rms_px", "zoom_rms_px", "stereo_rms_px", "handeye_rms_px"):
        assert now[key] == pytest.approx(then[key], abs=CORNERS_PX)
    keys = {re.sub(r"\d+", "N", key) for key in keys_in(now)}
    assert_listed("printed.txt", {f"calibrate: {key}" for key in keys}, begins="calibrate:")
    assert_keys("calibration_json.txt", read(old / "now.json"), may_lack=[*OF_SESSIONS, "provenance.photos"])
    found, before = Calibration.load(old / "now.json"), Calibration.load(OLD / "calibration.json")
    for name in ("T_zoom0_fixed", "T_head_zoom"):
        apart = getattr(found.zoom_head, name).inv() * getattr(before.zoom_head, name)
        assert np.linalg.norm(apart.translation) < CAPTURES_M
        assert np.degrees(apart.rotation.magnitude()) < CAPTURES_DEG
    assert found.fixed.lens.focal_px == pytest.approx(before.fixed.lens.focal_px, rel=CAPTURES_FOCAL)


def assert_is_captures(folder, may_lack=()):
    names = {re.sub(r"\d", "N", path.name) for path in folder.iterdir()}
    assert_listed(
        "captures.txt", {f"file {name}" for name in names} | {f"file {name}" for name in may_lack}, begins="file "
    )
    assert_keys("captures.txt", read(folder / "index.json"), begins="index.json ")
    session = read(folder / "session.json")
    assert_keys("captures.txt", {**session, "config": None}, begins="session.json ")
    assert_config(session["config"])
    commands = read_lines(folder / "commands.jsonl")
    assert {key for command in commands for key in keys_in(command)} == set(
        listed_keys("captures.txt", "commands.jsonl ")
    )
    assert_listed("captures.txt", {f"do {command['do']}" for command in commands}, begins="do ")


def assert_config(table):
    """A configuration that the program wrote down has keys of rig.toml only, and can be read."""
    free = ("sim.models.", "sim.paths.", "hardware.zoom.settings.", "targets.")
    names = {key.split(".")[-1] for key in KEYS if key.startswith("targets.")}
    for key in keys_in(table):
        known = key in KEYS or key.startswith(free)
        assert known, f"the key {key} is written, which rig.toml does not have"
        if key.startswith("targets."):
            assert key.split(".")[-1] in names
    parse_config(table)


def test_captures_have_the_listed_keys():
    assert_is_captures(OLD / "captures")


@pytest.mark.render
def test_captures_are_written_with_the_listed_keys(old, capsys):
    """A session that does not find the board with the zoom camera has written some of everything."""
    text = (old / "rig_captures.toml").read_text()
    (old / "rig.toml").write_text(f"{text}\n[sim.head]\npan_deg = [-1, 1]\ntilt_deg = [-1, 1]\n")
    change = "T_head_zoom = { translation = [0, 0, 0], rotvec_deg = [0, 180, 0] }  # it looks back\n"
    (old / "rig.toml").write_text(
        (old / "rig.toml").read_text().replace('scene = "plain.xml"\n', f'scene = "plain.xml"\n{change}')
    )
    assert main(["calibrate", "--rig", "rig.toml", "--captures", "taken"]) == 1
    assert "--from taken" in capsys.readouterr().err  # fits what there is
    assert_is_captures(old / "taken", may_lack=["NNNN_zoom_boardNN.png"])


# --- recordings ---


def assert_is_recording(folder, may_lack=()):
    files = [path for path in folder.rglob("*") if path.is_file()]
    names = {f"file {re.sub('[0-9]', 'N', str(path.relative_to(folder)))}" for path in files}
    lacks = {f"file {name}" for name in (*may_lack, "policy.onnx")}  # of a learnt policy alone
    assert_listed("recordings.txt", names | lacks, begins="file ")
    meta = read(folder / "recording.json")
    assert_config(meta["config"])
    for key in ("recording", "safety.stop_file"):
        assert key not in keys_in(meta["config"])
    table = meta.pop("whom")
    assert len(table) <= 1
    assert {f"whom.{key}" for key in table} <= listed_keys("recordings.txt", "recording.json ").keys()
    assert_keys("recordings.txt", {**meta, "config": 0}, begins="recording.json ", may_lack=["whom"])
    first, *events, last = read_lines(folder / "log.jsonl")
    assert_keys("recordings.txt", first["rig"], begins="rig ", may_lack=LATER)
    assert_keys("recordings.txt", last, begins="end ")
    known = set(listed_keys("recordings.txt", "event "))
    assert {key for event in events for key in event} <= known
    counts = {call: (arguments, int(results)) for call, arguments, results in calls()}
    for event in events:
        arguments, results = counts[event["call"]]
        assert len(event.get("args", [])) in arguments
        assert len(event.get("result", [])) == (0 if "error" in event else results)


def calls():
    """The listed calls: name, how many arguments, how many results."""
    for line in listed("recordings.txt"):
        if line.startswith("call "):
            name, _, rest = line.removeprefix("call ").partition(" ")
            arguments, _, results = rest.partition(" -> ")
            yield name, {int(number) for number in arguments.split(" or ")}, results


def test_recordings_have_the_listed_keys():
    assert_is_recording(OLD / "recording")


def test_v010_recording_is_replayed(old, capsys):
    status = main(["replay", "recording", "--check", "--csv", "now.csv", "--video", "now.mp4"])
    printed = capsys.readouterr()
    now, then = json.loads(printed.out), read(old / "printed" / "replay.json")
    assert now["steps"] == 7
    assert now["states"] == {
        "searching": 3,
        "following": 4,
        "unconfirmed": 0,
        "coasting": 0,
        "lost": 0,
        "unreachable": 0,
    }
    differences = now["differences"]
    assert status == (0 if differences["frames_differing"] == 0 else 1)
    assert (differences["missing"], differences["extra"], differences["moves"]) == (0, 0, 4)
    # A commit that changes the commands on purpose widens this: a book may start faster than in 0.1.0.
    assert differences["largest_deg"] < COMMANDS_DEG
    assert differences["largest_px"] < COMMANDS_PX
    keys = keys_in(now) - {key for key in keys_in(now) if key.startswith("reasons.")}
    assert keys == keys_in(then) - {key for key in keys_in(then) if key.startswith("reasons.")} | NEW_KEYS
    assert_listed("printed.txt", {f"replay: {key}" for key in keys} | {"replay: reasons"}, begins="replay:")
    assert set(now["states"]) == set(columns("state"))
    with av.open(str(old / "now.mp4")) as film:
        assert (film.streams.video[0].codec_context.name, film.streams.video[0].pix_fmt) == ("h264", "yuv420p")
    assert header(old / "now.csv") == columns("follow.csv")
    for a, b in zip(table_rows(old / "now.csv"), table_rows(old / "follow.csv"), strict=True):
        numbers = {key for key in b if key not in ("state", "reason", "track")}
        assert (a["state"], a["track"]) == (b["state"], b["track"])
        assert [float(a[key] or "nan") for key in numbers] == pytest.approx(
            [float(b[key] or "nan") for key in numbers], rel=COMMANDS, abs=COMMANDS_PX, nan_ok=True
        )


@pytest.mark.parametrize("table", [{}, {"click": [72.0, 78.0]}, {"track": 1}, {"policy": "nearest-deadline"}])
def test_recorded_selection_is_read(table, old, capsys):
    path = old / "recording" / "recording.json"
    path.write_text(json.dumps(read(path) | {"whom": table}))
    assert set(table) <= {key.removeprefix("whom.") for key in listed_keys("recordings.txt", "recording.json ")}
    assert run(capsys, "replay", "recording")["states"]["following"] == 4


def test_a_recording_is_a_rig(old, capsys):
    now = run(capsys, "follow", "--rig", "rig_replay.toml", "--calibration", "calibration.json", "--target", "book")
    assert (now["steps"], now["states"]["following"]) == (7, 4)
    keys = {key for key in keys_in(now) if not key.startswith("reasons.")} | {"reasons"}
    assert_listed("printed.txt", {f"follow: {key}" for key in keys}, begins="follow:")


@pytest.mark.render
def test_a_recording_is_written_with_the_listed_keys(old, capsys):
    arguments = ["--calibration", "calibration.json", "--target", "book", "--policy", "most-served", "--seconds", 0.75]
    now = run(capsys, "follow", "--rig", "rig_recording.toml", *arguments, "--csv", "now.csv", "--record", "now")
    assert now["states"]["following"] == 4
    assert_is_recording(old / "now")
    assert header(old / "now.csv") == columns("follow.csv")
    assert read(old / "now" / "recording.json")["whom"] == {"policy": "most-served"}


NEW_KEYS = {"skipped", "started", "states.unconfirmed"}  # of follow and replay, which v0.1.0 did not print
NEW_COLUMNS = ["utc", "skipped"]  # of follow.csv


def fake_rig(failing):
    """A rig whose devices answer the same in every run; its lens first fails with the given errors."""
    now, failing = [100.0], list(failing)

    def read(newer_than=None, timeout=1.0):
        now[0] += 0.25
        return Frame(np.full((3, 4, 3), int(now[0]), np.uint8), now[0] - 0.125)

    def lens():
        if failing:
            raise failing.pop(0)
        return ZoomState(300.0, False, now[0])

    def sleep_until(t):
        now[0] = max(now[0], t)

    def nothing(*_):
        pass

    limits = alike((-2.5, 2.5), (-0.75, 0.5), math.inf, 4.0, 0.0)
    return SimpleNamespace(
        real_time=True,
        fixed=SimpleNamespace(size=(4, 3), read=read),
        zoom=SimpleNamespace(
            size=(4, 3), still_size=(8, 6), focal_range=(100.0, 1200.0), read=read, state=lens,
            zoom=lambda focal_px: min(focal_px, 1200.0),
            capture=lambda: Frame(np.full((6, 8, 3), 7, np.uint8), now[0] - 0.0625),
        ),
        head=SimpleNamespace(
            limits=limits, halt=nothing, state=lambda: PanTiltState(0.125, -0.25, True, now[0]),
            move=lambda pan, tilt, speed=None, wait=False: (pan, min(tilt, limits.tilt.range[1])),
        ),
        clock=SimpleNamespace(now=lambda: now[0], sleep_until=sleep_until),
        board=SimpleNamespace(patience=0.0, present=nothing, swing=nothing),
    )  # fmt: skip


class SilentError(DeviceError):
    """An error of a driver, which cotarget.errors does not have."""


ERRORS = ("StaleFrameError", "HaltedError", "EmergencyStopError", "DeviceError", "CalibrationError", "ConfigError")


def every_call(rig):
    """Make each call on a rig; what it answers."""
    T = pose([0.5, -0.25, 2.0], [0.0, 0.0, 90.0])
    for _ in (*ERRORS, "SilentError", "ValueError"):
        try:
            rig.zoom.state()
        except Exception as error:
            names = [name for name in ERRORS if type(error) is getattr(errors, name)]
            yield *(names or [type(error).__name__]), str(error)
    yield rig.fixed.read().t
    yield rig.fixed.read(newer_than=100.0, timeout=0.5).t
    yield rig.zoom.read(timeout=0.25).t
    yield rig.zoom.capture().image.shape
    yield rig.zoom.zoom(2000.0)
    yield dataclasses.astuple(rig.zoom.state())
    yield rig.head.move(0.1, 0.75)
    yield rig.head.move(0.1, 0.25, 0.5)
    yield rig.head.move(0.1, 0.25, (0.5, 0.25), wait=True)
    yield dataclasses.astuple(rig.head.state())[:4]
    yield rig.head.halt()
    yield rig.clock.sleep_until(102.0)
    yield rig.clock.now()
    yield rig.board.present(T)
    yield rig.board.present(None)
    yield rig.board.swing(T)


def record_every_call(folder):
    """Record one of each call, and one from another thread."""
    config = parse_config({"targets": {"book": {"template": "small_book.png"}}})
    failures = [
        *(getattr(errors, name)(f"said by {name}") for name in ERRORS),
        SilentError("no answer"),
        ValueError("3"),
    ]
    with (
        Recorder(folder, config, OLD / "calibration_plain.json", "bird") as recorder,
        recorder.wrap(rig_of(fake_rig(failures))) as rig,
    ):
        answers = list(every_call(rig))
        aside = threading.Thread(target=rig.head.halt)
        aside.start()
        aside.join()
    return answers


ANSWERS = [
    *((name, f"said by {name}") for name in ERRORS),
    *(("SilentError", "no answer"), ("ValueError", "3")),
    *(100.125, 100.375, 100.625, (6, 8, 3), 1200.0, (300.0, False, 100.75)),
    *((0.1, 0.5), (0.1, 0.25), (0.1, 0.25), (0.125, -0.25, True, 100.75)),
    *(None, None, 102.0, None, None, None),
]
# An error that is not one of cotarget.errors is raised again as a device's.
REPLAYED = [
    *ANSWERS[:6],
    *(("DeviceError", "SilentError: no answer"), ("DeviceError", "ValueError: 3")),
    *ANSWERS[8:],
]


LATER = ("fixed_rate_hz", "fixed_latency_s", "zoom_rate_hz", "zoom_latency_s", "zoom_pitch_mm", "zoom_delay_s",
         "head_delay_s", "error_class", "repeated", "number")  # keys that v0.1.0 did not write  # fmt: skip


def plain_log(folder):
    """The log without what depends on the version of the library that writes PNGs, and without later keys."""
    first, *rest = read_lines(folder / "log.jsonl")
    spec = {key: first["rig"][key] for key in first["rig"] if key not in LATER}
    return [{"rig": spec}, *({key: line[key] for key in line if key not in ("bytes", *LATER)} for line in rest)]


def test_every_call_is_recorded_as_before(tmp_path):
    assert record_every_call(tmp_path / "now") == ANSWERS
    assert plain_log(tmp_path / "now") == plain_log(OLD / "every_call")
    assert_is_recording(tmp_path / "now", may_lack=["template.png"])


def test_states_of_uncertain_angles_and_limits_that_differ_are_replayed(tmp_path):
    """As of a dome whose axes differ, and which does not say how it accelerates."""
    limits = PanTiltLimits(AxisLimits((-2.5, 2.5), 1.0, None, 0.01, 0.02), AxisLimits((-0.75, 0.5), 0.5, 2.0, 0.005))
    said = [PanTiltState(0.125, -0.25, False, 100.0 + i, sigma) for i, sigma in enumerate((0.0, 0.01))]
    fake, states = fake_rig([]), iter(said)
    fake.head.limits, fake.head.state = limits, lambda: next(states)
    with (
        Recorder(tmp_path / "dome", parse_config({}), OLD / "calibration_plain.json", "bird") as recorder,
        recorder.wrap(rig_of(fake)) as rig,
    ):
        rig.fixed.read()
        assert [rig.head.state() for _ in said] == said
        rig.fixed.read(100.125)
    recording = open_recording(tmp_path / "dome")
    assert recording.spec.head.limits == limits
    rig = Replay(recording).rig
    rig.fixed.read()
    assert [rig.head.state() for _ in said] == said


def test_v010_recording_of_every_call_has_all_listed_keys():
    assert_is_recording(OLD / "every_call", may_lack=["template.png"])
    _, *events, _ = read_lines(OLD / "every_call" / "log.jsonl")
    assert {event["call"] for event in events} == {name for name, _, _ in calls()}
    assert {key for event in events for key in event} == set(listed_keys("recordings.txt", "event ")) - {*LATER}


def test_v010_recording_of_every_call_is_replayed():
    recording = open_recording(OLD / "every_call")
    spec = recording.spec
    assert (spec.fixed.size, spec.zoom.size, spec.zoom.still_size) == ((4, 3), (4, 3), (8, 6))
    assert (spec.zoom.focal_range, spec.real_time) == ((100.0, 1200.0), True)
    assert (spec.fixed.rate_hz, spec.zoom.rate_hz, spec.head.delay_s) == (25.0, 25.0, 0.04)  # of the configuration
    assert spec.head.limits == alike((-2.5, 2.5), (-0.75, 0.5), math.inf, 4.0, 0.0)
    assert (recording.target, recording.ending, recording.truncated) == ("bird", "complete", False)
    assert list(every_call(Replay(recording).rig)) == REPLAYED


def test_errors_have_the_listed_names():
    """A class may have another name besides, as long as recordings have the listed one."""
    lines = {line for line in listed("recordings.txt") if line.startswith("error ")}
    pairs = {name: base for name, _, base in (line.removeprefix("error ").partition(": ") for line in lines)}
    for name, base in pairs.items():
        assert getattr(errors, name).__base__ is (Exception if base == "Exception" else getattr(errors, base))
    found = {kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, CotargetError)}
    new = found - {getattr(errors, name) for name in pairs}
    assert not new, f"{new} are new errors: if they are added on purpose, write them into tests/formats/recordings.txt"


@pytest.mark.parametrize("line", [line for line in listed("recordings.txt") if line.startswith("error ")])
def test_a_recorded_error_is_raised_again(line, tmp_path):
    name, _, base = line.removeprefix("error ").partition(": ")
    folder = tmp_path / "run"
    shutil.copytree(OLD / "every_call", folder)
    log = (folder / "log.jsonl").read_text()
    (folder / "log.jsonl").write_text(log.replace('"StaleFrameError"', f'"{name}"', 1))
    with pytest.raises(getattr(errors, name)) as caught:
        Replay(open_recording(folder)).rig.zoom.state()
    assert str(caught.value) == "said by StaleFrameError"
    assert isinstance(caught.value, getattr(errors, base, Exception))


# --- tables, scores and films ---


def test_v010_film_gives_a_track_as_early_and_as_near_to_its_labels(old, capsys):
    now = run(capsys, "detect", "film.mp4", "--target", "person", "--csv", "now.csv", "--labels", "labels.csv")
    then = read(old / "printed" / "detect.json")
    assert now.keys() >= then.keys()
    assert (now["frames"], now["rate_hz"], now["tracks"], now["labelled_frames"]) == (75, 25.0, 1, 45)
    labels = {line.removeprefix("labels: ") for line in listed("printed.txt") if line.startswith("labels: ")}
    assert labels <= set(now)
    assert_listed("printed.txt", {f"detect: {key}" for key in set(now) - labels}, begins="detect:")
    assert header(old / "now.csv") == columns("tracks.csv")
    now, then = (
        {(row["frame"], row["t"], row["track"]): [float(row[key]) for key in ("u_px", "v_px")] for row in rows}
        for rows in (table_rows(old / "now.csv"), table_rows(old / "tracks.csv"))
    )
    middles = {
        row["frame"]: [
            float(row[f"{a}_px"]) + (float(row[f"{side}_px"]) - 1) / 2 for a, side in (("x", "width"), ("y", "height"))
        ]
        for row in table_rows(old / "labels.csv")
    }
    assert now.keys() >= then.keys()
    assert all(math.dist(center, middles[frame]) < DETECTED_PX for (frame, *_), center in now.items())


def test_replay_scores_by_labels_with_the_listed_keys(old, capsys):
    labels = {line.removeprefix("labels: ") for line in listed("printed.txt") if line.startswith("labels: ")}
    assert labels <= set(run(capsys, "replay", "recording", "--labels", "labels.csv"))


def test_v010_tables_are_read():
    tracks, labels = read_tracks(OLD / "tracks.csv"), read_labels(OLD / "labels.csv")
    assert (tracks[0].frame, tracks[0].t, tracks[0].track) == (36, 1.44, 1)
    assert tracks[0].center_px == pytest.approx([37.27, 53.30])
    assert len(tracks) == 39
    (label,) = labels[30]  # at (20, 45) of 10x20 pixels
    assert label.center_px == pytest.approx([24.5, 54.5])
    assert header(OLD / "labels.csv") == columns("labels.csv")
    assert header(OLD / "tracks.csv") == columns("tracks.csv")
    assert [*header(OLD / "follow.csv"), *NEW_COLUMNS] == columns("follow.csv")


NEW_SCORES = {"centred_yield"}  # scores that v0.1.0 did not have


def test_v010_steps_give_the_same_scores(tmp_path):
    rows = read_rows(OLD / "demo" / "steps.csv")
    first = table_rows(OLD / "demo" / "steps.csv")[0]
    assert (rows[0].t_s, rows[0].target, rows[0].in_wide) == (float(first["t_s"]), "bird", first["in_wide"] == "True")
    found, then = dataclasses.asdict(score(rows)), read(OLD / "demo" / "score.json")
    assert found.keys() - then.keys() == NEW_SCORES
    assert {key: found[key] for key in then} == pytest.approx(then, rel=1e-12)
    write_rows(tmp_path / "steps.csv", rows)
    old = (OLD / "demo" / "steps.csv").read_text().splitlines()
    assert (tmp_path / "steps.csv").read_text().splitlines() == [
        old[0] + ",hidden",
        *(f"{line},False" for line in old[1:]),
    ]
    assert header(tmp_path / "steps.csv") == columns("steps.csv")


def test_v010_metrics_are_read():
    metrics = read(OLD / "demo" / "metrics.json")
    targets = metrics.pop("targets")
    assert set(targets) == {"book", "person", "bird"}
    for scores in targets.values():
        assert_listed(
            "metrics_json.txt", {f"targets.NAME.{key}" for key in {*scores, *NEW_SCORES}}, begins="targets.NAME."
        )
    assert set(read(OLD / "demo" / "score.json")) == set(targets["bird"])
    others = {line for line in listed("metrics_json.txt") if not line.startswith("targets.")}
    assert keys_in(metrics) == others
    assert "22.9 m" in summary({**metrics, "targets": targets}).splitlines()[-1]  # how far the bird was


# --- boards ---


@pytest.mark.parametrize("kind", ["chessboard", "charuco"])
def test_board_is_printed_as_before(kind, tmp_path, capsys):
    """Boards that were printed are still to be found, so that squares and markers stay where they are."""
    out = tmp_path / "board.png"
    assert main(["board", "--out", str(out), "--kind", kind, "--board", "4x3", "--square", "0.01"]) == 0
    printed = capsys.readouterr().out
    table = tomllib.loads(printed[printed.index("[board]") :])
    assert table == {"board": {"kind": kind, "corners": [4, 3], "square": 0.01}}
    now, then = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in (out, OLD / f"board_{kind}.png"))
    assert now.shape == then.shape
    pattern = slice(0, round(5 / 6 * len(then)))  # below it are words, in what font there is
    assert np.mean(now[pattern] != then[pattern]) < PRINTED


# --- stops ---


def test_v010_stop_file_stops(tmp_path, capsys, monkeypatch):
    shutil.copytree(OLD / "stopped", tmp_path / "rig")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(EmergencyStopError, match="smoke"):
        refuse_if_stopped(Path("rig/stop"))
    assert main(["point", "--rig", "rig/rig.toml"]) == 1
    assert "smoke" in capsys.readouterr().err
    assert main(["clear", "--rig", "rig/rig.toml"]) == 0
    assert "smoke" in capsys.readouterr().out
    assert not Path("rig/stop").exists()
    assert main(["stop", "--rig", "rig/rig.toml", "--reason", "smoke"]) == 0
    assert Path("rig/stop").read_bytes() == (OLD / "stopped" / "stop").read_bytes()


def test_v010_position_lost_file_is_read(tmp_path, monkeypatch):
    name = "stop.dev-ttyUSB0.position-lost"
    for port in ("/dev/ttyUSB0", "/dev/ttyUSB1"):  # the same unit, at another port maybe
        with pytest.raises(DeviceError, match="hit a limit"):
            PositionLostMarker(port, OLD / "stopped" / "stop").refuse()
    lost = PositionLostMarker("/dev/ttyUSB0", tmp_path / "stop")
    lost.refuse()
    lost.note((OLD / "stopped" / name).read_text().strip())
    assert (tmp_path / name).read_bytes() == (OLD / "stopped" / name).read_bytes()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    PositionLostMarker("socket://127.0.0.1:4001", None).note("lost")
    assert (tmp_path / "state" / "cotarget" / "head.socket-127.0.0.1-4001.position-lost").read_text() == "lost\n"
