"""A program that signals end: the head is halted, and the devices are released."""

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cotarget.config import RigConfig
from tests.support.commands import true_calibration
from tests.support.safety_rigs import DEADLINE_S

# A program with a rig in real time that prints the calls of its devices; a halt waits for a line on stdin.
PROGRAM = """
import sys, time
from tests.support.safety_rigs import RealDevices
from cotarget.config import SafetyConfig
from tests.support.rigs import guarded

def say(word):
    print(word, flush=True)

def halt():
    say("halting")
    sys.stdin.readline()
    say("halted")

rig = RealDevices()
rig.head.halt = halt
rig.close = lambda: say("closed")
"""
WORK = """
with guarded(rig, SafetyConfig(watchdog_s=1000.0)) as safe:
    safe.head.move(0.5, 0.0)
    say("working")
    time.sleep(1000)
"""
# The command on the simulation, in which each halt waits for a line too.
FOLLOW = """
import sys
from cotarget import cli
from cotarget.sim.devices import SimPanTilt
from cotarget.sim.world import SimWorld

def noted(cls, name, before, after, wait=False):
    act = getattr(cls, name)
    def noting(self, *args, **kwargs):
        print(before, flush=True)
        if wait:
            sys.stdin.readline()
        said = act(self, *args, **kwargs)
        print(after, flush=True)
        return said
    setattr(cls, name, noting)

noted(SimPanTilt, "move", "moving", "moved")
noted(SimPanTilt, "halt", "halting", "halted", wait=True)
noted(SimWorld, "close", "closing", "closed")
sys.exit(cli.main(["follow", "--rig", "rig.toml", "--calibration", "good.json", "--target", "book",
                   "--seconds", "1000", "--csv", "steps.csv"]))
"""
ROOT = Path(__file__).parents[2]


class Child:
    """A program whose lines are waited for with a deadline."""

    def __init__(self, program, folder):
        self.process = subprocess.Popen(
            [sys.executable, "-c", program], cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0,
            process_group=0,  # an orphaned process group, such as that of pytest under setsid, is not suspended
        )  # fmt: skip
        self.lines, self.rest = [], b""

    def wait_for(self, line):
        """Read until a line comes that was not there before."""
        seen, deadline = len(self.lines), time.monotonic() + 3 * DEADLINE_S
        with selectors.DefaultSelector() as selector:
            selector.register(self.process.stdout, selectors.EVENT_READ)
            while line not in self.lines[seen:]:
                assert selector.select(max(deadline - time.monotonic(), 0.0)), f"no '{line}': {self.lines}"
                data = os.read(self.process.stdout.fileno(), 65536)
                assert data, f"ended without '{line}': {self.lines}, {self.process.stderr.read().decode()}"
                *whole, self.rest = (self.rest + data).split(b"\n")
                self.lines += [text.decode() for text in whole]

    def signal(self, number):
        self.process.send_signal(number)

    def answer(self):
        """Let the head be halted once."""
        self.process.stdin.write(b"\n")

    def is_suspended(self):
        return Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"

    def wait_until_suspended(self):
        deadline = time.monotonic() + DEADLINE_S
        while not self.is_suspended():
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def finish(self, answers=8):
        """Answer every halt from now on; return exit status, all lines of stdout, and stderr."""
        out, err = self.process.communicate(b"\n" * answers, timeout=3 * DEADLINE_S)
        self.lines += (self.rest + out).decode().splitlines()
        return self.process.returncode, self.lines, err.decode()

    def close(self):
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def start(tmp_path):
    children = []

    def start(program):
        children.append(Child(program, tmp_path))
        return children[-1]

    yield start
    for child in children:
        child.close()


@pytest.mark.parametrize(("number", "status", "again"), [
    (signal.SIGINT, -signal.SIGINT, 0),  # python's own way to end after Ctrl-C
    (signal.SIGINT, -signal.SIGINT, 4),
    (signal.SIGTERM, 128 + signal.SIGTERM, 1),
    (signal.SIGHUP, 128 + signal.SIGHUP, 1),  # a terminal that was closed, a connection that broke
    (signal.SIGQUIT, 128 + signal.SIGQUIT, 1),  # Ctrl-\
])  # fmt: skip
def test_signal_halts_the_head_despite_further_signals(start, number, status, again):
    child = start(PROGRAM + WORK)
    child.wait_for("working")
    child.signal(number)
    child.wait_for("halting")
    for _ in range(again):
        child.signal(number)
    returned, lines, _ = child.finish()
    assert lines == ["working", "halting", "halted", "closed"]
    assert returned == status


@pytest.mark.parametrize("number", [signal.SIGTSTP, signal.SIGTTOU])
def test_ctrl_z_halts_the_head_before_it_suspends_the_program(start, number):
    child = start(PROGRAM + WORK)
    child.wait_for("working")
    child.signal(number)
    child.wait_for("halting")
    assert not child.is_suspended()
    child.answer()
    child.wait_until_suspended()
    child.signal(signal.SIGCONT)
    child.signal(signal.SIGTERM)
    returned, lines, _ = child.finish()
    assert lines == ["working", "halting", "halted", "halting", "halted", "closed"]
    assert returned == 128 + signal.SIGTERM


def test_program_is_not_suspended_while_its_head_cannot_be_halted(start):
    """Its watchdog keeps trying."""
    broken = (
        "tries = []\ndef halt():\n    tries.append(1)\n    say('tried')\n    if len(tries) < 3: raise OSError('dead')\n"
    )
    child = start(PROGRAM + broken + "rig.head.halt = halt\n" + WORK)
    child.wait_for("working")
    child.signal(signal.SIGTSTP)
    for _ in range(3):
        child.wait_for("tried")
    child.signal(signal.SIGTERM)
    returned, lines, err = child.finish()
    assert lines == ["working", *["tried"] * 4, "closed"]
    assert "not suspended, because the head could not be halted: dead" in err
    assert returned == 128 + signal.SIGTERM


def test_signal_during_the_final_halt_acts_afterwards(start):
    child = start(PROGRAM + "with guarded(rig, SafetyConfig()):\n    pass\nsay('never')")
    child.wait_for("halting")
    child.signal(signal.SIGTERM)
    returned, lines, _ = child.finish()
    assert lines == ["halting", "halted", "closed"]
    assert returned in (128 + signal.SIGTERM, -signal.SIGTERM)


def test_hanging_device_does_not_prevent_ctrl_c(start):
    """Once the head is halted, enough of Ctrl-C ends the wait for a device that hangs."""
    child = start(PROGRAM + "rig.close = lambda: (say('closing'), time.sleep(1000))" + WORK)
    child.wait_for("working")
    child.signal(signal.SIGINT)
    child.process.stdin.write(b"\n")
    child.wait_for("closing")
    deadline = time.monotonic() + DEADLINE_S
    while child.process.poll() is None:  # as a person would
        assert time.monotonic() < deadline
        child.signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.process.wait(0.05)
    returned, lines, _ = child.finish()
    assert lines == ["working", "halting", "halted", "closing"]
    assert returned == -signal.SIGINT


# Two rigs, each in a thread of its own or in the main thread, whose heads get commands and frames all the time.
TWO_RIGS = """
import itertools, os, threading, time
import cotarget
from cotarget.config import SafetyConfig
from cotarget.errors import CotargetError
from tests.support.rigs import guarded
from tests.support.safety_rigs import RealDevices

def run(number):
    rig = RealDevices()
    def noted(name, act):
        def call(*arguments):
            os.write(1, f"{number} {name}\\n".encode())  # whole lines from several threads
            return act(*arguments)
        return call
    rig.head.move, rig.head.halt = noted("move", rig.head.move), noted("halt", rig.head.halt)
    try:
        with guarded(rig, SafetyConfig()) as safe:
            for k in itertools.count():
                safe.head.move(0.1 * (k % 5), 0.0)
                time.sleep(0.02)
    except CotargetError as error:
        os.write(1, f"{number} {error}\\n".encode())
"""
IN_THREADS = """
cotarget.handle_signals()
for number in (1, 2):
    threading.Thread(target=run, args=(number,)).start()
time.sleep(1000)
"""
IN_BOTH = """
cotarget.handle_signals()
threading.Thread(target=run, args=(1,)).start()
run(2)
"""


@pytest.mark.wire
@pytest.mark.parametrize(("where", "number"), [
    pytest.param(IN_THREADS, signal.SIGTERM, id="threads"),
    pytest.param(IN_BOTH, signal.SIGINT, id="a thread and the main thread"),
    pytest.param(IN_BOTH, signal.SIGTSTP, id="suspended"),
])  # fmt: skip
def test_a_signal_halts_the_heads_of_all_threads(start, where, number):
    child = start(TWO_RIGS + where)
    for rig in "12":
        child.wait_for(f"{rig} move")
    child.signal(number)
    if number == signal.SIGTSTP:
        child.wait_until_suspended()
        os.set_blocking(child.process.stdout.fileno(), False)
        with contextlib.suppress(BlockingIOError):
            while True:
                child.rest += os.read(child.process.stdout.fileno(), 65536)
        child.lines += child.rest.decode().splitlines()
    else:
        child.finish()
    for rig in "12":
        assert [line for line in child.lines if line in (f"{rig} move", f"{rig} halt")][-1] == f"{rig} halt"


def test_a_rig_in_a_thread_is_refused_without_handlers_in_the_main_thread(start):
    child = start(TWO_RIGS + "thread = threading.Thread(target=run, args=(1,)); thread.start(); thread.join()")
    returned, (line,), _ = child.finish()
    assert returned == 0
    assert "cotarget.handle_signals()" in line


@pytest.mark.parametrize("interrupted", [False, True])
def test_unclosed_rig_is_halted_at_exit_without_a_traceback(start, interrupted):
    child = start(PROGRAM + "safe = guarded(rig, SafetyConfig(watchdog_s=1000.0))\nsafe.head.move(0.5, 0.0)")
    child.wait_for("halting")
    if interrupted:
        child.signal(signal.SIGINT)
    returned, lines, err = child.finish()
    assert (lines, err) == (["halting", "halted", "closed"], "")
    assert interrupted or returned == 0


def test_program_keeps_its_own_signal_handlers(start):
    own = "import signal\nsignal.signal(signal.SIGTERM, lambda *_: say('mine'))\n"
    child = start(PROGRAM + own + WORK.replace("sleep(1000)", "sleep(0)"))
    child.wait_for("halting")
    child.signal(signal.SIGTERM)
    returned, lines, err = child.finish()
    assert (returned, lines, err) == (0, ["working", "halting", "halted", "closed", "mine"], "")


@pytest.mark.render
@pytest.mark.parametrize(("number", "status", "said"), [
    (signal.SIGINT, 130, "interrupted"),
    pytest.param(signal.SIGTERM, 143, "terminated", marks=pytest.mark.slow),
    pytest.param(signal.SIGHUP, 129, "terminated", marks=pytest.mark.slow),
])  # fmt: skip
def test_follow_ended_by_a_signal_halts_the_head(start, tmp_path, number, status, said):
    """A second signal comes while the head is being halted; the table is completed afterwards."""
    (tmp_path / "rig.toml").write_text('[sim]\nscene = "indoor"\ntargets = ["book"]\n')
    true_calibration(RigConfig()).save(tmp_path / "good.json")
    child = start(FOLLOW)
    child.wait_for("moved")
    child.signal(number)
    child.wait_for("halting")
    child.signal(number)
    assert not (tmp_path / "steps.csv").exists()
    returned, lines, err = child.finish()
    if number == signal.SIGINT:  # the run's JSON comes last, and its counts are those of the table
        at = lines.index("{")
        lines, printed = lines[:at], json.loads("\n".join(lines[at:]))
        assert printed["steps"] == len((tmp_path / "steps.csv").read_text().splitlines()) - 1
    last = len(lines) - lines[::-1].index("moving") if "moving" in lines else 0
    assert lines[last:] in (
        ["moved", "halting", "halted", "halting", "halted", "closing", "closed"],
        ["halting", "halted", "halting", "halted", "closing", "closed"],  # ended in the middle of a command
    )
    assert (returned, err) == (status, f"cotarget follow: {said}; steps.csv holds what there was until then\n")
    assert len((tmp_path / "steps.csv").read_text().splitlines()) > 1
