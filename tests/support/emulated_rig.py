"""What tests over the wire share: an emulated rig with a calibration, and what its head does."""

import contextlib
import math
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

from cotarget.calibration import save_calibration
from cotarget.emulators.process import EmulatedRig
from cotarget.evaluation import true_calibration
from cotarget.sim.world import SimWorld

DEADLINE_S = 60.0  # for whatever must happen at all, on a machine that is busy with other things
LOOK_S = 0.02  # between looks at the truth
STILL_S = 0.4  # a head that has not moved for so long rests
ON_ITS_WAY_DEG = 2.0  # a head that has gone so far is turning
PASSWORD = "open sesame"


@contextlib.contextmanager
def emulated(folder, tables, *options):
    """An emulated rig whose true calibration is at `calibration`; nothing may be written to stderr."""
    with EmulatedRig(folder, tables, *options, environment={"COTARGET_PASSWORD": PASSWORD}) as rig:
        rig.calibration = folder / "true.json"
        save_calibration(rig.calibration, true_calibration(SimWorld(rig.sim, rendered=())))
        yield rig
    assert rig.errors() == ""


def program(*arguments):
    """The command line in a process of its own."""
    path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-m", "cotarget.cli", *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": path, "COTARGET_PASSWORD": PASSWORD},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def follow(rig, *more, rig_toml=None):
    """The command that follows its book."""
    return [
        "follow",
        "--rig",
        rig_toml or rig.hardware_toml,
        "--calibration",
        rig.calibration,
        "--target",
        "book",
        *more,
    ]


def way(a, b):
    """From one truth to another, pan and tilt [degrees]."""
    return b["pan_deg"] - a["pan_deg"], b["tilt_deg"] - a["tilt_deg"]


def wait_until_it_turns(rig):
    first = rig.truth()
    deadline = time.monotonic() + DEADLINE_S
    while math.hypot(*way(first, now := rig.truth())) < ON_ITS_WAY_DEG or not now["moving"]:
        assert time.monotonic() < deadline, "the head does not turn"
        time.sleep(LOOK_S)


def wait_until_it_rests(rig):
    last = rig.truth()
    deadline = time.monotonic() + DEADLINE_S
    while (now := rig.truth())["t"] - last["t"] < STILL_S:
        assert time.monotonic() < deadline, "the head goes on turning"
        if now["moving"] or way(last, now) != (0.0, 0.0):
            last = now
        time.sleep(LOOK_S)


class Watch:
    """Notes the truth about the head all the time, in the background, until the end of the block."""

    def __init__(self, rig):
        self._rig = rig
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.seen = []

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join(DEADLINE_S)
        assert not self._thread.is_alive()

    def _run(self):
        while not self._ended.wait(LOOK_S):
            self.seen.append(self._rig.truth())

    def stays_within(self, pan_deg, tilt_deg, slack_deg):
        return all(
            low - slack_deg <= truth[name] <= high + slack_deg
            for truth in self.seen
            for name, (low, high) in (("pan_deg", pan_deg), ("tilt_deg", tilt_deg))
        )

    def rests_since(self):
        """When the head was last seen elsewhere than where it is now [s]."""
        last = self.seen[-1]
        return next((truth["t"] for truth in reversed(self.seen) if way(truth, last) != (0.0, 0.0)), self.seen[0]["t"])


@contextlib.contextmanager
def meanwhile(act):
    """Do something in the background while the block runs; what fails there fails here."""
    failed = []

    def run():
        try:
            act()
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield
    thread.join(DEADLINE_S)
    assert not thread.is_alive()
    if failed:
        raise failed[0]
