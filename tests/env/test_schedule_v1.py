"""cotarget/Schedule-v1: what it shares with version 0, its rewards, and the way to each target."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cotarget.env import Schedule, ScheduleV1, SchedulingPolicy
from cotarget.env.rewards import closeness
from cotarget.env.schedule_v1 import SLOT_FEATURES
from cotarget.errors import ConfigError
from cotarget.evaluation import closeup_of
from tests.support.env_episodes import run

TELESCOPED = 1e-9  # rounding of a discounted sum
TABULATED = 0.05  # of a closeness by the tables of the outlines, for one by the exact truth
SECONDS = 8.0
TRAVEL = list(SLOT_FEATURES).index("travel_s")


def test_it_passes_the_checker(field):
    env = ScheduleV1("bird", "shaped", wear=0.01, rig=field, seconds=0.4, randomize=True)
    check_env(env, skip_render_check=True)
    env.close()


def test_it_is_version_0_with_another_feature_and_a_shaped_reward(field):
    """Features and yields are the same, shaping telescopes, and the potential is that of the exact truth."""
    envs = [Schedule("bird", rig=field, seconds=SECONDS), ScheduleV1("bird", "shaped", rig=field, seconds=SECONDS)]
    env, gamma = envs[1], envs[1].gamma
    policies = [SchedulingPolicy(each) for each in envs]
    (before, _), (after, info) = (each.reset(seed=0) for each in envs)
    potentials, earned, paid, errors = [info["potential"]], [], [], []
    served, names = np.zeros(5, bool), np.array(["bird", *(f"bird{i}" for i in range(2, 6))])
    for k in range(env.frames):
        (before, reward, *_), (after, more, _, _, info) = (
            each.step(policy(None)) for each, policy in zip(envs, policies, strict=True)
        )
        np.testing.assert_array_equal(after["tracks"][:, :TRAVEL], before["tracks"])
        np.testing.assert_array_equal(after["rig"], before["rig"])
        if k % 10 == 0:
            closeups = [closeup_of(env.episode.truth, name, env.target, info["t_closeup"]) for name in names[~served]]
            off = [np.hypot(each.u_px - 319.5, each.v_px - 239.5) / 320 for each in closeups]
            ratios = [each.size_ratio for each in closeups]
            errors.append(info["potential"] - closeness(np.nan_to_num(off, nan=np.inf), ratios).max())
        served = info["good_s"] >= 1.0 - 1e-9
        potentials.append(info["potential"])
        earned.append(reward)
        paid.append(more)
    ends = gamma**env.frames * potentials[-1] - potentials[0]
    assert gamma ** np.arange(env.frames) @ np.subtract(paid, earned) == pytest.approx(ends, abs=TELESCOPED)
    assert served.any()
    assert sum(earned) > 6  # for a target that is served
    assert max(potentials) > 0.6
    assert np.abs(errors).max() < TABULATED
    for each in envs:
        each.close()


def test_dense_is_the_potential_less_the_wear_of_the_pipelines_commands(field):
    env = ScheduleV1("bird", wear=0.5, rig=field, seconds=4.0)
    steps = run(env, SchedulingPolicy(env), seed=0)[1:]
    costs = [info["potential"] - reward for _, reward, info in steps]
    assert min(costs) == 0.0  # before there is a track, no command changes
    assert max(costs) > 0.1
    env.close()


def test_the_way_to_a_target_is_the_time_that_the_head_takes(field):
    """The head turns to a target that was first told as so many seconds away, and is there within that time."""
    env = ScheduleV1("bird", rig=field, seconds=SECONDS)
    observation, info = env.reset(seed=0)
    while not info["action_mask"].any():
        observation, _, _, _, info = env.step(0)
    slot = int(np.argmax(info["action_mask"]))
    wanted_s = float(observation["tracks"][slot, TRAVEL])
    axis, (pan, _) = env.limits.pan, env.candidates[0].at - env.head
    # From rest to rest at a limited acceleration: the least time for the way in pan alone.
    assert wanted_s >= axis.travel_s(float(pan)) - 1e-6
    assert 0.1 < wanted_s < 4.0
    ways = []
    for _ in range(round((wanted_s + 0.6) / 0.04)):  # 0.6 s until it settles, as `Rounds` counts
        observation, *_ = env.step(slot)
        ways.append(float(observation["tracks"][slot, TRAVEL]))
    assert ways[-1] < 0.3 * wanted_s
    env.close()


@pytest.mark.parametrize(("make", "named"), [
    (lambda: ScheduleV1(reward="praise"), "reward: 'praise'"),
    (lambda: ScheduleV1(observation="images"), "observation: 'images'"),
    (lambda: ScheduleV1(wear=-1), "wear: -1"),
    (lambda: ScheduleV1().reset(options={"wind": 3}), "options: {'wind': 3}"),
])  # fmt: skip
def test_invalid_arguments_are_refused_in_one_line(make, named):
    with pytest.raises(ConfigError) as caught:
        make()
    assert str(caught.value).startswith(named)
    assert "\n" not in str(caught.value)


def test_there_is_no_other_action(field):
    with pytest.raises(TypeError, match="action"):
        gymnasium.make("cotarget.env:cotarget/Schedule-v1", action="rates")
