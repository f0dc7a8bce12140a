"""The driver of a zoom camera by gphoto2, against a camera that fails on command, and against the emulated one.

Most of it runs in simulated time without a thread. What happens on a real USB line (a claimed interface, a pulled
cable) is injected at the thin layer of calls: PTP/IP, which the wire tests use, has none of it.
"""

import contextlib
import itertools
import logging
import math
import os
import re
import socket
import subprocess
import sys
import threading
import types
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.frame_buffer import FrameBuffer
from cotarget.drivers.gphoto import GphotoLink, LinkError, Setting, cameras, full_port, probe
from cotarget.drivers.gphoto_camera import GphotoCamera, GphotoSettings, SharedState, Shooting, freshness
from cotarget.errors import ConfigError, DeviceError, MissingPackageError, StaleFrameError
from tests.support.simulated_clock import SimClock

SIZE, STILL_SIZE = (32, 24), (64, 48)
CONFIG = GphotoSettings(port="usb:", size=SIZE, still_size=STILL_SIZE, latency_s=0.1)
PERIOD = 1 / 10  # of the fake viewfinder [s]
CALL_S = 0.002  # that a call takes [s]
DEADLINE_S = 20.0  # for whatever should happen at once: only a hang takes as long
GREY = 2.0  # grey levels by which JPEG may change an even picture
HELD_S = 2.0  # a thread that waits this long stood still while libgphoto2 waited 2.5 s for an answer
BUSY, BAD, IO, TIMEOUT, CLAIM = -110, -2, -7, -10, -53  # libgphoto2's results


def jpeg(size, grey):
    return cv2.imencode(".jpg", np.full((size[1], size[0], 3), grey, np.uint8))[1].tobytes()


def zeroed(data):
    """The second quarter of a JPEG's compressed data is lost, the rest is there."""
    start = data.index(b"\xff\xda") + 14
    long = (len(data) - 2 - start) // 4
    return data[: start + long] + bytes(long) + data[start + 2 * long :]


ROOT = Path(__file__).parents[2]


class Camera:
    """A link to a camera with a lens from 0 to 134 that shows only when it shoots, as PowerShots do.

    ``fail`` holds, by call, results to fail with: one after the other, and the last one for ever if it is a list's
    Ellipsis. ``take`` is what a call takes [s], ``ignore`` lets commands to the lens have no effect.
    """

    def __init__(self, clock):
        self.clock, self.log, self.fail, self.take = clock, [], {}, {}
        self.connected, self.ignore, self.frozen, self.threads = False, 0, None, set()
        self.choices = {"iso": ("Auto", "80", "100"), "capturetarget": ("Internal RAM", "Memory card")}
        self.values = {"capture": 0.0, "zoom": 0.0, "iso": "Auto", "capturetarget": "Memory card", "owner": "nobody"}
        self.values["datetime"] = 1e9
        self.readonly, self.hidden = set(), {"zoom", "iso"}
        self.range = (0.0, 134.0, 1.0)
        self.preview_size, self.still_size = SIZE, STILL_SIZE
        self.still = None
        self.shown = []

    def _do(self, name, *what):
        self.threads.add(threading.get_ident())
        self.log.append((name, *what))
        if isinstance(self.clock, SimClock):
            self.clock.t += self.take.get(name, CALL_S)
        queue = self.fail.get(name)
        if queue:
            code = queue[0]
            if queue[1:] != [...]:
                queue.pop(0)
            if code is not None:
                raise LinkError(code, "what gphoto2 calls it")
        assert self.connected or name in ("open", "close"), f"{name} without a connection"

    def open(self):
        self._do("open")
        self.connected = True
        return "Fake S5"

    def close(self):
        self._do("close")
        self.connected = False

    def names(self):
        shooting = self.values.get("capture", 1.0)
        return [name for name in self.values if shooting or name not in self.hidden]

    def get(self, name):
        self._do("get", name)
        value, readonly = self.values[name], name in self.readonly
        if name in self.choices:
            return Setting("choice", value, choices=self.choices[name], readonly=readonly)
        if name == "zoom":
            return Setting("range", value, *self.range, readonly=readonly)
        if name == "datetime":
            return Setting("date", value + 1.0, readonly=readonly)
        return Setting("switch" if name == "capture" else "text", value, readonly=readonly)

    def put(self, name, value):
        self._do("put", name, value)
        if name == "zoom" and self.ignore:
            self.ignore -= 1
            return
        self.values[name] = float(value) if name == "datetime" else value

    def preview(self):
        self._do("preview")
        if self.frozen is not None:
            return self.frozen
        index = math.floor(self.clock.now() / PERIOD)
        self.shown.append(index)
        return jpeg(self.preview_size, 10 + index % 200)

    def shoot(self):
        self._do("shoot")
        return "/", "capt0000.jpg"

    def fetch(self, still):
        self._do("fetch", *still)
        return jpeg(self.still_size, 200) if self.still is None else self.still

    def commands(self, name):
        return [entry[2] for entry in self.log if entry[:2] == ("put", name)]


class Bench:
    """The driver's work in simulated time, and what its users would do."""

    def __init__(self, config=CONFIG, prepare=lambda camera: None):
        self.clock = SimClock()
        fresh_s = freshness(config)
        self.buffer = FrameBuffer("the camera", self.clock, config.size, config.latency_s, fresh_s)
        self.shared = SharedState(self.buffer)
        self.camera = Camera(self.clock)
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

    def why(self):
        """Why there is no newer frame."""
        with pytest.raises(StaleFrameError) as error:
            self.buffer.read(self.frames[-1].t, 0.0)
        return str(error.value)

    def send(self, position):
        self.shared.wanted, self.shared.order = position, self.shared.order + 1
        self.shared.standing, self.shared.lens_trouble = False, ""


def opening_fails(config=CONFIG, **changes):
    def prepare(camera):
        for name, value in changes.items():
            setattr(camera, name, value)

    with pytest.raises((ConfigError, DeviceError)) as error:
        Bench(config, prepare)
    assert "\n" not in str(error.value)
    return error


# --- opening
def test_opening_enters_shooting_before_it_looks_for_the_lens():
    bench = Bench()
    assert bench.camera.log[:2] == [("open",), ("put", "capture", 1)]
    assert bench.camera.values["capturetarget"] == "Internal RAM"
    assert bench.zoom.lens.focal_range == pytest.approx((6.0 / 0.01794, 72.0 / 0.01794))
    assert bench.camera.commands("zoom") == []
    assert bench.newest().image.shape == (24, 32, 3)


def test_a_camera_that_always_shoots_and_has_no_targets_is_taken_as_it_is():
    def prepare(camera):
        del camera.values["capture"], camera.values["capturetarget"]

    assert Bench(prepare=prepare).camera.commands("capture") == []


def test_settings_are_applied_and_a_target_of_the_users_own_is_left():
    config = replace(CONFIG, settings={"iso": "80", "owner": "us", "capturetarget": "Memory card"})
    camera = Bench(config).camera
    assert camera.commands("capturetarget") == ["Memory card"]
    assert (camera.values["iso"], camera.values["owner"], camera.values["capturetarget"]) == ("80", "us", "Memory card")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"isso": "80"}, "hardware.zoom.settings: the Fake S5 has no setting 'isso'; valid here: iso, capture"),
        ({"iso": "81"}, "hardware.zoom.settings.iso: '81' is not one of: 80, 100, Auto"),
        ({"zoom": "135"}, "hardware.zoom.settings.zoom: '135' is not within 0 to 134"),
        ({"zoom": "wide"}, "hardware.zoom.settings.zoom: 'wide' is not within 0 to 134"),
        ({"capture": "yes"}, "hardware.zoom.settings.capture: 'yes' is not one of: 0, 1"),
        ({"datetime": "now"}, "hardware.zoom.settings.datetime: 'now' is no time in whole seconds since 1970"),
        ({"datetime": "1.5"}, "hardware.zoom.settings.datetime: '1.5' is no time in whole seconds since 1970"),
        ({"datetime": "99999999999"}, "hardware.zoom.settings.datetime: '99999999999' is no time in whole seconds"),
    ],
)
def test_wrong_settings_are_named_with_the_valid_ones(settings, message):
    error = opening_fails(replace(CONFIG, settings=settings))
    assert error.type is ConfigError
    assert str(error.value).startswith(message)


def test_settings_that_can_only_be_read_and_those_taken_otherwise(caplog):
    error = opening_fails(replace(CONFIG, settings={"iso": "80"}), readonly={"iso"})
    assert str(error.value) == "hardware.zoom.settings.iso: this camera's can only be read; it is 'Auto'"

    def prepare(camera):
        put = camera.put
        camera.put = lambda name, value: put(name, "NOBODY" if name == "owner" else value)

    with caplog.at_level(logging.WARNING):
        Bench(replace(CONFIG, settings={"owner": "us"}), prepare)
    assert caplog.messages == ["the Fake S5 took 'us' for its setting 'owner' as 'NOBODY'"]


def test_a_clock_that_went_on_is_no_other_value(caplog):
    with caplog.at_level(logging.WARNING):
        assert Bench(replace(CONFIG, settings={"datetime": "1190000000"})).camera.values["datetime"] == 1.19e9
    assert caplog.messages == []


def test_what_nobody_thought_of_is_one_line_while_opening():
    def prepare(camera):
        def names():
            raise TypeError("a mistake")

        camera.names = names

    with pytest.raises(DeviceError) as error:
        Bench(prepare=prepare)
    assert str(error.value) == "the camera at 'usb:' cannot be used: TypeError('a mistake')"


def test_a_camera_without_zoom():
    values = {f"d{i:03}": "" for i in range(100)} | {"eoszoom": "", "capture": 0.0}
    error = opening_fails(values=values)
    assert error.type is ConfigError
    assert str(error.value).startswith(
        "hardware.zoom: the Fake S5 has no setting 'zoom'; it cannot be zoomed; its settings are: eoszoom, "
    )
    assert str(error.value).endswith(" and 90 more")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"range": (0.0, 100.0, 1.0)},
            "hardware.zoom.lens: positions 0 to 128 exceed those of the Fake S5's 'zoom', 0",
        ),
        (
            {"range": (3.0, 134.0, 1.0)},
            "hardware.zoom.lens: positions 0 to 128 exceed those of the Fake S5's 'zoom', 3",
        ),
        ({"range": (0.0, 1000.0, 500.0)}, "hardware.zoom.lens: the Fake S5 cannot be sent to positions between 0 and"),
        ({"readonly": {"zoom"}}, "hardware.zoom.zoom_key: 'zoom' of the Fake S5 can only be read; it cannot be zoomed"),
        ({"choices": {"zoom": ("wide", "tele")}}, "hardware.zoom.zoom_key: 'zoom' of the Fake S5 is neither a range"),
    ],
)
def test_lenses_that_are_not_as_configured(changes, message):
    error = opening_fails(**changes)
    assert error.type is ConfigError
    assert str(error.value).startswith(message)


def test_a_lens_by_choices_is_sent_by_their_own_text():
    def prepare(camera):
        camera.choices = {"zoom": ("000", "064", "128", "Digital")}
        camera.values["zoom"] = "000"

    bench = Bench(prepare=prepare)
    assert bench.zoom.lens.positions == (0, 64, 128)
    bench.send(bench.zoom.lens.position_for(21.3 / 0.01794))
    bench.run(0.1)
    assert bench.camera.commands("zoom") == ["064"]
    assert bench.shared.standing


def test_frames_of_another_size_say_what_to_write():
    error = opening_fails(preview_size=(40, 30))
    assert error.type is ConfigError
    assert str(error.value) == (
        "hardware.zoom.size: the viewfinder's frames are 40 x 30, not 32 x 24; "
        "write size = [40, 30], and pitch_mm for it"
    )


def test_a_viewfinder_without_a_picture():
    assert str(opening_fails(frozen=b"no jpeg").value) == "the camera at 'usb:' shows no frame of its viewfinder"


def test_a_lens_outside_the_table_is_brought_back():
    """At 134, in the digital zoom; the optical one ends at 128."""
    bench = Bench(prepare=lambda camera: camera.values.update(zoom=134.0))
    bench.run(0.5)
    assert bench.camera.commands("zoom") == [128]


def test_opening_tries_once_more_and_then_says_why():
    bench = Bench(prepare=lambda camera: camera.fail.update(open=[IO]))
    assert bench.newest().image.shape == (24, 32, 3)
    error = opening_fails(fail={"open": [CLAIM, ...]})
    assert error.type is DeviceError
    assert "gvfs-gphoto2-volume-monitor" in str(error.value)
    error = opening_fails(fail={"open": [-105, -1]})
    assert str(error.value) == "the camera at 'usb:' cannot be used: gphoto2 says [-105] what gphoto2 calls it"


@pytest.mark.parametrize("call", ["put", "get", "preview"])
@pytest.mark.parametrize("code", [BUSY, BAD])
def test_a_camera_that_is_busy_at_first_is_waited_for(call, code):
    bench = Bench(prepare=lambda camera: camera.fail.update({call: [code] * 5}))
    assert bench.newest().image.shape == (24, 32, 3)


@pytest.mark.parametrize("call", ["put", "get", "preview"])
@pytest.mark.parametrize("code", [BUSY, IO, TIMEOUT])
def test_what_fails_while_opening_leaves_no_connection(call, code):
    camera = []
    with pytest.raises(DeviceError, match=rf"the camera at 'usb:' cannot be used: gphoto2 says \[{code}\]"):
        Bench(prepare=lambda each: (camera.append(each), each.fail.update({call: [code, ...]})))
    assert not camera[0].connected


# --- frames
def test_frames_are_dated_at_their_arrival_less_the_latency():
    bench = Bench()
    bench.run(2.0)
    times = [frame.t for frame in bench.frames]
    assert len(times) == pytest.approx(2.0 / PERIOD, abs=2)
    # A picture appears at a multiple of the period, is asked for within a repeat's pause and two calls after that, and
    # has been on its way for latency_s.
    late = [(t + 0.1) % PERIOD for t in times[1:]]
    assert max(late) < 0.005 + 2 * CALL_S + 1e-6
    assert not bench.frames[-1].image.flags.writeable
    assert len({frame.image.tobytes() for frame in bench.frames}) == len(bench.frames)


def test_no_more_frames_are_fetched_than_the_rate_allows():
    bench = Bench(replace(CONFIG, rate_hz=4.0))
    bench.camera.log.clear()
    bench.run(5.0)
    assert len([entry for entry in bench.camera.log if entry == ("preview",)]) == pytest.approx(20, abs=1)


def test_a_frozen_viewfinder_gives_no_new_frames_and_is_not_hammered():
    bench = Bench()
    bench.camera.frozen = jpeg(SIZE, 77)
    bench.run(5.0)
    count = len(bench.frames)
    bench.camera.log.clear()
    bench.run(10.0)
    assert len(bench.frames) == count
    assert len(bench.camera.log) == pytest.approx(10.0 * CONFIG.rate_hz, rel=0.1)
    bench.camera.frozen = None
    bench.run(0.2)
    assert len(bench.frames) > count


@pytest.mark.parametrize(
    "data",
    [jpeg(SIZE, 50)[:-40], jpeg(SIZE, 50)[2:], b"", b"\xff\xd8 nothing \xff\xd9", zeroed(jpeg(SIZE, 50))],
    ids=["cut short", "no start", "nothing", "no picture", "zeros"],
)
def test_broken_frames_are_refused_and_counted(data):
    bench = Bench()
    bench.run(0.5)
    newest = bench.frames[-1]
    bench.camera.frozen = data
    bench.run(0.1)
    assert bench.frames[-1] is newest
    assert bench.buffer.counts.refused == 1
    assert bench.why() == "no new picture for 0.1 s: the pictures of the camera are broken, 1 so far"
    bench.camera.frozen = None
    bench.run(0.3)
    assert bench.frames[-1].t > newest.t


def test_frames_of_another_size_are_an_error_until_it_is_set_back():
    bench = Bench()
    bench.run(0.5)
    bench.camera.preview_size = (40, 30)
    bench.run(0.3)
    with pytest.raises(DeviceError, match="the camera now sends 40x30 where it sent 32x24: set its resolution"):
        bench.newest()
    bench.camera.preview_size = SIZE
    bench.run(0.3)
    assert bench.frames[-1].image.shape == (24, 32, 3)


def test_frames_that_come_late_cannot_be_dated_and_are_refused():
    bench = Bench()
    bench.run(0.5)
    newest, refused = bench.frames[-1], bench.buffer.counts.refused
    bench.camera.take["preview"] = 1.0
    bench.run(1.5)
    assert bench.frames[-1] is newest
    assert bench.buffer.counts.refused > refused
    assert "its frames take 1 s to come" in bench.why()
    bench.camera.frozen = jpeg(SIZE, 33)
    bench.run(1.5)
    bench.camera.take.pop("preview")
    bench.run(0.5)
    assert bench.frames[-1] is newest  # the late one, shown again in time, is no newer for that
    bench.camera.frozen = None
    bench.run(0.3)
    assert bench.frames[-1].t > newest.t


def test_a_slow_camera_may_be_slow():
    bench = Bench(replace(CONFIG, rate_hz=1.0))
    bench.camera.take["preview"] = 1.0
    count = len(bench.frames)
    bench.run(5.0)
    assert len(bench.frames) >= count + 3


def test_zeros_after_a_jpeg_are_padding():
    bench = Bench()
    bench.camera.frozen = jpeg(SIZE, 50) + bytes(30)
    bench.run(0.2)
    assert bench.buffer.counts.refused == 0
    assert np.abs(bench.newest().image - 50.0).max() <= GREY


def test_a_viewfinder_whose_frames_all_have_bytes_too_many_is_taken_as_it_is():
    def prepare(camera):
        exact = camera.preview
        camera.preview = lambda: exact()[:-2] + bytes(651) + b"\xff\xd9"

    bench = Bench(prepare=prepare)
    bench.run(0.5)
    assert len(bench.frames) > 1
    assert bench.buffer.counts.refused == 0


def test_images_are_not_turned_as_the_camera_felt_itself_held():
    """Exif with one entry: orientation 6, to be shown turned by a quarter."""
    tiff = bytes.fromhex("4d4d002a 00000008 0001 0112 0003 00000001 0006 0000 00000000")
    app1 = b"\xff\xe1" + (2 + 6 + len(tiff)).to_bytes(2, "big") + b"Exif\0\0" + tiff
    plain = jpeg(SIZE, 50)
    turned = plain[:2] + app1 + plain[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (32, 24, 3)  # it is believed
    bench = Bench()
    bench.camera.frozen = turned
    bench.run(0.2)
    assert bench.newest().image.shape == (24, 32, 3)
    assert np.abs(bench.newest().image - 50.0).max() <= GREY


# --- the lens
def test_the_lens_is_sent_at_once_read_back_and_moves_as_estimated():
    """From 0 to 60 at 60 a second after 50 ms."""
    bench = Bench()
    bench.run(0.5)
    bench.send(60)
    start = bench.clock.t
    bench.run(0.01)
    assert bench.camera.commands("zoom") == [60.0]
    assert bench.shared.standing
    assert bench.shared.motion.arrives == pytest.approx(start + 0.05 + 1.0)
    assert bench.shared.motion.position(start + 0.55) == pytest.approx(30.0)


def test_the_latest_command_wins():
    bench = Bench()
    for position in (10, 20, 30):
        bench.send(position)
    bench.run(0.5)
    assert bench.camera.commands("zoom") == [30.0]


@pytest.mark.parametrize("code", [BUSY, BAD])
def test_a_busy_camera_gets_its_command_again_while_frames_go_on(code):
    bench = Bench()
    bench.camera.fail["put"] = [code] * 10
    bench.send(30)
    bench.run(0.5)
    assert not bench.shared.standing
    assert len(bench.frames) >= 3
    bench.run(1.5)
    assert bench.shared.standing
    assert bench.camera.values["zoom"] == 30.0


def test_a_command_that_is_refused_for_long_is_given_up_until_the_next():
    bench = Bench()
    bench.camera.fail["put"] = [BAD, ...]
    bench.send(30)
    bench.run(5.0)
    assert bench.shared.lens_trouble == (
        "the zoom camera's lens did not go to position 30: gphoto2 says [-2] what gphoto2 calls it"
    )
    frames = len(bench.frames)
    bench.camera.fail.clear()
    bench.send(31)
    bench.run(0.5)
    assert (bench.shared.standing, bench.camera.values["zoom"]) == (True, 31.0)
    assert len(bench.frames) > frames


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


def test_a_lens_that_ignores_a_command_is_sent_again():
    bench = Bench()
    bench.camera.ignore = 1
    bench.send(12)
    bench.run(1.0)
    assert not bench.shared.standing
    bench.run(1.0)
    assert bench.shared.standing
    assert bench.camera.commands("zoom") == [12.0, 12.0]


def test_a_lens_that_never_goes_is_told():
    bench = Bench()
    bench.camera.ignore = 99
    bench.send(12)
    bench.run(5.0)
    assert bench.shared.lens_trouble == "the zoom camera's lens did not go to position 12: its setting 'zoom' reads 0"
    assert len(bench.camera.commands("zoom")) == 2


def test_a_setting_that_follows_the_lens_is_waited_for():
    """Some cameras show where the lens is, not where it was sent."""
    bench = Bench()
    get = bench.camera.get

    def following(name):
        setting = get(name)
        return replace(setting, value=float(round(bench.shared.motion.position(bench.clock.t))))

    bench.camera.get = following
    bench.send(60)
    bench.run(0.9)
    assert not bench.shared.standing
    bench.run(0.5)
    assert bench.shared.standing
    assert bench.camera.commands("zoom") == [60.0]


# --- lost and found
@pytest.mark.parametrize("call", ["preview", "get", "put"])
@pytest.mark.parametrize("code", [IO, TIMEOUT, -52])
def test_a_camera_that_is_lost_is_found_again_and_its_lens_sent_back(call, code):
    bench = Bench()
    bench.send(40)
    bench.run(1.0)
    bench.camera.fail[call] = [code]
    bench.send(50)
    bench.run(0.05)
    bench.camera.values.update(capture=0.0, zoom=0.0)  # it was switched off, too
    bench.run(2.0)
    assert bench.camera.values["capture"] == 1
    assert bench.camera.values["zoom"] == 50.0
    assert bench.shared.standing
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


def test_a_camera_that_stays_away_is_gone_within_seconds():
    bench = Bench()
    bench.camera.fail = {"preview": [IO], "open": [IO, ...]}
    bench.camera.take = {"open": 2.5}
    bench.run(0.5)
    assert re.search(r"no new picture for .* s: gphoto2 says \[-7\] .*; reconnecting", bench.why())
    bench.run(10.0)
    assert bench.buffer.gone.startswith("the zoom camera at 'usb:' is gone: gphoto2 says [-7] what gphoto2 calls it")
    assert "\n" not in bench.buffer.gone
    assert bench.work.work() == math.inf


def test_a_camera_that_comes_back_as_another_is_gone():
    bench = Bench()
    bench.camera.fail["preview"] = [IO]
    bench.camera.preview_size = (40, 30)
    bench.run(2.0)
    assert "hardware.zoom.size" in bench.buffer.gone


def test_a_viewfinder_that_is_busy_for_long_is_opened_again():
    bench = Bench()
    bench.camera.fail["preview"] = [BUSY] * 40
    bench.run(10.0)
    assert bench.camera.log.count(("open",)) == 2
    assert bench.buffer.waited_s < 2 * PERIOD


def test_closing_ends_shooting_unless_the_camera_is_lost():
    bench = Bench()
    bench.work.close()
    assert bench.camera.commands("capture") == [1, 0]
    assert not bench.camera.connected
    bench = Bench()
    bench.camera.fail["put"] = [IO]
    bench.work.close()
    assert not bench.camera.connected


# --- what users see: on the camera's own thread
class Rig:
    """The driver in real time, on a camera that answers at once."""

    def __init__(self, config=CONFIG, prepare=lambda camera: None):
        self.link = Camera(MonotonicClock())
        prepare(self.link)
        self.camera = GphotoCamera(config, self.link.clock, self.link)


@contextlib.contextmanager
def opened(config=CONFIG, prepare=lambda camera: None):
    rig = Rig(config, prepare)
    try:
        yield rig
    finally:
        rig.camera.close()
        assert "zoom camera" not in [thread.name for thread in threading.enumerate()]
        assert not rig.link.connected


def wait_for(condition):
    """Wait for what happens at once, without a notice."""
    clock = MonotonicClock()
    deadline = clock.now() + DEADLINE_S
    while not condition():
        assert clock.now() < deadline
        clock.sleep_until(clock.now() + 0.002)


def unreadable(camera, newer_than=math.inf):
    """Why there is no such frame; empty while there is one."""
    try:
        camera.read(newer_than, 0.0)
    except DeviceError as error:
        return str(error)
    return ""


def test_a_camera_in_use():
    with opened() as rig:
        camera, clock = rig.camera, rig.link.clock
        assert (camera.size, camera.still_size) == (SIZE, STILL_SIZE)
        assert camera.focal_range == pytest.approx((6.0 / 0.01794, 72.0 / 0.01794))
        first = camera.read(timeout=DEADLINE_S)
        second = camera.read(first.t, DEADLINE_S)
        assert second.t > first.t
        assert camera.zoom(21.0 / 0.01794) == pytest.approx(camera.zoom(21.3 / 0.01794), rel=0.05)
        assert camera.state().moving
        assert camera.zoom(6.0 / 0.01794) == pytest.approx(6.0 / 0.01794)
        wait_for(lambda: not camera.state().moving)
        assert camera.state().focal_px == pytest.approx(6.0 / 0.01794)
        before = clock.now()
        still = camera.capture()
        assert still.image.shape == (48, 64, 3)
        assert before <= still.t <= clock.now()
        assert np.abs(still.image - 200.0).max() <= GREY
        assert len(rig.link.threads) == 1
        assert threading.get_ident() not in rig.link.threads
    assert rig.link.commands("capture") == [1, 0]


def test_a_lens_moves_until_it_should_have_arrived():
    with opened(replace(CONFIG, lens_speed=0.001)) as rig:
        goal = rig.camera.zoom(1000.0)
        wait_for(lambda: rig.camera._shared.standing)
        state = rig.camera.state()
        assert state.moving
        assert state.focal_px == pytest.approx(6.0 / 0.01794, rel=1e-3)
        assert goal == pytest.approx(1000.0, rel=0.05)


def test_commands_do_not_wait_for_the_next_frame():
    """It would come in 100 s."""
    with opened(replace(CONFIG, rate_hz=0.01)) as rig:
        rig.camera.zoom(1000.0)
        wait_for(lambda: rig.camera._shared.standing)
        assert rig.camera.capture().image.shape == (48, 64, 3)


def test_reading_says_why_no_frame_comes():
    with opened() as rig:
        newest = rig.camera.read(timeout=DEADLINE_S)
        with pytest.raises(
            StaleFrameError, match=r"the zoom camera at .usb:. (sent no newer|repeats the same) picture"
        ):
            rig.camera.read(newest.t + 1000.0, 0.0)
        rig.link.fail["preview"] = [BUSY, ...]
        wait_for(lambda: re.search(r"no new picture for .* s: .*gphoto2 says \[-110\]", unreadable(rig.camera)))


def test_an_old_frame_is_not_the_newest():
    """While the viewfinder is blind the last frame grows old; half a second later it is none."""
    with opened() as rig:
        rig.camera.read(timeout=DEADLINE_S)
        rig.link.fail["preview"] = [BUSY, ...]
        clock = rig.link.clock
        wait_for(lambda: "no new picture for" in unreadable(rig.camera, None))
        rig.link.fail.clear()
        assert rig.camera.read(timeout=DEADLINE_S).t > clock.now() - DEADLINE_S


@pytest.mark.parametrize("focal_px", [0.0, -1.0, math.nan, math.inf])
def test_what_is_no_focal_length(focal_px):
    with opened() as rig, pytest.raises(DeviceError, match="the lens cannot go to a focal length of"):
        rig.camera.zoom(focal_px)


def test_a_lens_in_trouble_is_told_until_it_is_sent_again(monkeypatch):
    monkeypatch.setattr("cotarget.drivers.gphoto_camera.VERIFY_S", 0.0)
    with opened(replace(CONFIG, lens_speed=1e4)) as rig:
        rig.link.ignore = 2
        rig.camera.zoom(1000.0)

        def troubled():
            try:
                rig.camera.state()
            except DeviceError as error:
                return "did not go to position" in str(error)
            return False

        wait_for(troubled)
        rig.camera.read(timeout=DEADLINE_S)
        rig.camera.zoom(1000.0)
        wait_for(lambda: not rig.camera.state().moving)
        assert len(rig.link.commands("zoom")) == 3


def test_stills_of_another_size_say_what_to_write():
    with opened(prepare=lambda camera: setattr(camera, "still_size", (80, 60))) as rig:
        with pytest.raises(ConfigError) as error:
            rig.camera.capture()
        assert str(error.value) == (
            "hardware.zoom.still_size: stills are 80 x 60, not 64 x 48; write still_size = [80, 60]"
        )
        rig.camera.read(timeout=DEADLINE_S)


def test_stills_that_cannot_be_read_or_taken():
    with opened() as rig:
        rig.link.still = b"raw"
        with pytest.raises(DeviceError, match=r"still 'capt0000\.jpg' is damaged, or no JPEG; set it to take JPEG"):
            rig.camera.capture()
        rig.link.still = None
        rig.link.fail["shoot"] = [BUSY, BAD, None]
        assert rig.camera.capture().image.shape == (48, 64, 3)
        rig.link.fail["shoot"] = [IO]
        with pytest.raises(DeviceError, match=r"the zoom camera was lost while it took a still: gphoto2 says \[-7\]"):
            rig.camera.capture()
        assert rig.camera.capture().image.shape == (48, 64, 3)  # it was found again


def test_a_still_waits_its_turn_and_its_limit(monkeypatch):
    monkeypatch.setattr("cotarget.drivers.gphoto_camera.STILL_LIMIT_S", 0.01)
    with opened() as rig:
        rig.link.fail["shoot"] = [BUSY, ...]
        with pytest.raises(DeviceError, match=r"the zoom camera took no still within 0\.01 s"):
            rig.camera.capture()
        rig.link.fail.clear()
        monkeypatch.setattr("cotarget.drivers.gphoto_camera.STILL_LIMIT_S", DEADLINE_S)
        assert rig.camera.capture().image.shape == (48, 64, 3)


def test_a_still_that_is_always_refused(monkeypatch):
    monkeypatch.setattr("cotarget.drivers.gphoto_camera.BUSY_PATIENCE_S", 0.0)
    with opened() as rig:
        rig.link.fail["shoot"] = [-1, ...]
        with pytest.raises(DeviceError, match=r"the zoom camera takes no still: gphoto2 says \[-1\]"):
            rig.camera.capture()


def test_reading_waits_while_a_still_is_taken():
    release = threading.Event()

    def prepare(camera):
        shoot = camera.shoot

        def slow():
            shooting.set()
            assert release.wait(DEADLINE_S)
            return shoot()

        camera.shoot = slow

    shooting = threading.Event()
    with opened(prepare=prepare) as rig:
        stills = []
        taker = threading.Thread(target=lambda: stills.append(rig.camera.capture()), daemon=True)
        taker.start()
        assert shooting.wait(DEADLINE_S)
        now = rig.link.clock.now()
        with pytest.raises(StaleFrameError):
            rig.camera.read(now, 0.02)
        assert rig.camera.zoom(1000.0) > 0  # returns at once all the same
        release.set()
        assert rig.camera.read(now - CONFIG.latency_s, DEADLINE_S).t > now - CONFIG.latency_s
        taker.join(DEADLINE_S)
        assert len(stills) == 1


def test_a_gone_camera_says_so_at_every_call(monkeypatch):
    monkeypatch.setattr("cotarget.drivers.gphoto_camera.RECONNECT_S", 0.0)
    with opened() as rig:
        rig.link.fail = {"open": [IO, ...], "preview": [IO, ...]}
        wait_for(lambda: "is gone" in unreadable(rig.camera))
        calls = (rig.camera.read, rig.camera.state, rig.camera.capture, lambda: rig.camera.zoom(1000.0))
        for call in calls:
            with pytest.raises(DeviceError, match="the zoom camera at 'usb:' is gone: gphoto2 says"):
                call()


def test_waiting_ends_when_the_camera_is_gone_or_closed(monkeypatch):
    monkeypatch.setattr("cotarget.drivers.gphoto_camera.RECONNECT_S", 0.0)
    with opened() as rig:
        rig.link.fail = {"open": [IO, ...], "shoot": [BUSY, ...], "preview": [BUSY, BUSY, IO]}
        with pytest.raises(DeviceError, match="is gone"):
            rig.camera.capture()
    with opened() as rig:
        errors = []

        def read():
            try:
                rig.camera.read(math.inf, DEADLINE_S)
            except DeviceError as error:
                errors.append(str(error))

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        rig.camera.close()
        rig.camera.close()
        reader.join(DEADLINE_S)
        assert errors == ["the zoom camera at 'usb:' is closed"]


def test_opening_fails_on_the_callers_thread():
    before = threading.active_count()
    with pytest.raises(ConfigError, match=r"hardware\.zoom\.size"):
        Rig(prepare=lambda camera: setattr(camera, "preview_size", (40, 30)))
    with pytest.raises(DeviceError, match=r"cannot be used: gphoto2 says \[-53\]"):
        Rig(prepare=lambda camera: camera.fail.update(open=[CLAIM, ...]))
    assert threading.active_count() == before


def test_a_mistake_in_the_driver_is_no_silence_and_no_traceback(caplog):
    caplog.set_level(logging.INFO)

    def wrong():
        raise RuntimeError("a mistake")

    with opened() as rig:
        rig.link.preview = wrong
        wait_for(lambda: "the driver of the zoom camera at 'usb:' failed" in unreadable(rig.camera))
        with pytest.raises(
            DeviceError, match=r"the driver of the zoom camera at 'usb:' failed: RuntimeError\('a mistake'\)"
        ):
            rig.camera.read()
    assert "Traceback" not in caplog.text


# --- gphoto2 itself
@pytest.mark.parametrize(
    ("port", "full"),
    [
        ("usb:", "usb:"),
        ("usb:001,005", "usb:001,005"),
        ("ptpip:127.0.0.1", "ptpip:127.0.0.1:15740:15740"),
        ("ptpip:127.0.0.1:4000", "ptpip:127.0.0.1:4000:4000"),
        ("ptpip:127.0.0.1:4000:4001", "ptpip:127.0.0.1:4000:4001"),
        ("ptpip:localhost:4000:4000", "ptpip:127.0.0.1:4000:4000"),
    ],
)
def test_ports_are_told_in_full(port, full):
    assert full_port(port) == full


@pytest.mark.parametrize("port", ["", "usb", "usb:5", "/dev/video0", "ptpip:", "ptpip:a:b", "serial:/dev/ttyS0"])
def test_other_ports_are_refused(port):
    with pytest.raises(ConfigError, match=r"is not like usb:, usb:001,005 or ptpip:host:port:port"):
        GphotoCamera(replace(CONFIG, port=port), MonotonicClock())


def test_ports_that_cannot_be():
    with pytest.raises(ConfigError, match="above 65535"):
        full_port("ptpip:127.0.0.1:70000")
    for host in ("no.host.invalid", 70 * "a"):
        with pytest.raises(ConfigError, match=f"hardware.zoom.port: there is no host '{host}'"):
            full_port(f"ptpip:{host}:4000")


def test_without_gphoto2_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    for call in (cameras, lambda: probe("usb:", ""), GphotoLink("usb:", "").open):
        with pytest.raises(MissingPackageError, match=r"gphoto2 is not installed; pip install 'cotarget\[hardware\]'"):
            call()


class FakeGphoto(types.ModuleType):
    """As much of the module as looks for cameras."""

    GPhoto2Error = type("GPhoto2Error", (Exception,), {"code": CLAIM, "string": "Could not claim the USB device"})

    def __init__(self, found, models=("Canon S5", "Nikon Z")):
        super().__init__("gphoto2")
        self.found, self.models, self.opened = found, models, []
        entries = types.SimpleNamespace(
            load=lambda: None,
            count=lambda: len(models),
            get_abilities=lambda i: types.SimpleNamespace(model=models[i]),
            lookup_model=models.index,
            detect=lambda ports: dict(found),
            get_info=lambda path: path,
            lookup_path=lambda path: path,
        )
        self.PortInfoList = self.CameraAbilitiesList = lambda: entries
        self.Camera = lambda: types.SimpleNamespace(
            set_abilities=lambda abilities: self.opened.append(abilities.model),
            set_port_info=self.opened.append,
            init=self.init,
        )
        self.Camera.autodetect = lambda: dict(found)

    def init(self):
        pass

    def refuse(self):
        raise self.GPhoto2Error


@pytest.fixture
def gphoto2(monkeypatch):
    """Puts a module in the place of gphoto2."""
    monkeypatch.setattr("cotarget.drivers.gphoto.keep_settings_in_memory", lambda: None)

    def put(*found):
        module = FakeGphoto(found)
        monkeypatch.setitem(sys.modules, "gphoto2", module)
        return module

    return put


TWO = (("Canon S5", "usb:001,005"), ("Nikon Z", "usb:002,003"))


def test_the_only_camera_is_found(gphoto2):
    module = gphoto2(("Canon S5", "usb:001,005"), ("Mass Storage Camera", "disk:/media/card"))
    assert GphotoLink("usb:", "").open() == "Canon S5"
    assert module.opened == ["Canon S5", "usb:001,005"]
    assert cameras() == ["Canon S5 at usb:001,005", "Mass Storage Camera at disk:/media/card"]


def test_one_of_two_cameras_is_chosen_by_its_port(gphoto2):
    module = gphoto2(*TWO)
    assert GphotoLink("usb:002,003", "").open() == "Nikon Z"
    assert module.opened == ["Nikon Z", "usb:002,003"]
    assert GphotoLink("usb:002,003", "Canon S5").open() == "Canon S5"


@pytest.mark.parametrize(
    ("port", "model", "found", "message"),
    [
        ("usb:", "", (), "hardware.zoom.port: no camera at 'usb:'; connect it and switch it on"),
        (
            "usb:",
            "",
            TWO,
            "hardware.zoom.port: 'usb:' is more than one camera; write one of: usb:001,005 (Canon S5), "
            "usb:002,003 (Nikon Z)",
        ),
        (
            "usb:001,006",
            "",
            TWO[:1],
            "hardware.zoom.port: no camera at 'usb:001,006'; connect it and switch it on, or write one of: "
            "usb:001,005 (Canon S5)",
        ),
        ("usb:", "canon", TWO, "hardware.zoom.model: gphoto2 knows no 'canon'; it knows Canon S5, Nikon Z"),
    ],
)
def test_cameras_that_are_not_found(gphoto2, port, model, found, message):
    gphoto2(*found)
    for call in (GphotoLink(port, model).open, lambda: probe(port, model)):
        with pytest.raises((ConfigError, DeviceError)) as error:
            call()
        assert str(error.value) == message


def test_a_camera_of_another_user_and_one_of_another_program(gphoto2, monkeypatch):
    module = gphoto2(TWO[0])
    module.init = module.refuse
    with pytest.raises(
        LinkError, match=r"\[-53\] Could not claim the USB device; another program holds it: unmount it"
    ):
        GphotoLink("usb:", "").open()
    monkeypatch.setattr(Path, "is_char_device", lambda path: path == Path("/dev/bus/usb/001/005"))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    for call in (GphotoLink("usb:", "").open, lambda: probe("usb:", "")):
        with pytest.raises(DeviceError, match=r"no permission to use /dev/bus/usb/001/005; add yourself to its group"):
            call()


# libgphoto2 has a camera of its own on a USB port of its own, if that is asked for before it is loaded.
VIRTUAL = """
from cotarget.errors import ConfigError
from cotarget.drivers.gphoto_camera import GphotoCamera
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.gphoto import cameras, probe
from cotarget.drivers.gphoto_camera import GphotoSettings


print(cameras())
print(probe("usb:", ""))
try:
    GphotoCamera(GphotoSettings(port="usb:"), MonotonicClock())
except ConfigError as error:
    print(error)
"""


def home_in(folder):
    """A user's home in which libgphoto2 finds the folder that it would write its own settings to."""
    (folder / "home" / ".config").mkdir(parents=True)
    return folder / "home"


def left_in(home):
    return [path for path in home.rglob("*") if path.name != ".config"]


def python(script, **environment):
    pytest.importorskip("gphoto2")
    command = [sys.executable, "-c", script]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(ROOT), **environment}, **pipes)


def test_libgphoto2s_own_virtual_camera_cannot_be_zoomed(tmp_path):
    """A DSLR whose lens is turned by hand, found on USB by libgphoto2 itself; nothing is left in the user's home."""
    home, card = home_in(tmp_path), tmp_path / "card"
    card.mkdir()
    with python(VIRTUAL, HOME=str(home), XDG_CONFIG_HOME="", VCAMERADIR=str(card)) as process:
        found, probed, error = process.communicate(timeout=DEADLINE_S)[0].splitlines()
    assert (found, probed) == ("['Nikon DSC D750 at usb:001,001']", "Nikon DSC D750 at usb:001,001")
    assert error.startswith(
        "hardware.zoom: the Nikon DSC D750 has no setting 'zoom'; it cannot be zoomed; its settings"
    )
    assert left_in(home) == []


# --- on the wire: libgphoto2's Canon code against the emulated S5 IS, in a process of its own
EMULATOR = """
import json, sys, threading, time
import numpy as np
from cotarget.emulators.faults import Faults
from cotarget.emulators.plant import Feed, Picture
from cotarget.emulators.canon_s5is import S5IS_FAULTS, S5isServer

class Lens:
    last, at = 128, 0
    def command(self, position):
        self.at = position
    def position(self):
        return self.at
    def moving(self):
        return False

def show(feed, done):
    index = 0
    while not done.wait(0.05):
        index += 1
        feed.publish(Picture(np.full((480, 640, 3), 20 + index % 200, np.uint8), index, time.monotonic()))

feed, lens, faults, done = Feed(), Lens(), Faults(S5IS_FAULTS), threading.Event()
still = np.full((2448, 3264, 3), 90, np.uint8)
threading.Thread(target=show, args=(feed, done), daemon=True).start()
with S5isServer(feed, lambda: still, lens, faults=faults) as server:
    print(server.port, flush=True)
    for line in sys.stdin:
        name, on = line.split()
        faults.set(name, on == "on")
        print(lens.at, flush=True)
done.set()
"""


class Emulated:
    """The emulator's process."""

    def __init__(self, process):
        self.process = process
        self.port = int(self._said())

    def fault(self, name, on="on"):
        """Switch a fault on or off; where the lens is."""
        print(name, on, file=self.process.stdin, flush=True)
        return int(self._said())

    def _said(self):
        """Its next line; it is killed if none comes, and its lines end."""
        late = threading.Timer(DEADLINE_S, self.process.kill)
        late.start()
        try:
            return self.process.stdout.readline()
        finally:
            late.cancel()
            late.join()


@pytest.fixture(scope="module")
def process():
    with python(EMULATOR) as process:
        try:
            yield Emulated(process)
            process.stdin.close()
            process.wait(DEADLINE_S)
        finally:
            process.kill()


@pytest.fixture
def emulated(process, tmp_path, monkeypatch):
    """The driver on the emulated camera; nothing is left in the user's home."""
    home = home_in(tmp_path)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    camera = GphotoCamera(GphotoSettings(port=f"ptpip:localhost:{process.port}"), MonotonicClock())
    process.camera = camera
    yield process
    camera.close()
    assert left_in(home) == []


def frame_after(camera, t):
    """A frame newer than a time, however often the camera must be found again until then."""
    clock = MonotonicClock()
    deadline = clock.now() + DEADLINE_S
    while clock.now() < deadline:
        with contextlib.suppress(StaleFrameError):
            return camera.read(t, 1.0)
    raise AssertionError("no frame")


@pytest.mark.wire
def test_an_emulated_camera_in_use(emulated):
    camera, clock = emulated.camera, MonotonicClock()
    frames = [camera.read(timeout=DEADLINE_S)]
    for _ in range(10):
        frames.append(camera.read(frames[-1].t, DEADLINE_S))
    greys = [round(float(frame.image.mean())) for frame in frames]
    assert frames[0].image.shape == (240, 320, 3)
    assert all(abs(b - a) >= 1 for a, b in itertools.pairwise(greys)), "a picture was given twice"
    assert all(b.t > a.t for a, b in itertools.pairwise(frames))
    camera.zoom(41.6 / 0.01794)  # position 86
    wait_for(lambda: not camera.state().moving)
    assert emulated.fault("busy", "off") == 86
    before = clock.now()
    still = camera.capture()
    assert still.image.shape == (2448, 3264, 3)
    assert before < still.t < clock.now()
    assert np.abs(still.image[::100, ::100] - 90.0).max() <= GREY
    assert frame_after(camera, still.t).t > still.t


@pytest.mark.wire
def test_an_emulated_camera_that_was_switched_off_gets_its_lens_back(emulated):
    camera = emulated.camera
    camera.zoom(21.3 / 0.01794)  # position 64
    wait_for(lambda: not camera.state().moving)
    assert emulated.fault("power-off") == 64
    wait_for(lambda: "reconnecting" in unreadable(camera))
    emulated.fault("power-off", "off")
    frame_after(camera, MonotonicClock().now())
    wait_for(lambda: not camera.state().moving)
    assert emulated.fault("busy", "off") == 64


@pytest.mark.wire
def test_an_emulated_camera_that_is_busy(emulated):
    camera = emulated.camera
    emulated.fault("busy")
    camera.zoom(61.4 / 0.01794)  # position 105
    with pytest.raises(StaleFrameError):
        camera.read(MonotonicClock().now(), 0.3)
    emulated.fault("busy", "off")
    wait_for(lambda: not camera.state().moving)
    assert emulated.fault("busy", "off") == 105


@pytest.mark.wire
def test_a_hung_camera_stops_no_other_thread_and_is_found_again(emulated):
    """libgphoto2 waits 2.5 s for each answer; that must not be spent with Python's interpreter lock held."""
    camera, clock, gaps, done = emulated.camera, MonotonicClock(), [0.0], threading.Event()

    def tick():
        last = clock.now()
        while not done.wait(0.01):
            gaps.append(clock.now() - last)
            last = clock.now()

    ticker = threading.Thread(target=tick, daemon=True)
    ticker.start()
    emulated.fault("hung")
    try:
        wait_for(lambda: "reconnecting" in unreadable(camera))
        leaving = clock.now()  # the camera, which asks it twice
        wait_for(lambda: clock.now() > leaving + HELD_S)
        with pytest.raises(StaleFrameError, match=r"no new picture for .* s: gphoto2 says \[-"):
            camera.read(leaving, 0.0)
    finally:
        emulated.fault("hung", "off")
        done.set()
        ticker.join(DEADLINE_S)
    assert max(gaps) < HELD_S
    assert frame_after(camera, leaving).t > leaving


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
        with pytest.raises(DeviceError, match=r"cannot be used: gphoto2 says \[-\d+\] .*; is it a PTP/IP camera, "):
            GphotoCamera(replace(CONFIG, port=port), MonotonicClock())
        server.shutdown(socket.SHUT_RDWR)


@pytest.mark.wire
def test_where_somebody_listens(process):
    port = f"ptpip:localhost:{process.port}"
    assert probe(port, "") == f"something listens at ptpip:127.0.0.1:{process.port}:{process.port}"
    with pytest.raises(ConfigError, match=r"hardware\.zoom\.model: gphoto2 knows no 'S5'; it knows "):
        probe(port, "S5")


@pytest.mark.wire
def test_where_nobody_listens():
    with pytest.raises(DeviceError, match=r"hardware\.zoom\.port: no camera listens at 'ptpip:127\.0\.0\.1:1:1'"):
        probe("ptpip:127.0.0.1:1", "")
    with pytest.raises(DeviceError, match=r"hardware\.zoom\.port: no camera listens at 'ptpip:127\.0\.0\.1:1:1'"):
        GphotoCamera(replace(CONFIG, port="ptpip:127.0.0.1:1"), MonotonicClock())
