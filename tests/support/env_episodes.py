"""What the tests of the environments share: a scene that is built quickly, and episodes."""

import contextlib
import dataclasses
import gc
import math
from pathlib import Path

from cotarget.env.common import DEFAULT_RIG

FRAME_S = 0.04
# As outdoors, the wide camera looks 9 degrees up, over a field where nothing stands.
FIELD = """
<mujoco>
  <worldbody>
    <site name="fixed_mount" pos="0 0 1.6" euler="99 0 0"/>
    <light pos="0 0 9"/>
    <geom type="plane" size="50 50 1" rgba="0.3 0.5 0.3 1"/>
  </worldbody>
</mujoco>
"""


def field_rig(folder: Path):
    """The environments' default rig in that scene."""
    scene = folder / "field.xml"
    scene.write_text(FIELD)
    return dataclasses.replace(DEFAULT_RIG, sim=dataclasses.replace(DEFAULT_RIG.sim, scene=str(scene)))


@contextlib.contextmanager
def uncollected():
    """Nothing is freed meanwhile but what nobody refers to: Python does not look for cycles."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def run(env, policy, seed, seconds=math.inf):
    """An episode's observations, rewards and infos, its reset's among them."""
    observation, info = env.reset(seed=seed)
    told, over = [(observation, 0.0, info)], False
    while not over and len(told) * FRAME_S <= seconds:
        observation, reward, _, over, info = env.step(policy(observation))
        told.append((observation, reward, info))
    return told
