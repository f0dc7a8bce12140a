"""An emulated rig in a process of its own, and the truth about it: for tests over the wire."""

import contextlib
import json
import math
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import tomli_w

from cotarget.backends import load_config
from cotarget.calibration import save_calibration
from tests.support.commands import true_calibration

DEADLINE_S = 60.0  # for whatever must happen at all, on a machine that is busy with other things
START_S = 120.0  # for an emulator to say where it listens
LOOK_S = 0.02  # between looks at the truth
STILL_S = 0.4  # a head that has not moved for so long rests
ON_ITS_WAY_DEG = 2.0  # a head that has gone so far is turning
LINES = 7  # that the emulator says when all of it is there
PASSWORD = "open sesame"


def program(*arguments, **options):
    """The command line in a process of its own."""
    path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "cotarget.cli", *map(str, arguments)]
    return subprocess.Popen(
        command,
        env=os.environ | {"PYTHONPATH": path, "COTARGET_PASSWORD": PASSWORD},
        text=True,
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options,
    )


class EmulatedRig:
    """What a user of it has: a folder with both rig.toml and the true calibration; and its control socket."""

    def __init__(self, folder, said, process):
        self.folder, self.said, self.process = folder, said, process
        self.sim, self.hardware, self.calibration = (folder / name for name in ("sim.toml", "hw.toml", "true.json"))
        host, port = said["control"].strip().removeprefix("socket://").split(":")
        self._socket = socket.create_connection((host, int(port)), timeout=DEADLINE_S)
        self._lines = self._socket.makefile("rwb")
        self._lock = threading.Lock()

    def follow(self, *more):
        """The command that follows its book."""
        return ["follow", "--rig", self.hardware, "--calibration", self.calibration, "--target", "book", *more]

    def truth(self):
        return self._ask({"truth": True})

    def switch(self, fault, on=True):
        self._ask({"fault": fault, "on": on})

    def wait_until_it_turns(self):
        first = self.truth()
        deadline = time.monotonic() + DEADLINE_S
        while math.hypot(*way(first, now := self.truth())) < ON_ITS_WAY_DEG or not now["moving"]:
            assert time.monotonic() < deadline, "the head does not turn"
            time.sleep(LOOK_S)

    def wait_until_it_rests(self):
        """Since when it does, on the machine's monotonic clock [s]; at the earliest, now."""
        last = self.truth()
        deadline = time.monotonic() + DEADLINE_S
        while (now := self.truth())["t"] - last["t"] < STILL_S:
            assert time.monotonic() < deadline, "the head goes on turning"
            if now["moving"] or way(last, now) != (0.0, 0.0):
                last = now
            time.sleep(LOOK_S)
        return last["t"]

    def close(self):
        self._lines.close()
        self._socket.close()

    def _ask(self, said):
        with self._lock:
            self._lines.write(json.dumps(said).encode() + b"\n")
            self._lines.flush()
            answer = json.loads(self._lines.readline())
        assert "error" not in answer, answer
        return answer


def way(a, b):
    """From one truth to another, pan and tilt [degrees]."""
    return b["pan_deg"] - a["pan_deg"], b["tilt_deg"] - a["tilt_deg"]


@contextlib.contextmanager
def emulated(folder, table, *options):
    """An emulator of the rig of a table until the end of the block; nobody is left behind, whatever happens."""
    (folder / "sim.toml").write_text(tomli_w.dumps(table))
    save_calibration(folder / "true.json", true_calibration(load_config(folder / "sim.toml")))
    files = ["--rig", folder / "sim.toml", "--write", folder / "hw.toml"]
    with (folder / "stderr").open("w+") as stderr:
        process = program("emulate", *files, "--seconds", "900", *options, stderr=stderr)
        late = threading.Timer(START_S, process.kill)  # then its lines end
        late.start()
        try:
            said = dict(process.stdout.readline().split(maxsplit=1) for _ in range(LINES - 1))
            process.stdout.readline()
            late.cancel()
            with contextlib.closing(EmulatedRig(folder, said, process)) as rig:
                yield rig
        finally:
            late.cancel()
            late.join()
            process.terminate()
            try:
                process.communicate(timeout=DEADLINE_S)
            finally:
                process.kill()
        assert (folder / "stderr").read_text() == ""


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
