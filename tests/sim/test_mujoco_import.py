"""Programs that import mujoco themselves, on a machine without a display."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.render

WORLD = "from cotarget.sim.world import SimWorld"
OPENED = "from cotarget.config import RigConfig; SimWorld(RigConfig()).rig.fixed.read(); print('rendered')"


def run(*lines, **variables):
    """Run lines of Python without a display and with MUJOCO_GL unset, unless it is among the variables."""
    env = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")}
    program = [sys.executable, "-c", "\n".join(lines)]
    return subprocess.run(program, env=env | variables, capture_output=True, text=True, check=False, timeout=100)


def test_mujoco_imported_first_is_named_as_the_cause():
    last = run("import mujoco", WORLD, OPENED).stderr.splitlines()[-1]
    assert "DeviceError: mujoco was imported before cotarget.sim" in last
    assert "set MUJOCO_GL=egl" in last
    assert "apt-get" not in last


@pytest.mark.parametrize(("lines", "variables"), [
    (("import mujoco", WORLD), {"MUJOCO_GL": "egl"}),  # the message's first advice
    ((WORLD, "import mujoco"), {}),  # its second one
])  # fmt: skip
def test_what_the_message_advises_renders(lines, variables):
    done = run(*lines, OPENED, **variables)
    assert done.stdout == "rendered\n", done.stderr


def test_without_rendering_the_order_does_not_matter():
    done = run("import mujoco", WORLD, OPENED.replace("RigConfig())", "RigConfig(), rendered=())"))
    assert done.stdout == "rendered\n", done.stderr
