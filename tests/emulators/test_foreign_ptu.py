"""The emulated PTU-D46 driven by other programs: MRPT's CPtuDPerception and PyPI's flir-ptu."""

import math
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from cotarget.emulators.ptu_d46.unit import D46_PAPER, UnitProfile
from tests.support.plants import LiveUnit

pytestmark = [pytest.mark.foreign, pytest.mark.wire]
SOURCE = Path(__file__).parents[1] / "data" / "mrpt_ptu.cpp"
HEADERS = Path("/usr/include/mrpt")
MRPT_LIBRARIES = ("hwdrivers", "comms", "io", "system")
LONGEST_S = 120.0  # of any program, on a loaded machine
ROUNDING = 1e-9  # what printing twelve decimals leaves
# MRPT gives up when a byte is a second late: a small range keeps each leg of the reset below that.
SMALL = UnitProfile.from_degrees((-30, 30), (-20, 20), 0.0514286, 150, 1500)
STEP = math.radians(0.0514286)


@pytest.fixture(scope="module")
def mrpt_program(tmp_path_factory):
    """Our program, compiled; Debian's package has no pkg-config file, but a directory of headers a library."""
    compiler = shutil.which("g++")
    includes = sorted(HEADERS.glob("*/include"))
    if compiler is None or not includes:
        pytest.fail("needs the Debian packages g++ and libmrpt-hwdrivers-dev")
    program = tmp_path_factory.mktemp("mrpt") / "mrpt_ptu"
    command = [compiler, "-std=c++17", str(SOURCE), *(f"-I{path}" for path in includes)]
    command += [*(f"-lmrpt-{name}" for name in MRPT_LIBRARIES), "-o", str(program)]
    made = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S)
    assert made.returncode == 0, made.stderr
    return program


class Program:
    """A running program, of whose output the lines "result NAME NUMBERS" count."""

    def __init__(self, *command):
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.killer = threading.Timer(LONGEST_S, self.process.kill)
        self.said = ""

    def __enter__(self):
        self.killer.start()
        return self

    def __exit__(self, *error):
        self.killer.cancel()
        self.killer.join()
        self.process.kill()
        self.process.communicate(timeout=LONGEST_S)

    def result(self, name):
        """The numbers of the next result, which must be that one."""
        for line in self.process.stdout:
            self.said += line
            if line.startswith("result "):
                _, found, *numbers = line.split()
                assert found == name, self.said
                return [float(n) for n in numbers]
        raise AssertionError(self.said)

    def go_on(self):
        """Let the program proceed."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()


def test_mrpt_moves_reads_back_halts_and_resets(mrpt_program):
    with LiveUnit(SMALL) as live, Program(mrpt_program, live.ports.port) as mrpt:
        pan, tilt = live.pan, live.tilt
        assert mrpt.result("resolution") == pytest.approx([STEP] * 2, abs=ROUNDING)
        assert mrpt.result("pan_limits") == pytest.approx([-583 * STEP, 583 * STEP], abs=ROUNDING)  # 30 / 0.0514286
        # MRPT truncates: 0.3 rad are 334.2 steps, 0.2 rad 222.8.
        assert mrpt.result("moved") == pytest.approx([334 * STEP, -222 * STEP], abs=ROUNDING)
        assert tilt.position() == -222
        assert mrpt.result("offset") == pytest.approx([(334 - 111) * STEP], abs=ROUNDING)
        assert mrpt.result("refused") == [1, 7]  # its number for a position above the limit
        assert mrpt.result("speed") == pytest.approx([111 * STEP], abs=ROUNDING)
        halted = mrpt.result("halted")[0] / STEP
        assert not pan.moving()
        assert pan.position() == pytest.approx(halted, abs=1e-3)
        assert -557 < halted < 223 - 111 * 0.3 * 0.9  # it had turned for 0.3 s, less the ramp, and was not there yet
        mrpt.go_on()
        assert mrpt.result("reset") == [1]
        assert mrpt.result("home") == [0, 0]
        assert (pan.position(), tilt.position()) == (0, 0)
        assert mrpt.process.wait(LONGEST_S) == 0


FLIR_PTU = """
import logging, sys
from telnetlib import Telnet
from flir_ptu.ptu import PTU
from flir_ptu.stream import ConnectionState

logging.basicConfig(level=logging.ERROR)
ptu = PTU("127.0.0.1", int(sys.argv[1]))
# Its connect waits for the greeting of a network unit, which a serial device server does not send.
ptu.stream.socket, ptu.stream.state = Telnet(ptu.stream.host, ptu.stream.port), ConnectionState.CONNECTED
ptu.pan(3000)
ptu.tilt(-1500)
print("result moved", ptu.pan(), ptu.tilt(), flush=True)
print("result desired", ptu.pan_offset(), ptu.tilt_offset(), flush=True)
ptu.tilt_angle(3.0)
print("result angle", ptu.tilt(), flush=True)
sys.stdin.readline()
ptu.send_command("pp-3400")
ptu.send_command("h")
print("result halted", ptu.pan(), flush=True)
ptu.stream.close()
"""


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="flir-ptu needs telnetlib, which Python 3.13 has no more")
def test_flir_ptu_moves_reads_back_and_halts():
    command = (sys.executable, "-W", "ignore::DeprecationWarning", "-c", FLIR_PTU)
    with LiveUnit(D46_PAPER) as live, Program(*command, live.ports.url.rpartition(":")[2]) as flir:
        pan, tilt = live.pan, live.tilt
        assert flir.result("moved") == [3000, -1500]
        assert (pan.position(), tilt.position()) == (3000, -1500)
        assert flir.result("desired") == [3000, -1500]
        assert flir.result("angle") == [234]  # it counts 46.2857 arc seconds a step: 3 * 3600 / 46.2857 = 233.3, up
        flir.go_on()
        halted = flir.result("halted")[0]
        assert not pan.moving()
        assert pan.position() == halted
        assert -3400 < halted <= 3000
        assert flir.process.wait(LONGEST_S) == 0
