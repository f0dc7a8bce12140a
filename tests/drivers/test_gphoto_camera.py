"""The driver of a zoom camera by gphoto2, against a camera that fails on command, and against the emulated one.

Most of it runs in simulated time without a thread. What happens on a real USB line (a claimed interface, a pulled
cable) is injected at the thin layer of calls: PTP/IP, which the wire tests use, has none of it.
"""

import contextlib
import logging
import math
import socket
import threading
from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest

from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.frame_buffer import FrameBuffer
from cotarget.drivers.gphoto_camera import GphotoCamera, GphotoSettings, SharedState, Shooting, freshness
from cotarget.errors import ConfigError, DeviceError, StaleFrameError
from tests.support.emulated_camera import DEADLINE_S
from tests.support.gphoto_link import CALL_S, CONFIG, PERIOD, PITCH_MM, SIZE, FakeLink, jpeg
from tests.support.plants import s5is_process, wait_for
from tests.support.simulated_clock import SimClock

GREY = 2.0  # grey levels by which JPEG may change an even picture
HELD_S = 2.0  # a thread that waits this long stood still while libgphoto2 waited 2.5 s for an answer
BUSY, BAD, IO, TIMEOUT, CLAIM = -110, -2, -7, -10, -53  # libgphoto2's results


class Bench:
    """The driver's work in simulated time, and what its users would do."""

    def __init__(self, config=CONFIG, prepare=lambda camera: None):
        self.clock = SimClock()
        self.buffer = FrameBuffer("the camera", self.clock, config.size, config.latency_s, freshness(config))
        self.shared = SharedState(self.buffer)
        self.camera = FakeLink(self.clock)
        prepare(self.camera)
        self.work = Shooting(config, self.clock, self.camera, self.shared)
        self.zoom = self.work.open()
        self.frames = []

    def run(self, seconds):
        until = self.clock.t + seconds
        while self.clock.t < until:
            due = self.work.work()
            with contextlib.suppress(DeviceError):
                self.frames.append(self.buffer.read(self.frames[-1].t if self.frames else None, 0.0))
            self.clock.t = max(self.clock.t, min(due, until))

    def newest(self):
        return self.buffer.read(timeout=0.0)

    def send(self, position):
        self.shared.wanted, self.shared.order = position, self.shared.order + 1
        self.shared.standing, self.shared.lens_trouble = False, ""


def changed(**changes):
    """Prepare a camera: by attributes, or update those that are dictionaries."""

    def prepare(camera):
        for name, value in changes.items():
            held = getattr(camera, name)
            held.update(value) if isinstance(held, dict) else setattr(camera, name, value)

    return prepare


def mistaken(camera):
    def names():
        raise TypeError("a mistake")

    camera.names = names


# Opening


def test_opening_enters_shooting_before_it_looks_for_the_lens():
    bench = Bench()
    assert bench.camera.log[:2] == [("open",), ("put", "capture", 1)]
    assert bench.camera.values["capturetarget"] == "Internal RAM"
    assert bench.camera.commands("zoom") == []
    assert bench.newest().image.shape == (24, 32, 3)


def test_a_camera_that_always_shoots_and_has_no_targets_is_taken_as_it_is():
    def prepare(camera):
        del camera.values["capture"], camera.values["capturetarget"]

    assert Bench(prepare=prepare).camera.commands("capture") == []


def test_settings_are_applied_and_a_target_of_the_users_own_is_left(caplog):
    settings = {"iso": "80", "owner": "us", "capturetarget": "Memory card", "datetime": "1190000000"}
    camera = Bench(replace(CONFIG, settings=settings)).camera
    assert camera.commands("capturetarget") == ["Memory card"]
    assert {name: camera.values[name] for name in settings} == settings | {"datetime": 1.19e9}
    assert caplog.messages == []


def test_a_setting_that_the_camera_takes_otherwise_is_a_warning(caplog):
    def prepare(camera):
        put = camera.put
        camera.put = lambda name, value: put(name, "NOBODY" if name == "owner" else value)

    Bench(replace(CONFIG, settings={"owner": "us"}), prepare)
    (said,) = caplog.messages
    assert "'owner' as 'NOBODY'" in said


# Settings of the user, what the camera is like, and the key that the error begins with.
REFUSED = [
    ({"isso": "80"}, {}, "hardware.zoom.settings"),
    ({"iso": "81"}, {}, "hardware.zoom.settings.iso"),
    ({"iso": "80"}, {"readonly": {"iso"}}, "hardware.zoom.settings.iso"),
    ({"zoom": "135"}, {}, "hardware.zoom.settings.zoom"),
    ({"zoom": "wide"}, {}, "hardware.zoom.settings.zoom"),
    ({"capture": "yes"}, {}, "hardware.zoom.settings.capture"),
    ({"datetime": "1.5"}, {}, "hardware.zoom.settings.datetime"),
    ({"datetime": "99999999999"}, {}, "hardware.zoom.settings.datetime"),
    ({}, {"range": (0.0, 100.0, 1.0)}, "hardware.zoom.lens"),
    ({}, {"range": (3.0, 134.0, 1.0)}, "hardware.zoom.lens"),
    ({}, {"range": (0.0, 1000.0, 500.0)}, "hardware.zoom.lens"),
    ({}, {"readonly": {"zoom"}}, "hardware.zoom.zoom_key"),
    ({}, {"choices": {"zoom": ("wide", "tele")}}, "hardware.zoom.zoom_key"),
    ({}, {"preview_size": (40, 30)}, "hardware.zoom.size"),
]


def refused(kind, config=CONFIG, prepare=lambda camera: None):
    """The error, of one line, that opening ends in; no connection is left."""
    cameras = []
    with pytest.raises(kind) as error:
        Bench(config, lambda camera: (cameras.append(camera), prepare(camera)))
    assert "\n" not in str(error.value)
    assert not cameras[0].connected
    return str(error.value)


@pytest.mark.parametrize(("settings", "changes", "key"), REFUSED)
def test_wrong_settings_and_cameras_are_named(settings, changes, key):
    assert refused(ConfigError, replace(CONFIG, settings=settings), changed(**changes)).startswith(f"{key}: ")


def test_a_camera_without_zoom_says_which_settings_it_has():
    def prepare(camera):
        camera.values = {f"d{i:03}": "" for i in range(100)} | {"eoszoom": "", "capture": 0.0}

    said = refused(ConfigError, prepare=prepare)
    assert said.startswith("hardware.zoom: ")
    assert said.endswith(" and 90 more")
    assert "eoszoom" in said


@pytest.mark.parametrize("prepare", [changed(frozen=b"no jpeg"), changed(fail={"open": [-105, -1]}), mistaken])
def test_a_camera_that_cannot_be_used_is_named_by_its_port(prepare):
    assert "'usb:'" in refused(DeviceError, prepare=prepare)


def test_opening_tries_once_more_and_then_says_why():
    assert Bench(prepare=changed(fail={"open": [IO]})).newest().image.shape == (24, 32, 3)
    assert "gvfs-gphoto2-volume-monitor" in refused(DeviceError, prepare=changed(fail={"open": [CLAIM, ...]}))


@pytest.mark.parametrize("call", ["put", "get", "preview"])
@pytest.mark.parametrize("code", [BUSY, BAD, IO, TIMEOUT])
def test_a_camera_that_is_busy_at_first_is_waited_for_and_one_that_stays_so_is_refused(call, code):
    if code in (BUSY, BAD):
        assert Bench(prepare=changed(fail={call: [code] * 5})).newest().image.shape == (24, 32, 3)
    assert f"[{code}]" in refused(DeviceError, prepare=changed(fail={call: [code, ...]}))


def test_a_lens_by_choices_is_sent_by_their_own_text():
    def prepare(camera):
        camera.choices = {"zoom": ("000", "064", "128", "Digital")}
        camera.values["zoom"] = "000"

    bench = Bench(prepare=prepare)
    assert bench.zoom.lens.positions == (0, 64, 128)
    bench.send(bench.zoom.lens.position_for(21.3 / PITCH_MM))
    bench.run(0.1)
    assert bench.camera.commands("zoom") == ["064"]
    assert bench.shared.standing


def test_a_lens_outside_the_table_is_brought_back():
    """At 134, in the digital zoom; the optical one ends at 128."""
    bench = Bench(prepare=changed(values={"zoom": 134.0}))
    bench.run(0.5)
    assert bench.camera.commands("zoom") == [128]


# Frames


def test_frames_are_dated_at_their_arrival_less_the_latency():
    bench = Bench()
    bench.run(2.0)
    times = [frame.t for frame in bench.frames]
    assert len(times) == pytest.approx(2.0 / PERIOD, abs=2)
    # A picture appears at a multiple of the period, is asked for within a repeat's pause and two calls after that, and
    # has been on its way for latency_s.
    late = [(t + 0.1) % PERIOD for t in times[1:]]
    assert max(late) < 0.005 + 2 * CALL_S + 1e-6
    assert len({frame.image.tobytes() for frame in bench.frames}) == len(bench.frames)


def test_no_more_frames_are_fetched_than_the_rate_allows():
    bench = Bench(replace(CONFIG, rate_hz=4.0))
    bench.camera.log.clear()
    bench.run(5.0)
    assert bench.camera.log.count(("preview",)) == pytest.approx(20, abs=1)


def test_a_frozen_viewfinder_is_not_asked_more_often_than_a_live_one():
    bench = Bench(prepare=changed(frozen=jpeg(SIZE, 77)))
    bench.run(5.0)
    bench.camera.log.clear()
    bench.run(10.0)
    assert len(bench.camera.log) == pytest.approx(10.0 * CONFIG.rate_hz, rel=0.1)


def test_a_slow_camera_may_be_slow():
    bench = Bench(replace(CONFIG, rate_hz=1.0))
    bench.camera.take["preview"] = 1.0
    bench.run(5.0)
    assert len(bench.frames) >= 3


def zeroed(data):
    """The second quarter of a JPEG's compressed data is lost, the rest is there."""
    start = data.index(b"\xff\xda") + 14
    long = (len(data) - 2 - start) // 4
    return data[: start + long] + bytes(long) + data[start + 2 * long :]


# Fault of the viewfinder: what the camera does, and the reason that reading gives while it lasts.
VIEW_FAULTS = {
    "cut short": ({"frozen": jpeg(SIZE, 50)[:-40]}, "broken"),
    "no start": ({"frozen": jpeg(SIZE, 50)[2:]}, "broken"),
    "nothing": ({"frozen": b""}, "broken"),
    "no picture": ({"frozen": b"\xff\xd8 nothing \xff\xd9"}, "broken"),
    "zeros": ({"frozen": zeroed(jpeg(SIZE, 50))}, "broken"),
    "frozen": ({"frozen": jpeg(SIZE, 77)}, "repeats"),
    "late": ({"take": {"preview": 1.0}}, "take 1 s to come"),
    "busy": ({"fail": {"preview": [BUSY, ...]}}, "[-110]"),
    "lost": ({"fail": {"preview": [IO, ...], "open": [IO, ...]}}, "[-7]"),
}


@pytest.mark.parametrize("name", VIEW_FAULTS)
def test_a_viewfinder_fault_is_named_and_recovered_from(name):
    changes, reason = VIEW_FAULTS[name]
    bench = Bench()
    bench.run(0.5)
    changed(**changes)(bench.camera)
    bench.run(1.5)
    newest = bench.frames[-1]
    with pytest.raises(StaleFrameError) as error:
        bench.buffer.read(newest.t, 0.0)
    assert reason in str(error.value)
    bench.run(0.5)
    assert bench.frames[-1] is newest
    assert bench.buffer.counts.refused > 0 or reason not in ("broken", "take 1 s to come")
    bench.camera.frozen = None
    bench.camera.take.clear()
    bench.camera.fail.clear()
    bench.run(2.0)
    assert bench.frames[-1].t > newest.t
    assert bench.buffer.waited_s < 2 * PERIOD


# The lens


def test_the_lens_is_sent_at_once_read_back_and_moves_as_estimated():
    """From 0 to 60 at 60 a second after 50 ms."""
    bench = Bench()
    bench.send(60)
    start = bench.clock.t
    bench.run(0.01)
    assert bench.camera.commands("zoom") == [60.0]
    assert bench.shared.standing
    assert bench.shared.motion.arrives == pytest.approx(start + 0.05 + 1.0)
    assert bench.shared.motion.position(start + 0.55) == pytest.approx(30.0)


# Fault of the lens: what the camera does, whether the lens arrives, and how often it is sent there.
LENS_FAULTS = {
    "busy": ({"fail": {"put": [BUSY] * 20}}, True, 21),
    "busy, as it says by another code": ({"fail": {"put": [BAD] * 10}}, True, 11),
    "refused for ever": ({"fail": {"put": [BAD, ...]}}, False, None),
    "one command ignored": ({"ignore": 1}, True, 2),
    "all commands ignored": ({"ignore": 99}, False, 2),
    "lost": ({"fail": {"put": [IO]}}, True, 2),
}


@pytest.mark.parametrize("name", LENS_FAULTS)
def test_a_lens_fault_is_recovered_from_or_lasts_until_the_next_command(name):
    changes, arrives, count = LENS_FAULTS[name]
    bench = Bench()
    changed(**changes)(bench.camera)
    bench.send(30)
    bench.run(0.5)
    assert bench.shared.standing == (name == "lost")
    bench.run(4.5)
    assert (bench.shared.standing, bench.shared.lens_trouble == "") == (arrives, arrives)
    assert count is None or len(bench.camera.commands("zoom")) == count
    assert bench.buffer.waited_s < 2 * PERIOD  # frames go on
    bench.camera.fail.clear()
    bench.camera.ignore = 0
    bench.send(31)
    bench.run(0.5)
    assert (bench.shared.standing, bench.camera.values["zoom"]) == (True, 31.0)


def test_a_camera_may_be_busy_now_and_then():
    """Each command is refused for 2 s, as a busy camera may; together that is longer than one may be."""
    bench = Bench()
    for position in (10, 20, 30):
        bench.camera.fail["put"] = [BUSY] * 20
        bench.send(position)
        bench.run(3.0)
        assert (bench.shared.standing, bench.camera.values["zoom"]) == (True, float(position))
    bench.camera.fail["preview"] = [*[BUSY] * 20, None] * 3
    bench.run(10.0)
    assert bench.camera.log.count(("open",)) == 1


def test_a_command_that_replaces_a_refused_one_has_its_own_chance():
    bench = Bench()
    bench.camera.fail["put"] = [BAD, ...]
    bench.send(30)
    bench.run(3.0)
    put = bench.camera.put

    def replaced(name, value):
        bench.send(40)
        bench.camera.put = put
        bench.clock.t += 1.0
        put(name, value)

    bench.camera.put = replaced
    bench.run(1.5)
    assert bench.shared.lens_trouble == ""
    bench.camera.fail.clear()
    bench.run(0.5)
    assert (bench.shared.standing, bench.camera.values["zoom"]) == (True, 40.0)


def test_a_setting_that_follows_the_lens_is_waited_for():
    """Some cameras show where the lens is, not where it was sent."""
    bench = Bench()
    get = bench.camera.get

    def following(name):
        return replace(get(name), value=float(round(bench.shared.motion.position(bench.clock.t))))

    bench.camera.get = following
    bench.send(60)
    bench.run(0.9)
    assert not bench.shared.standing
    bench.run(0.5)
    assert bench.shared.standing
    assert bench.camera.commands("zoom") == [60.0]


# Lost and found


@pytest.mark.parametrize("call", ["preview", "get", "put"])
@pytest.mark.parametrize("code", [IO, TIMEOUT, -52])
def test_a_camera_that_is_lost_is_found_again_and_its_lens_sent_back(call, code):
    bench = Bench()
    bench.camera.fail[call] = [code]
    bench.send(50)
    bench.run(0.05)
    bench.camera.values.update(capture=0.0, zoom=0.0)  # it was switched off, too
    bench.run(2.0)
    assert (bench.camera.values["capture"], bench.camera.values["zoom"], bench.shared.standing) == (1, 50.0, True)
    assert bench.buffer.waited_s < 2 * PERIOD
    assert bench.camera.threads == {threading.get_ident()}


def test_a_lens_that_is_where_it_was_is_not_sent_again():
    bench = Bench()
    bench.send(40)
    bench.run(1.0)
    bench.camera.fail["preview"] = [IO]
    bench.run(2.0)
    assert bench.camera.commands("zoom") == [40.0]
    assert bench.shared.standing


@pytest.mark.parametrize(
    ("changes", "said"), [({"fail": {"open": [IO, ...]}, "take": {"open": 2.5}}, "[-7]"),
                          ({"preview_size": (40, 30)}, "hardware.zoom.size")]
)  # fmt: skip
def test_a_camera_that_stays_away_or_comes_back_as_another_is_gone(changes, said):
    bench = Bench()
    bench.camera.fail["preview"] = [IO]
    changed(**changes)(bench.camera)
    bench.run(10.0)
    assert said in bench.buffer.gone
    assert "\n" not in bench.buffer.gone
    assert bench.work.work() == math.inf


def test_a_viewfinder_that_is_busy_for_long_is_opened_again():
    bench = Bench()
    bench.camera.fail["preview"] = [BUSY] * 40
    bench.run(10.0)
    assert bench.camera.log.count(("open",)) == 2
    assert bench.buffer.waited_s < 2 * PERIOD


@pytest.mark.parametrize("lost", [False, True])
def test_closing_ends_shooting_unless_the_camera_is_lost(lost):
    bench = Bench(prepare=changed(fail={"put": [None, None, IO]} if lost else {}))
    bench.work.close()
    assert bench.camera.commands("capture") == [1, 0]
    assert not bench.camera.connected


# On the camera's own thread


@contextlib.contextmanager
def opened(config=CONFIG, prepare=lambda camera: None):
    """The driver in real time on a camera that answers at once, and that camera."""
    link = FakeLink(MonotonicClock())
    prepare(link)
    camera = GphotoCamera(config, link.clock, link)
    try:
        yield camera, link
    finally:
        camera.close()
        assert "zoom camera" not in [thread.name for thread in threading.enumerate()]
        assert not link.connected


def trouble(call):
    """What a call's error says; empty if there is none."""
    try:
        call()
    except DeviceError as error:
        return str(error)
    return ""


def unreadable(camera, newer_than=math.inf):
    return trouble(lambda: camera.read(newer_than, 0.0))


def test_one_thread_has_the_camera_and_commands_do_not_wait_for_its_next_frame():
    """It would come in 100 s."""
    with opened(replace(CONFIG, rate_hz=0.01, lens_speed=1e4)) as (camera, link):
        camera.zoom(1000.0)
        wait_for(lambda: not camera.state().moving)
        still = camera.capture()
        assert still.image.shape == (48, 64, 3)
        assert np.abs(still.image - 200.0).max() <= GREY
        assert len(link.threads) == 1
        assert threading.get_ident() not in link.threads
    assert link.commands("capture") == [1, 0]


def test_a_lens_error_lasts_until_the_next_command(monkeypatch):
    monkeypatch.setattr("cotarget.drivers.gphoto_camera.VERIFY_S", 0.0)
    with opened(replace(CONFIG, lens_speed=1e4)) as (camera, link):
        link.ignore = 2
        camera.zoom(1000.0)
        wait_for(lambda: trouble(camera.state))
        camera.read(timeout=DEADLINE_S)
        camera.zoom(1000.0)
        wait_for(lambda: not camera.state().moving)
        assert len(link.commands("zoom")) == 3


def test_a_still_is_dated_in_the_middle_of_the_call_that_takes_it():
    """It takes 1 s; its transfer afterwards does not count."""
    bench = Bench()
    bench.camera.take.update(shoot=1.0, fetch=0.5)
    begin, bench.shared.still = bench.clock.t, (still := Future())
    bench.run(0.01)
    assert still.result(0.0).t == pytest.approx(begin + 0.5, abs=CALL_S)


def test_stills_of_another_size_say_what_to_write():
    with opened(prepare=changed(still_size=(80, 60))) as (camera, _):
        with pytest.raises(ConfigError, match=r"hardware\.zoom\.still_size: .*still_size = \[80, 60\]"):
            camera.capture()
        camera.read(timeout=DEADLINE_S)


# Fault of a still: what the camera does; the driver's limits [s]; whether there is a still in the end.
STILL_FAULTS = {
    "no JPEG": ({"still": b"raw"}, {}, False),
    "busy": ({"fail": {"shoot": [BUSY, BAD, None]}}, {}, True),
    "lost": ({"fail": {"shoot": [IO]}}, {}, False),
    "busy for long": ({"fail": {"shoot": [BUSY, ...]}}, {"STILL_LIMIT_S": 0.01}, False),
    "refused": ({"fail": {"shoot": [-1, ...]}}, {"BUSY_PATIENCE_S": 0.0}, False),
}


@pytest.mark.parametrize("name", STILL_FAULTS)
def test_after_a_still_fault_the_next_still_is_taken(monkeypatch, name):
    changes, limits, taken = STILL_FAULTS[name]
    with opened() as (camera, link):
        changed(**changes)(link)
        with monkeypatch.context() as patch:
            for limit, value in limits.items():
                patch.setattr(f"cotarget.drivers.gphoto_camera.{limit}", value)
            assert (trouble(camera.capture) == "") == taken
        link.fail.clear()
        link.still = None
        assert camera.capture().image.shape == (48, 64, 3)


def test_a_camera_that_is_gone_raises_at_every_call(monkeypatch):
    monkeypatch.setattr("cotarget.drivers.gphoto_camera.RECONNECT_S", 0.0)
    with opened() as (camera, link):
        link.fail = {"open": [IO, ...], "shoot": [BUSY, ...], "preview": [BUSY, BUSY, IO]}
        for call in (camera.capture, camera.read, camera.state, camera.capture, lambda: camera.zoom(1000.0)):
            with pytest.raises(DeviceError, match="is gone"):
                call()


def test_opening_fails_on_the_callers_thread():
    before = threading.active_count()
    for kind, changes in ((ConfigError, {"preview_size": (40, 30)}), (DeviceError, {"fail": {"open": [CLAIM, ...]}})):
        with pytest.raises(kind), opened(prepare=changed(**changes)):
            pass
    assert threading.active_count() == before


def test_opening_has_a_time_limit(monkeypatch):
    release = threading.Event()
    monkeypatch.setattr("cotarget.drivers.gphoto_camera.OPEN_LIMIT_S", 0.01)
    monkeypatch.setattr("cotarget.drivers.gphoto_camera.CLOSE_LIMIT_S", 0.01)
    with pytest.raises(DeviceError, match="did not open"), opened(prepare=changed(open=release.wait)):
        pass
    release.set()
    wait_for(lambda: "zoom camera" not in [thread.name for thread in threading.enumerate()])


def test_an_exception_in_the_driver_is_raised_by_read_without_traceback(caplog):
    caplog.set_level(logging.INFO)

    def wrong():
        raise RuntimeError("a mistake")

    with opened() as (camera, link):
        link.preview = wrong
        wait_for(lambda: "RuntimeError('a mistake')" in unreadable(camera))
    assert "Traceback" not in caplog.text


# On the wire: libgphoto2's Canon code against the emulated S5 IS, in a process of its own


@pytest.fixture(scope="module")
def process():
    with s5is_process() as emulator:
        yield emulator


@pytest.fixture
def emulated(process, tmp_path, monkeypatch):
    """The driver on the emulated camera; nothing is left in the user's home."""
    home = tmp_path / "home"
    (home / ".config").mkdir(parents=True)  # where libgphoto2 would write its own settings
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    with contextlib.closing(GphotoCamera(GphotoSettings(port=process.port), MonotonicClock())) as camera:
        yield camera
    assert [path.name for path in home.rglob("*")] == [".config"]


def newer(camera, t):
    """Whether there is a frame newer than a time; the camera may have to be found again until then."""
    with contextlib.suppress(StaleFrameError):
        return camera.read(t, 1.0).t > t
    return False


@pytest.mark.wire
@pytest.mark.parametrize("fault", ["power-off", "busy"])
def test_an_emulated_camera_goes_on_after_a_fault(emulated, process, fault):
    wait_for(lambda: not emulated.state().moving)
    process.switch(fault)
    if fault == "power-off":
        wait_for(lambda: "reconnecting" in unreadable(emulated))
    emulated_goal = emulated.zoom(61.4 / PITCH_MM)  # position 105
    with pytest.raises(StaleFrameError):
        emulated.read(MonotonicClock().now(), 0.3)
    process.switch(fault, on=False)
    now = MonotonicClock().now()
    wait_for(lambda: newer(emulated, now))
    wait_for(lambda: not emulated.state().moving)
    assert emulated.state().focal_px == emulated_goal
    assert process.lens() == 105


@pytest.mark.wire
def test_a_hung_camera_stops_no_other_thread_and_is_found_again(emulated, process):
    """libgphoto2 waits 2.5 s for each answer; that must not be spent with Python's interpreter lock held."""
    clock, gaps, done = MonotonicClock(), [0.0], threading.Event()

    def tick():
        last = clock.now()
        while not done.wait(0.01):
            gaps.append(clock.now() - last)
            last = clock.now()

    ticker = threading.Thread(target=tick, daemon=True)
    ticker.start()
    process.switch("hung")
    try:
        wait_for(lambda: "reconnecting" in unreadable(emulated))
        leaving = clock.now()  # the camera, which asks it twice
        wait_for(lambda: clock.now() > leaving + HELD_S)
    finally:
        process.switch("hung", on=False)
        done.set()
        ticker.join(DEADLINE_S)
    assert max(gaps) < HELD_S
    wait_for(lambda: newer(emulated, leaving))


@pytest.mark.wire
def test_another_device_on_the_port():
    """One that hangs up as soon as it is spoken to."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def hang_up():
            with contextlib.suppress(OSError):
                while True:
                    server.accept()[0].close()

        threading.Thread(target=hang_up, daemon=True).start()
        port = f"ptpip:127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(DeviceError, match="is it a PTP/IP camera"):
            GphotoCamera(replace(CONFIG, port=port), MonotonicClock())
        server.shutdown(socket.SHUT_RDWR)
