"""Rigs of one's own in the environments: what of them counts, what is refused, and that worlds come and go."""

import copy
import dataclasses
import math
import pickle
import re
import weakref

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cotarget.config import RigConfig, SafetyConfig
from cotarget.env import FOLLOW, Follow, PipelinePolicy, Schedule
from cotarget.env.common import DEFAULT_RIG
from cotarget.errors import ConfigError
from tests.support.env_episodes import FIELD, run, uncollected

STILL = np.zeros(3, np.float32)
ROUNDING = 1e-9  # of an angle [rad]


def simulated(config=DEFAULT_RIG, **changes):
    """The rig with another world."""
    return dataclasses.replace(config, sim=dataclasses.replace(config.sim, **changes))


# ---------------------------------------------------------------- gymnasium
def test_a_rig_made_in_python_can_be_pickled_and_remade(field):
    assert set(pickle.loads(pickle.dumps(RigConfig())).targets) == set(copy.deepcopy(RigConfig()).targets)
    env = gymnasium.make(FOLLOW, rig=field, target="book", seconds=0.2)
    assert env.spec is not None
    again = gymnasium.make(env.spec)
    np.testing.assert_array_equal(env.reset(seed=1)[0], again.reset(seed=1)[0])
    check_env(env.unwrapped, skip_render_check=True)
    env.close()
    again.close()


# ---------------------------------------------------------------- soft limits
@pytest.fixture(scope="module")
def narrow(field):
    """Its head may turn a third as far as birds are aside, and hardly down."""
    return dataclasses.replace(field, safety=SafetyConfig(pan_deg=(-5.0, 5.0), tilt_deg=(-2.0, 25.0)))


def test_an_action_stands_for_a_place_within_the_soft_limits(narrow):
    env = Follow("book", rig=narrow, seconds=2.0)
    for side in (-1.0, 1.0):
        env.reset(seed=0)
        for _ in range(40):
            observation, *_ = env.step(np.array([side, side, 0.0], np.float32))
        state, step = env.episode.rig.head.state(), env.episode.rig.head.limits.pan.step
        for angle, limits in ((state.pan, (-5.0, 5.0)), (state.tilt, (-2.0, 25.0))):
            end = math.radians(limits[side > 0])
            assert 0 <= side * (end - angle) < step  # the last step inside them
        assert env.observation_space.contains(observation)
    env.close()


def test_the_pipelines_actions_stay_within_the_action_space(narrow):
    """Also where the target is beyond the head's limits."""
    env = Follow("bird", rig=narrow, seconds=3.0)
    policy, actions = PipelinePolicy(env), []

    def noting(observation):
        actions.append(policy(observation))
        return actions[-1]

    run(env, noting, seed=0)
    assert all(env.action_space.contains(action) for action in actions)
    assert max(abs(action[0]) for action in actions) > 0.99
    env.close()


def test_schedule_keeps_the_head_within_the_soft_limits(narrow):
    env, pans = Schedule("bird", rig=narrow, seconds=6.0), []

    def first(_):
        pans.append(abs(env.head[0]))
        return 0

    told = run(env, first, seed=0)
    assert math.radians(4.0) < max(pans) <= math.radians(5.0) + ROUNDING
    reachable = np.array([observation["tracks"][:, -1] for observation, *_ in told])
    there = np.array([observation["tracks"][:, 0] for observation, *_ in told])
    assert (there > reachable).any()  # and a policy is told of those who are beyond them
    env.close()


# ---------------------------------------------------------------- what is refused
@pytest.mark.parametrize(("change", "said"), [
    ({"fixed": {"rate_hz": 0.0}}, "sim.fixed.rate_hz: 0"),
    ({"zoom": {"focal_mm": (6.0, 6.0)}}, "sim.zoom.focal_mm: [6.0, 6.0] is not [lowest, highest]"),
    ({"fixed": {"rate_hz": 0.5}}, "rig: sim.fixed.rate_hz: makes a frame 2 s late; the pipeline waits for 1 s"),
    ({"fixed": {"latency_s": 1.5}}, "rig: sim.fixed.latency_s: makes a frame 1.5 s late; the pipeline waits for 1 s"),
    ({"zoom": {"latency_s": 1.5}}, "rig: sim.zoom.latency_s: makes a frame 1.5 s late; the pipeline waits for 1 s"),
])  # fmt: skip
def test_an_impossible_or_too_slow_rig_is_refused_in_one_line(change, said):
    ((part, values),) = change.items()
    rig = simulated(**{part: dataclasses.replace(getattr(DEFAULT_RIG.sim, part), **values)})
    rig = dataclasses.replace(rig, safety=SafetyConfig(watchdog_s=3.0, max_frame_age_s=9.0))
    for make in (Follow, Schedule):
        with pytest.raises(ConfigError, match=re.escape(said)) as caught:
            make(rig=rig)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("old", "new", "seen"), [
    ("", "", None),
    ('euler="99 0 0"', 'euler="95 0 0"', None),  # not as steep
    ('euler="99 0 0"', 'xyaxes="0 1 0 0 0 1"', "0%"),  # to the side
    ('pos="0 0 1.6"', 'pos="0 60 1.6"', "0%"),  # beyond all that flies there
    ("<light", '<geom type="box" pos="0 15 5" size="20 .1 20"/><light', "0%"),  # behind a wall
    ("<light", '<geom type="box" pos="0 15 5" size="20 .1 20" group="3"/><light', None),  # that is not drawn
    ("<light", '<geom type="box" pos="0 15 -9" size="20 .1 10"/><light', None),  # that is low
])  # fmt: skip
def test_a_scene_that_hides_the_paths_is_refused(field, tmp_path, old, new, seen):
    (tmp_path / "other.xml").write_text(FIELD.replace(old, new))
    rig = simulated(field, scene=str(tmp_path / "other.xml"))
    if seen is None:
        Follow("bird", rig=rig)
        return
    with pytest.raises(ConfigError, match=rf"other.xml' {seen} of a bird's paths can be seen; .*'outdoor'") as caught:
        Follow("bird", rig=rig)
    assert "\n" not in str(caught.value)


def test_indoors_there_is_room_for_a_book_and_not_for_a_bird():
    Follow("book", rig=simulated(scene="indoor"))
    for make in (Follow, Schedule):
        with pytest.raises(ConfigError, match="rig: in the scene 'indoor' 0% of a bird's paths"):
            make("bird", rig=simulated(scene="indoor"))


def test_an_invalid_scene_is_refused_at_construction(tmp_path):
    (tmp_path / "bare.xml").write_text("<mujoco/>")
    for scene, said in (("moon", "unknown scene 'moon'"), (str(tmp_path / "bare.xml"), "has no site 'fixed_mount'")):
        with pytest.raises(ConfigError, match=said):
            Follow(rig=simulated(scene=scene))


# ---------------------------------------------------------------- worlds come and go
@pytest.mark.parametrize(("make", "action"), [(Follow, STILL), (Schedule, 0)])
def test_a_world_ends_with_its_episode(field, make, action):
    env, worlds = make("bird", rig=field, seconds=1.0), []
    with uncollected():
        for seed in range(3):
            env.reset(seed=seed)
            env.step(action)
            worlds.append(weakref.ref(env.episode.world))
            assert [world() is not None for world in worlds] == [False] * seed + [True]
        env.close()
        assert worlds[-1]() is None
