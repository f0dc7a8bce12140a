"""The table of a run's Steps, and its recording, which is whole whenever the run stops."""

import dataclasses
import errno
import itertools
import json
import math
import threading
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from cotarget.backends import open_recording
from cotarget.calibration import Calibration
from cotarget.config import DEFAULT_TARGETS, RigConfig, parse_config
from cotarget.errors import ConfigError, CotargetError, DeviceError
from cotarget.pipeline import State
from cotarget.recording import recorder as writing
from cotarget.recording.format import CALLS, Event, event_line, parse_event
from cotarget.recording.recorder import COLUMNS, Recorder, step_row
from cotarget.recording.replay import Replay
from cotarget.rig import Frame, PanTiltState, ZoomState
from tests.support.full_disk import SAID, full_disk
from tests.support.recorded_run import CONFIG, SIZE, ToyDevices, calibration_file, record, run, toy_rig
from tests.support.rigs import guarded, rig_of
from tests.support.steps import PICTURE, step

IMAGE_BYTES = SIZE[0] * SIZE[1] * 3
FOLLOWED = dataclasses.replace(
    step(0.5),
    t=0.56,
    zoom=Frame(PICTURE, 0.48),
    commanded=(math.radians(30), math.radians(-20), 4800.0),
    head=PanTiltState(math.radians(29), math.radians(-19), True, 0.56),
    lens=ZoomState(4700.0, True, 0.56),
    skipped=3,
)
LOST = dataclasses.replace(
    FOLLOWED, state=State.LOST, reason='out of sight, says "it"\nfor 0.5 s', target=None, aim=None, tracks=()
)


def test_a_step_is_one_row_of_the_table():
    first = dict(zip(COLUMNS, step_row(FOLLOWED, datetime(2024, 2, 29, tzinfo=UTC)), strict=True))
    numbers = {"index": 0, "t_s": 0.56, "t_fixed_s": 0.5, "t_zoom_s": 0.48, "track": 1, "u_px": 30, "v_px": 20,
               "width_px": 8, "height_px": 8, "depth_m": 10, "range_m": 10, "pan_commanded_deg": 30,
               "tilt_commanded_deg": -20, "focal_commanded_px": 4800, "pan_deg": 29, "tilt_deg": -19,
               "focal_px": 4700, "skipped": 3}  # fmt: skip
    assert {name: float(first[name]) for name in numbers} == pytest.approx(numbers)
    assert (first["state"], first["reason"], first["utc"]) == ("following", "", "2024-02-29T00:00:00.500+00:00")
    second = dict(zip(COLUMNS, step_row(LOST), strict=True))
    assert (second["state"], second["reason"], second["utc"]) == ("lost", LOST.reason, "")
    assert {second[name] for name in ("track", "u_px", "width_px", "depth_m", "range_m")} == {""}


def test_zeros_have_no_sign():
    row = step_row(dataclasses.replace(FOLLOWED, commanded=(-0.0, np.float64(-0.0), 4800.0), t=-0.0))
    assert [str(row[COLUMNS.index(name)]) for name in ("t_s", "pan_commanded_deg", "tilt_commanded_deg")] == ["0.0"] * 3


@pytest.fixture
def calibration_path(tmp_path):
    return calibration_file(tmp_path)


def rows_of(folder):
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def test_a_recording_holds_the_calls_and_frames_of_the_rig(tmp_path, calibration_path):
    """Files that another program can read: PNGs, and JSON lines whose numbers are those of the Steps."""
    steps = record(tmp_path / "run", calibration_path, seconds=0.5)
    folder = tmp_path / "run"
    assert (folder / "calibration.json").read_bytes() == calibration_path.read_bytes()
    about = json.loads((folder / "recording.json").read_text())
    assert (about["schema"], about["target"], about["config"]["backend"]) == (1, "bird", "sim")
    assert about["config"]["targets"]["bird"]["wanted_px"] == 30.0
    rows = rows_of(folder)
    assert rows[0]["rig"]["fixed_size"] == list(SIZE)
    assert rows[-1] == {"end": "complete", "dropped": 0}
    looks = [row for row in rows if row.get("call") == "fixed.read"]
    assert [row["result"] for row in looks] == [[step.fixed.t] for step in steps]
    for row, made in zip(looks, steps, strict=True):
        path = folder / row["image"]
        assert path.stat().st_size == row["bytes"]
        assert np.array_equal(cv2.imread(str(path)), made.fixed.image)
    closeups = [row["image"] for row in rows if row.get("call") == "zoom.read"]
    assert len(closeups) == len(steps)
    assert len(set(closeups)) == len({step.zoom.t for step in steps}) < len(steps)  # a frame seen twice is kept once
    moves = [row for row in rows if row.get("call") == "head.move"]
    assert tuple(moves[-1]["result"]) == steps[-1].commanded[:2]
    assert rows[-2]["call"] == "head.halt"
    times = [row["at"] for row in rows[1:-1]]
    assert times == sorted(times)
    assert {path.suffix for path in folder.rglob("*") if path.is_file()} == {".json", ".jsonl", ".png"}
    assert "recording" not in {thread.name for thread in threading.enumerate()}


def test_events_are_written_and_parsed_to_the_last_bit():
    rng = np.random.default_rng(1)
    for call, (arities, counts) in CALLS.items():
        for arity, count in itertools.product(arities, counts):
            args = tuple(rng.normal(size=arity) * 10.0 ** rng.integers(-300, 300, arity))
            result = tuple(rng.normal(size=count) * 1e-7)
            event = Event(call, float(rng.normal()), tuple(map(float, args)), tuple(map(float, result)))
            assert parse_event(json.loads(event_line(event))) == event
    odd = Event("head.move", 1.0, (math.inf, -0.0, None, True), (-math.inf, 5e-324), aside=True)
    back = parse_event(json.loads(event_line(odd)))
    assert back == odd
    assert math.copysign(1, back.args[1]) == -1
    failed = Event("zoom.capture", 1.0, error=("DeviceError", 'two\nlines and a "quote"'))
    assert "\n" not in event_line(failed)
    assert parse_event(json.loads(event_line(failed))) == failed


def test_no_password_is_recorded(tmp_path, calibration_path):
    table = {"backend": "hardware", "hardware": {"fixed": {"url": "http://me:secret@10.0.0.1/", "password": "secret"}}}
    with Recorder(tmp_path / "run", parse_config(table), calibration_path, "bird") as recorder:
        list(run(recorder.wrap(toy_rig()), Calibration.load(calibration_path), seconds=0.1))
    assert not [path for path in (tmp_path / "run").iterdir() if path.is_file() and b"secret" in path.read_bytes()]
    assert open_recording(tmp_path / "run").config.hardware.fixed["url"] == "http://10.0.0.1/"


def test_the_targets_template_is_copied_into_the_recording(tmp_path, calibration_path):
    picture = tmp_path / "cover.png"
    cv2.imwrite(str(picture), np.full((4, 5, 3), 99, np.uint8))
    book = dataclasses.replace(DEFAULT_TARGETS["book"], template=picture)
    with Recorder(tmp_path / "run", RigConfig(targets={"book": book}), calibration_path, "book") as recorder:
        list(run(recorder.wrap(toy_rig()), Calibration.load(calibration_path), seconds=0.1))
    picture.unlink()
    moved = (tmp_path / "run").rename(tmp_path / "elsewhere")
    template = open_recording(moved).config.target("book").template
    assert template == moved / "template.png"
    assert cv2.imread(str(template)).shape == (4, 5, 3)
    template.unlink()
    with pytest.raises(ConfigError, match=r"template\.png: "):
        open_recording(moved)


def prepare(tmp_path, what):
    folder = tmp_path / "run"
    if what == "full":
        folder.mkdir()
        (folder / "dear.txt").write_text("keep me")
    if what == "file":
        folder.write_text("keep me")
    if what == "under a file":
        (tmp_path / "file").write_text("")
        folder = tmp_path / "file" / "run"
    return folder


@pytest.mark.parametrize(("what", "target", "calibration", "named"), [
    ("full", "bird", "rig_calibration.json", "run: "),
    ("file", "bird", "rig_calibration.json", "run: "),
    ("under a file", "bird", "rig_calibration.json", "run: "),
    ("", "yeti", "rig_calibration.json", "'yeti'"),
    ("", "bird", "none.json", "none.json: "),
    ("", "book", "rig_calibration.json", "nowhere.png: "),
])  # fmt: skip
def test_a_recording_that_cannot_begin_is_refused_and_leaves_no_files(
    tmp_path, calibration_path, what, target, calibration, named
):
    folder = prepare(tmp_path, what)
    before = sorted(tmp_path.rglob("*"))
    book = dataclasses.replace(DEFAULT_TARGETS["book"], template=Path("nowhere.png"))
    config = dataclasses.replace(CONFIG, targets={**CONFIG.targets, "book": book})
    with pytest.raises(ConfigError, match=named) as caught:
        Recorder(folder, config, tmp_path / calibration, target)
    assert "\n" not in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before
    assert "recording" not in {thread.name for thread in threading.enumerate()}


@pytest.mark.parametrize("room", [0, 1000])
def test_a_full_disk_at_the_beginning_names_the_recordings_folder(tmp_path, calibration_path, room):
    folder = tmp_path / "run"
    with full_disk(room), pytest.raises(ConfigError, match=rf"run: .*{SAID}"):
        Recorder(folder, CONFIG, calibration_path, "bird")
    assert not folder.exists()


@pytest.mark.parametrize("exists", [False, True])
def test_a_recording_of_a_rig_that_cannot_be_opened_is_removed(tmp_path, calibration_path, exists):
    folder = tmp_path / "run"
    if exists:
        folder.mkdir()
    with pytest.raises(DeviceError, match="no such port"), Recorder(folder, CONFIG, calibration_path, "bird"):
        raise DeviceError("no such port")
    assert folder.exists() == exists
    assert not exists or not list(folder.iterdir())
    assert record(folder, calibration_path, seconds=0.1)


def test_a_rig_that_cannot_be_wrapped_is_closed(tmp_path, calibration_path):
    devices = ToyDevices()
    rig = dataclasses.replace(rig_of(devices), spec=None)
    with pytest.raises(AttributeError), Recorder(tmp_path / "run", CONFIG, calibration_path, "bird") as recorder:
        recorder.wrap(rig)
    assert devices.closed
    with pytest.raises(ConfigError, match="run: "):
        open_recording(tmp_path / "run")


def test_a_guarded_rig_is_not_recorded(tmp_path, calibration_path):
    """The log would lack the commands of the guard."""
    devices = ToyDevices()
    with Recorder(tmp_path / "run", CONFIG, calibration_path, "bird") as recorder:
        with guarded(devices, CONFIG.safety) as safe, pytest.raises(ConfigError, match="guarded"):
            recorder.wrap(safe)
        assert devices.closed
    assert not (tmp_path / "run").exists()


class Jammed:
    """A disk that writes no image until `free` is set."""

    def __init__(self, monkeypatch):
        self.free, self.begun = threading.Event(), threading.Event()
        write = writing.write_png

        def wait_and_write(path, image):
            self.begun.set()
            assert self.free.wait(60)
            return write(path, image)

        monkeypatch.setattr(writing, "write_png", wait_and_write)


def test_a_slow_disk_drops_and_counts_images_of_the_zoom_camera_alone(tmp_path, calibration_path, monkeypatch, caplog):
    """The zoom camera's images stay out, and the fixed camera's are all there; the run is the same to the last bit."""
    disk = Jammed(monkeypatch)
    monkeypatch.setattr(writing, "ZOOM_ROOM", 4 * IMAGE_BYTES)
    steps = []
    with Recorder(tmp_path / "run", CONFIG, calibration_path, "bird") as recorder:
        for step in run(recorder.wrap(toy_rig()), Calibration.load(calibration_path), seconds=2.0):
            steps.append(step)
        dropped = recorder.dropped
        disk.free.set()
    assert dropped == len({step.zoom.t for step in steps}) - 1  # of four images one, for its frames are rarer
    assert [record.levelname for record in caplog.records] == ["WARNING"]  # once
    assert rows_of(tmp_path / "run")[-1] == {"end": "complete", "dropped": dropped}
    recording = open_recording(tmp_path / "run")
    assert recording.steps == len(steps)
    assert len(recording.notes) == 1
    played = Replay(recording)
    again = list(run(played.rig, Calibration.load(calibration_path), seconds=2.0))
    assert [step.commanded for step in again] == [step.commanded for step in steps]
    assert played.differences.same


def test_a_run_waits_for_the_disk_to_take_the_fixed_cameras_images(tmp_path, calibration_path, monkeypatch):
    disk = Jammed(monkeypatch)
    monkeypatch.setattr(writing, "ROOM", 3 * IMAGE_BYTES)
    monkeypatch.setattr(writing, "ZOOM_ROOM", 0)
    steps = []

    def work():
        with Recorder(tmp_path / "run", CONFIG, calibration_path, "bird") as recorder:
            for step in run(recorder.wrap(toy_rig()), Calibration.load(calibration_path), seconds=0.5):
                steps.append(step)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    assert disk.begun.wait(60)
    thread.join(0.5)  # it does not end; were it slow, it would not either
    assert len(steps) <= 3
    assert thread.is_alive()
    disk.free.set()
    thread.join(60)
    assert not thread.is_alive()
    assert open_recording(tmp_path / "run").steps == len(steps)


def test_a_full_disk_ends_the_recording_but_not_the_run(tmp_path, calibration_path, monkeypatch, caplog):
    write = writing.write_png

    def fill_up(path, image):
        if path.parts[-2:] == ("fixed", "000010.png"):
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, image)

    monkeypatch.setattr(writing, "write_png", fill_up)
    steps = []

    def work():
        with Recorder(tmp_path / "run", CONFIG, calibration_path, "bird") as recorder:
            steps.extend(run(recorder.wrap(toy_rig()), Calibration.load(calibration_path), seconds=2.0))

    with pytest.raises(CotargetError, match=r"run: .*No space left on device"):
        work()
    assert len(steps) > 40
    assert ["No space left on device" in record.message for record in caplog.records] == [True]
    recording = open_recording(tmp_path / "run")
    assert recording.truncated
    assert recording.steps == 9
