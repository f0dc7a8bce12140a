"""The reset of a PTU-D46: it can be stopped, says how that went, and ends the distrust only by its success."""

import pytest
import serial

from cotarget.config import SafetyConfig
from cotarget.drivers.interlock import PositionLostMarker
from cotarget.drivers.ptu_d46 import D46Head
from cotarget.errors import DeviceError, EmergencyStopError
from tests.support.d46_peer import CONFIG, Bench

SOON_S = 0.2  # from a stop to the halt on the wire; a hundredth of what the reset takes
BOTH = b"!T!T!P!P"
STARTS, ENDS = 20.0, 25.0  # when the first limit is met, and when the reset is done [s]


def unplug(bench):
    bench.port.broken = OSError(5, "Input/output error")


class Reset:
    """A unit that resets itself, on the bench, and what the command and its user do."""

    def __init__(self, folder):
        self.bench, self.safety = Bench(), SafetyConfig(stop_file=folder / "stop")
        self.lost = PositionLostMarker(CONFIG.port, self.safety.stop_file)

    def run(self, events=BOTH, ends=ENDS, hears=None, stopped=lambda: None):
        """Reset a unit that says events and its end; if it is halted before, it may hear that or not."""
        bench = self.bench
        if hears:
            events, ends = b"", None

        def calibrate():
            bench.unit.facts |= {"PN": -3090, "PX": 3090}
            bench.port.inject(events, after=STARTS)
            if ends:
                bench.port.inject(b"*\r\n", after=ends)

        bench.unit.facts |= {"PN": 0, "PX": 0}
        bench.unit.scripted |= {"R": [calibrate], "H": [None] * 2 if hears is False else []}
        return D46Head.reset(CONFIG, bench.clock, self.safety, stopped)

    def after(self, seconds, act):
        """Make a ``stopped`` that acts after a time [s]."""
        begun = self.bench.clock.now()
        return lambda: act(self.bench) if self.bench.clock.now() > begun + seconds else None

    def trusted(self):
        try:
            self.lost.refuse()
        except DeviceError:
            return False
        return True


@pytest.fixture
def reset(monkeypatch, tmp_path):
    made = Reset(tmp_path)
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: made.bench.port)
    yield made
    assert made.bench.port.closed


def test_it_reads_its_answer_to_the_end(reset):
    reset.lost.note("it hit its limit")
    assert reset.run().endswith(": pan -3090 to 3090, tilt -907 to 604 steps")
    assert reset.bench.unit.heard.count("R") == 1
    assert reset.trusted()


def test_a_stop_before_it_leaves_the_head_alone(reset):
    with pytest.raises(EmergencyStopError, match="smoke"):
        reset.run(stopped=lambda: "smoke")
    assert "R" not in reset.bench.unit.heard
    assert reset.trusted()


@pytest.mark.parametrize("hears", [True, False])
def test_a_stop_is_obeyed_in_the_middle_of_it(reset, hears):
    """A unit that lets characters wait during its reset goes on; that is said."""
    begun = reset.bench.clock.now()
    with pytest.raises(EmergencyStopError, match="smoke") as caught:
        reset.run(hears=hears, stopped=reset.after(10.0, lambda bench: "smoke"))
    assert ("switch it off" in str(caught.value)) == (not hears)
    sent = next(t for t, data in reset.bench.port.sent if b"H " in data)
    assert begun + 10.0 < sent < begun + 10.0 + SOON_S
    assert not reset.trusted()


@pytest.mark.parametrize("hears", [True, False])
@pytest.mark.parametrize("ending", [KeyboardInterrupt, SystemExit])
def test_ctrl_c_and_polite_ends_halt_it(reset, ending, hears, caplog):
    def end(bench):
        if "H" not in bench.unit.heard:
            raise ending

    with pytest.raises(ending):
        reset.run(hears=hears, stopped=reset.after(10.0, end))
    assert reset.bench.unit.heard[-1] == "H"
    assert ("switch it off" in caplog.text) == (not hears)
    assert not reset.trusted()


# How a reset fails: what the unit does, and a text of the error.
FAILURES = {
    "it does not end": ({"ends": None}, "was halted"),
    "it leaves out both axes": ({"events": b""}, "pan or tilt"),
    "it leaves out pan": ({"events": b"!T!T"}, "not that pan met"),
    "it leaves out tilt": ({"events": b"!P!P"}, "not that tilt met"),
    "the line is lost": ({"stopped": unplug}, "may go on turning"),
    "a limit is hit after it": ({"TA": b"!P* 2000\r\n"}, "pan hit its limit"),
    "it finds no limits": ({"TX": b"* -907\r\n"}, "not calibrated"),
}


@pytest.mark.parametrize("name", FAILURES)
def test_a_unit_whose_reset_fails_is_not_trusted(reset, name):
    changes, said = FAILURES[name]
    changes = dict(changes)
    if "stopped" in changes:
        changes["stopped"] = reset.after(10.0, changes["stopped"])
    reset.bench.unit.scripted = {order: [changes.pop(order)] for order in ("TA", "TX") if order in changes}
    with pytest.raises(DeviceError, match=said):
        reset.run(**changes)
    assert not reset.trusted()
