"""A browser that steers a run in real time: from its message to the command on the wire."""

import math
import statistics
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

from cotarget.calibration import Calibration
from cotarget.config import FollowConfig
from cotarget.operate.session import Session
from cotarget.page.server import LOOPBACK, Page, listen
from cotarget.pipeline import Run
from cotarget.safety.safe_rig import guard
from tests.support.page_client import browser, picture, say, status, until
from tests.support.recorded_run import CONFIG, RATE_HZ, SETTINGS, Bright, ToyDevices, ToyHead, calibration_file
from tests.support.rigs import rig_of

pytestmark = pytest.mark.wire
TRIES = 12
# Medians on an idle machine are a few ms for a stop and half a frame for a click; a busy one waits for its cores.
STOP_S, CLICK_S = 0.06, 1 / RATE_HZ + 0.06


class WallDevices(ToyDevices):
    """Toy devices in real time, whose head notes its calls."""

    def __init__(self):
        self._start = time.monotonic()
        super().__init__(real_time=True)
        self.head = NotingHead(self)

    @property
    def t(self):
        return 1000.0 + time.monotonic() - self._start

    @t.setter
    def t(self, value):
        if (wait := value - self.t) > 0:
            time.sleep(wait)


class NotingHead(ToyHead):
    def __init__(self, rig):
        super().__init__(rig)
        self.noted = []  # (call, time)

    def move(self, pan, tilt, speed=None, wait=False):
        self.noted.append(("move", time.monotonic()))
        return super().move(pan, tilt, speed, wait)

    def halt(self):
        self.noted.append(("halt", time.monotonic()))
        super().halt()

    def after(self, call, t):
        """The time of the first such call after a time; None if there is none yet."""
        return next((each for what, each in list(self.noted) if what == call and each >= t), None)


@pytest.fixture
def steered(tmp_path):
    """Run a session in this thread, which the rig needs, and the given browser in another."""

    def run_with(act):
        path, devices, stop_file = calibration_file(tmp_path), WallDevices(), tmp_path / "rig.stop"
        failed, done = [], threading.Event()
        safety = replace(CONFIG.safety, stop_file=stop_file)
        with guard(rig_of(devices), safety) as rig, listen(LOOPBACK, 0) as listener:
            run = Run(rig, Calibration.load(path), CONFIG.target("bird"), Bright(), settings=SETTINGS)
            session = Session(rig, run, stop_file, FollowConfig(), time.monotonic)
            with Page(session, listener) as page:
                at = SimpleNamespace(page=page, port=listener.getsockname()[1], devices=devices, session=session)

                def steer():
                    try:
                        act(at)
                    except BaseException as error:
                        failed.append(error)
                    done.set()

                thread = threading.Thread(target=steer)
                thread.start()
                steps = []
                for step in session.steps(math.inf):
                    page.show(step, rig.spec)
                    steps.append(step)
                    if done.is_set():
                        break
                thread.join()
        if failed:
            raise failed[0]
        return steps

    return run_with


def in_control(mine):
    say(mine, do="take")
    status(mine, lambda message: message["control"] == "you")


def test_a_stop_halts_the_head_at_once_and_a_click_with_the_next_frame(steered):
    stops, clicks = [], []

    def act(at):
        head = at.devices.head
        with browser(at) as mine:
            in_control(mine)
            until(lambda: len(head.noted) >= 1)
            time.sleep(0.5)  # the detector has seen the target
            for _ in range(TRIES):
                begun = time.monotonic()
                say(mine, do="follow", of="head")
                until(lambda t=begun: head.after("move", t))
                clicks.append(head.after("move", begun) - begun)
                begun = time.monotonic()
                say(mine, do="stop")
                until(lambda t=begun: head.after("halt", t))
                stops.append(head.after("halt", begun) - begun)
                status(mine, lambda message: message["stopped"] is not None)
                say(mine, do="clear")
                status(mine, lambda message: message["stopped"] is None)

    steered(act)
    print(f"stop to halt: {[round(1000 * each) for each in stops]} ms; click to command: ", end="")
    print(f"{[round(1000 * each) for each in clicks]} ms")
    assert statistics.median(stops) < STOP_S
    assert statistics.median(clicks) < CLICK_S


def test_a_lost_page_ends_moving_by_hand(steered):
    pans = []

    def act(at):
        with browser(at) as mine:
            in_control(mine)
            for _ in range(6):
                tick = status(mine)["tick"]
                say(mine, do="manual", of="head", rates=[0.2, 0.0], tick=tick)
            until(lambda: at.devices.pose()[0] > 0)
        time.sleep(0.5)
        pans.append(float(at.devices.pose()[0]))
        time.sleep(0.3)
        pans.append(float(at.devices.pose()[0]))

    steps = steered(act)
    assert pans[0] == pans[1] > 0
    assert steps[-1].state == "standing"


def test_ten_browsers_and_garbage_do_not_slow_the_run(steered):
    counts = {}

    def act(at):
        def frames(seconds=2.0):
            first = at.session._run._index
            time.sleep(seconds)
            return at.session._run._index - first

        counts["alone"] = frames()
        leave = threading.Event()

        def watch(number):
            with browser(at, who=str(number)) as mine:
                while not leave.is_set():
                    found = picture(mine, 0.5)
                    if found and number:  # the first never draws
                        say(mine, do="drawn", n=found[0]["n"])

        def knock():
            while not leave.is_set():
                with browser(at, token="wrong") as other:
                    time.sleep(0.05)
                    other.close()

        threads = [threading.Thread(target=watch, args=(i,)) for i in range(10)] + [threading.Thread(target=knock)]
        for each in threads:
            each.start()
        counts["with ten"] = frames()
        leave.set()
        for each in threads:
            each.join()

    steered(act)
    print(counts)
    assert counts["with ten"] > 0.75 * counts["alone"]
