"""Hard courses: their limits, their wall, and the experiment that follows on them."""

import numpy as np
import pytest

from cotarget.config import SimHead
from cotarget.sim.targets.paths import MOUNT
from cotarget.sim.world import SimWorld
from experiments.engine import known_experiments
from experiments.following import hold_tight
from experiments.following.tight_paths import STYLES, tight_course

SECONDS = 8.0


@pytest.mark.parametrize("name", STYLES)
def test_a_hard_course_is_within_the_heads_limits_and_goes_behind_a_wall(name, tmp_path):
    course = tight_course(name, 3, SECONDS)
    assert course == tight_course(name, 3, SECONDS)
    config = hold_tight.tight_config(name, 3, SECONDS, 10.0, tmp_path)
    assert (config.sim.fixed.rate_hz, config.sim.zoom.rate_hz) == (10.0, 10.0)
    assert config.target(name).wanted_px == (288.0 if name == "person" else 384.0)  # 60 % of 480 and of 640
    world = SimWorld(config, rendered=())
    truth, times = world.truth(), np.arange(3.0, SECONDS, 0.05)
    x = np.array([truth.center(name, t) for t in times])
    pan = np.degrees(np.arctan2(*(x - MOUNT)[:, :2].T))
    assert np.abs(np.gradient(pan, 0.05)).max() < 0.8 * SimHead().speed_deg_s
    with world.rig as rig:
        rig.clock.sleep_until(SECONDS)
        hidden = [truth.silhouette(name, "fixed", t).unhidden < 0.5 for t in times]
    assert 1.0 < 0.05 * sum(hidden) < 2.9


def test_there_is_an_experiment_of_hard_courses():
    assert "hold_tight" in known_experiments()
