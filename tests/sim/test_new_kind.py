"""A kind of target that the package does not have comes in with two new files and one name."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import cotarget
from cotarget.files import assets_dir

MODEL = """
<mujoco model="kite">
  <worldbody>
    <body name="kite" mocap="true">
      <geom type="box" size="0.4 0.3 0.01" contype="0" conaffinity="0"/>
      <body name="tail" pos="-0.4 0 0">
        <joint name="tail" axis="0 1 0"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 -0.6 0 0" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
KIND = """
import math

from cotarget.sim.targets.attitude import heading
from cotarget.sim.targets.paths import waypoint_path
from cotarget.sim.targets.target import TargetKind


def path(scene, rng):
    return waypoint_path([(0.0, -2.0, 20.0, 6.0), (20.0, 2.0, 20.0, 6.0)])


def limbs(beat):
    return {"tail": 0.3 * math.sin(beat)}


def stance(kite, t, beat):
    position, velocity, _ = kite.path.motion(t)
    return position, heading(position, velocity), limbs(beat)


KIND = TargetKind("kite", stance, path, limbs=limbs, beat=lambda kite, t: kite.phase + 6.0 * t, beat_s=1.0, scatter=0.1)
"""
RIG = """
[sim]
targets = ["kite", "kite2"]
[sim.paths]
kite2 = [[0, 0, 20, 4], [20, 3, 20, 4]]
[targets.kite]
size = 0.8
dimension = "width"
wanted_px = 160
detector = "motion"
"""
PROGRAM = """
from cotarget.backends import load_config
from cotarget.sim.truth import Outlines, outermost
from cotarget.sim.world import SimWorld

world = SimWorld(load_config("rig.toml"), rendered=())
truth = world.truth()
for name in ("kite", "kite2"):
    for each in (truth, Outlines(truth)):
        silhouette = each.silhouette(name, "fixed", 5.0)
        assert silhouette.visible == 1.0, silhouette
        print(name, *(f"{side:.1f}" for side in silhouette.size_px))
assert truth.targets["kite"].size != 1.0
tails = outermost("kite")[:, 2].min(axis=1)  # the tail swings by 0.6 m sin(0.3)
assert abs(tails.min() + 0.18) < 0.03, tails
"""


def test_a_new_kind_is_a_model_a_module_and_a_name(tmp_path):
    shutil.copytree(Path(cotarget.__file__).parent, tmp_path / "cotarget", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(assets_dir(), tmp_path / "sim_assets", dirs_exist_ok=True)
    (tmp_path / "sim_assets/targets/kite.xml").write_text(MODEL)
    (tmp_path / "cotarget/sim/targets/kite.py").write_text(KIND)
    table = tmp_path / "cotarget/sim/targets/__init__.py"
    table.write_text(table.read_text().replace('    "bird",\n', '    "bird",\n    "kite",\n'))
    (tmp_path / "rig.toml").write_text(RIG)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env={**os.environ, "PYTHONPATH": str(tmp_path)}, cwd=tmp_path,
        capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    sizes = [[float(side) for side in line.split()[1:]] for line in done.stdout.splitlines()]
    assert len(sizes) == 4
    for exact, prepared in (sizes[:2], sizes[2:]):
        assert all(abs(a - b) < 2.0 for a, b in zip(exact, prepared, strict=True))


def test_the_names_of_the_kinds_need_no_mujoco():
    program = "import sys; from cotarget.sim.targets import KINDS; assert 'mujoco' not in sys.modules; print(*KINDS)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=100)
    assert done.stdout == "book person bird\n"
