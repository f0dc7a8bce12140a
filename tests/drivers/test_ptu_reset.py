"""The reset of a PTU-D46: it can be stopped, says how that went, and ends the distrust only by its success."""

import pytest
import serial

from cotarget.drivers.interlock import PositionLostMarker
from cotarget.drivers.ptu_d46 import reset
from cotarget.errors import DeviceError, EmergencyStopError
from tests.support.d46_bench import CONFIG, Bench

SOON_S = 0.2  # from a stop to the halt on the wire; a hundredth of what the reset takes
BOTH = b"!T!T!P!P"
STARTS = 20.0  # when the first limit is met [s]


@pytest.fixture
def bench(monkeypatch):
    made = Bench()
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: made.port)
    return made


@pytest.fixture
def lost(tmp_path):
    return PositionLostMarker("PORT", tmp_path / "stop")


def turns(bench, told=BOTH, ends=25.0):
    """Let the unit do what its reset does."""

    def calibrate():
        bench.unit.facts |= {"PN": -3090, "PX": 3090}
        if told:
            bench.port.inject(told, after=STARTS)
        if ends:
            bench.port.inject(b"*\r\n", after=ends)

    bench.unit.facts |= {"PN": 0, "PX": 0}
    bench.unit.scripted = {"R": [calibrate]}


def never():
    return None


def trusted(lost):
    try:
        lost.refuse()
    except DeviceError:
        return False
    return True


def test_it_reads_its_answer_to_the_end(bench, lost):
    lost.note("it hit its limit")
    turns(bench)
    assert reset(CONFIG, bench.clock, lost, never).pan.highest == 3090
    assert bench.unit.heard.count("R") == 1
    assert bench.port.closed
    assert trusted(lost)


def test_one_that_does_not_end_is_halted(bench, lost):
    turns(bench, ends=None)
    bench.unit.facts |= {"PN": 0, "PX": 0}
    with pytest.raises(DeviceError, match=r"the reset failed: .* did not answer in time; it was halted$"):
        reset(CONFIG, bench.clock, lost, never)
    assert bench.unit.heard[-1] == "H"
    assert not trusted(lost)


@pytest.mark.parametrize("hears", [True, False])
def test_a_stop_is_obeyed_in_the_middle_of_it(bench, lost, hears):
    """A unit that lets characters wait during its reset goes on; that is said."""
    turns(bench, *(b"", None) if hears else ())
    began = bench.clock.now()
    if not hears:
        bench.unit.scripted["H"] = [None] * 2

    def stopped():
        return "smoke" if bench.clock.now() > began + 10.0 else None

    with pytest.raises(EmergencyStopError) as caught:
        reset(CONFIG, bench.clock, lost, stopped)
    said = "emergency stop: smoke; the pan-tilt unit at PORT was in its reset: it "
    said += "was halted" if hears else "does not acknowledge the halt and may go on turning until its reset ends: "
    assert str(caught.value).startswith(said)
    assert ("switch it off" in str(caught.value)) == (not hears)
    sent = next(t for t, data in bench.port.sent if b"H " in data)
    assert began + 10.0 < sent < began + 10.0 + SOON_S
    assert bench.port.closed
    assert not trusted(lost)


def test_a_stop_before_it_leaves_the_head_alone(bench, lost):
    with pytest.raises(EmergencyStopError, match=r"emergency stop: smoke$"):
        reset(CONFIG, bench.clock, lost, lambda: "smoke")
    assert "R" not in bench.unit.heard
    assert trusted(lost)


@pytest.mark.parametrize("hears", [True, False])
@pytest.mark.parametrize("ending", [KeyboardInterrupt, SystemExit])
def test_ctrl_c_and_polite_ends_halt_it(bench, lost, ending, hears, caplog):
    turns(bench, *(b"", None) if hears else ())
    if not hears:
        bench.unit.scripted["H"] = [None] * 2
    began = bench.clock.now()

    def interrupted():
        if bench.clock.now() > began + 10.0 and "H" not in bench.unit.heard:
            raise ending

    with pytest.raises(ending):
        reset(CONFIG, bench.clock, lost, interrupted)
    assert bench.unit.heard[-1] == "H"
    assert ("does not acknowledge the halt" in caplog.text) == (not hears)
    assert not trusted(lost)


def test_a_line_that_is_lost_is_told_with_what_may_follow(bench, lost):
    turns(bench)
    began = bench.clock.now()

    def pulled():
        if bench.clock.now() > began + 10.0:
            bench.port.broken = OSError(5, "Input/output error")

    with pytest.raises(DeviceError, match=r"reset failed: the line .* is lost .* may go on turning until its reset"):
        reset(CONFIG, bench.clock, lost, pulled)
    assert not trusted(lost)


@pytest.mark.parametrize(("told", "missing"), [(b"", "pan or tilt"), (b"!T!T", "pan"), (b"!P!P", "tilt")])
def test_a_unit_that_leaves_an_axis_out_is_not_trusted(bench, lost, told, missing):
    """RD, RP and RT set what a reset does, and DS keeps it."""
    turns(bench, told)
    with pytest.raises(DeviceError, match=f"not that {missing} met a limit"):
        reset(CONFIG, bench.clock, lost, never)
    assert not trusted(lost)


def test_a_limit_that_is_hit_after_it_counts(bench, lost):
    turns(bench)
    bench.unit.facts |= {"PA": 2000}
    bench.unit.scripted["TA"] = [b"!P* 2000\r\n"]
    with pytest.raises(DeviceError, match="pan hit its limit"):
        reset(CONFIG, bench.clock, lost, never)
    assert not trusted(lost)


def test_one_that_finds_nothing_is_not_trusted(bench, lost):
    turns(bench)
    bench.unit.facts |= {"TN": 0, "TX": 0}
    with pytest.raises(DeviceError, match="is not calibrated"):
        reset(CONFIG, bench.clock, lost, never)
    assert not trusted(lost)
