"""The batch of cotarget/Follow-v1: it does what the single environment does, in arrays, and resets by itself."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from cotarget.backends import load_config
from cotarget.control.policy import proportional
from cotarget.env import FollowV1, Randomization
from cotarget.env.batch import FollowBatch
from cotarget.env.batch.motion import Plans, axis_motion
from cotarget.errors import ConfigError
from cotarget.evaluation import TruthNoise
from cotarget.sim.motion import Axis
from tests.support.env_episodes import run
from tests.support.target_models import BOX

NO_NOISE = TruthNoise(center_px=0.0, size=0.0, miss=0.0)
ROUNDING = 1e-9
# The batch confirms its track a frame later; by then what that did has died away. The lenses may differ by two of their
# positions, of .019 in the logarithm each, which is up to .15 of the closeness.
SETTLED, FEATURE, CLOSENESS = 110, 0.045, 0.1
# Of the share of good close-ups: twice the spread of the difference of eight birds' episodes of 8 s and 24 others.
SHARE = 0.04


def batch(num_envs, **arguments):
    return gymnasium.make_vec(
        "cotarget.env:cotarget/Follow-v1",
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        **{"paths": 8, **arguments},
    )


# ---------------------------------------------------------------- motion
def test_axes_move_as_the_simulated_ones():
    """Commands at any times, also while an axis moves, too fast for its new speed, or away from its goal."""
    rng = np.random.default_rng(0)
    count, speed, acceleration = 40, 2.6, 3.6
    axes = [Axis(speed, acceleration) for _ in range(count)]
    plans = Plans(12, np.full((1, count), acceleration), np.zeros((1, count)))
    for k in range(60):
        t, goals, speeds = 0.1 * k + rng.uniform(0, 0.05, count), rng.uniform(-1, 1, count), rng.uniform(0.1, 4, count)
        speeds = np.minimum(speeds, speed)
        for i, axis in enumerate(axes):
            axis.command(t[i], goals[i], speeds[i])
        plans.command(t, plans.newest(t), goals[None], speeds[None])
        times = t + rng.uniform(-0.5, 0.3, (3, count))
        found = plans.at(np.maximum(times, 0.0))
        wanted = [[axis.motor(max(at, 0.0))[0] for axis, at in zip(axes, row, strict=True)] for row in times]
        np.testing.assert_allclose(found[:, 0], wanted, atol=ROUNDING)


def test_an_axis_rests_at_its_goal():
    x, v = axis_motion(*(np.array([number]) for number in (9.0, 0.3, -1.0, 0.5, 1.0, 2.0)))
    assert (x[0], v[0]) == pytest.approx((0.5, 0.0), abs=ROUNDING)


# ---------------------------------------------------------------- the same as the single environment
RIG = """
[sim]
scene = "field.xml"
effects = { noise = false, jpeg = false, blur = false, multisampling = false }
zoom = { rate_hz = 20.0, latency_s = 0.11 }
[sim.models]
dog = "dog.obj"
[sim.paths]
dog = [[0, -3, 12, 1], [3, 0, 11, 1.5], [6, 3, 13, 1], [20, -3, 12, 1]]
[targets.dog]
size = 0.6
dimension = "height"
wanted_px = 100
"""


@pytest.mark.parametrize("action", ["rates", "absolute", "residual"])
def test_it_does_what_the_single_environment_does(tmp_path, field, action):
    """A rigid target on a given path without noise, with distortion, and a slower and later zoom camera."""
    (tmp_path / "rig.toml").write_text(RIG)
    (tmp_path / "dog.obj").write_text(BOX)
    (tmp_path / "field.xml").write_text(Path(field.sim.scene).read_text())
    arguments = {"target": "dog", "action": action, "seconds": 6.0, "noise": NO_NOISE}
    arguments["rig"] = load_config(tmp_path / "rig.toml")
    env, told, found = FollowV1(**arguments), [], []

    def aside(features, k):
        swing = np.array([0.04 * np.sin(0.2 * k), 0.04 * np.cos(0.13 * k), 0.1 * np.sin(0.1 * k)])
        if action == "absolute":
            return (features[..., -3:] + 0.01 * swing).astype(np.float32)
        return ((proportional(features) if action == "rates" else 0 * features[..., :3]) + swing).astype(np.float32)

    observation, info = env.reset(seed=0)
    many = batch(3, **arguments)
    several, _ = many.reset(seed=0)
    for k in range(149):
        observation, reward, _, _, info = env.step(aside(observation, k))
        several, rewards, _, truncated, infos = many.step(aside(several, k))
        told.append((observation, reward, info["good"]))
        found.append((several[1], rewards[1], infos["good"][1]))
        assert not truncated.any()
    features, rewards, good = zip(*told[SETTLED:], strict=True)
    other_features, other_rewards, other_good = zip(*found[SETTLED:], strict=True)
    np.testing.assert_allclose(other_features, features, atol=FEATURE)
    np.testing.assert_allclose(other_rewards, rewards, atol=CLOSENESS)
    assert np.mean(np.array(good) != other_good) <= 0.02  # frames at the edge of what is good
    assert np.mean(good) > 0.2
    env.close()
    many.close()


@pytest.mark.parametrize("action", ["rates", "absolute"])
def test_wear_costs_what_it_costs_in_the_single_environment(field, action):
    """A book, which a zoomed-out camera does not see at the wanted size, so that the yield is 0."""
    arguments = {"target": "book", "action": action, "reward": "yield", "wear": 0.1, "rig": field, "seconds": 2.0}
    env, many, told = FollowV1(**arguments), batch(2, **arguments), []
    env.reset(seed=0)
    many.reset(seed=0)
    for given in np.random.default_rng(0).uniform(-0.2, 0.1, (20, 3)).astype(np.float32):
        told.append([-env.step(given)[1], *(-many.step(np.tile(given, (2, 1)))[1])])
    alone, first, second = np.transpose(told)
    np.testing.assert_array_equal(first, second)
    # A head's command may be rounded to the next step, of 0.02 half-widths at the longest focal length of these.
    np.testing.assert_allclose(first, alone, atol=0.1 * 0.02)
    assert alone.max() > 0.1
    env.close()
    many.close()


@pytest.mark.parametrize(("target", "seeds"), [("person", 4), ("bird", 8)])  # birds' paths differ more
def test_it_scores_as_the_single_environment(field, target, seeds):
    """With noise, and a track that is simpler than the tracker."""
    env = FollowV1(target, reward="yield", rig=field, seconds=8.0)
    alone = [sum(reward for _, reward, _ in run(env, proportional, seed)) / env.frames for seed in range(seeds)]
    many = batch(8 * seeds, target=target, reward="yield", rig=field, seconds=8.0, paths=3 * seeds)
    observation, _ = many.reset(seed=0)
    total = np.zeros(8 * seeds)
    for _ in range(env.frames):
        observation, rewards, *_ = many.step(proportional(observation))
        total += rewards
    assert total.mean() / env.frames == pytest.approx(np.mean(alone), abs=SHARE)
    env.close()
    many.close()


# ---------------------------------------------------------------- gymnasium
def test_it_resets_itself_and_the_same_seed_gives_the_same_episodes(field):
    many, told = batch(5, rig=field, seconds=0.4, randomize=True), []
    assert many.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert many.observation_space.shape == (5, 14)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (25, 5, 3))
    for seed in (1, 1, 2):
        observation, _ = many.reset(seed=seed)
        steps = [many.step(action) for action in actions]
        told.append(np.array([observation, *(step[0] for step in steps)]))
        for k, (observation, _, terminated, truncated, infos) in enumerate(steps, 1):
            assert many.observation_space.contains(observation)
            assert not terminated.any()
            assert truncated.tolist() == [k % 10 == 0] * 5
            assert ("final_obs" in infos) == (k % 10 == 0)
            if k % 10 == 0:
                assert not observation.any()
                assert infos["_final_obs"].all()
                assert infos["final_obs"][:, 8:11].any()  # head and lens were moving
    np.testing.assert_array_equal(told[0], told[1])
    assert np.abs(told[0] - told[2]).max() > 0.1
    many.close()


def test_with_next_step_resets_it_does_what_gymnasiums_vectors_do_and_takes_their_wrappers(field):
    """Beside gymnasium's own vector of single environments: flags, rewards of 0 and first observations are the same."""
    arguments = {"num_envs": 2, "rig": field, "seconds": 0.4}
    ours = batch(autoreset_mode="NextStep", **arguments)
    theirs = gymnasium.make_vec("cotarget.env:cotarget/Follow-v1", vectorization_mode="sync", **arguments)
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
    wrapped = gymnasium.wrappers.vector.FlattenObservation(ours)  # as all that change observations, for NextStep alone
    for vector in (wrapped, theirs):
        vector.reset(seed=0)
    for k in range(1, 25):
        found, told = (vector.step(np.full((2, 3), 0.5, np.float32)) for vector in (wrapped, theirs))
        assert found[0].shape == told[0].shape
        np.testing.assert_array_equal(found[3], told[3])
        assert (found[3][0], found[4].keys()) == (k % 11 == 10, {"good", "_good"})
        if k % 11 == 0:  # the reset, to a new episode at rest
            np.testing.assert_array_equal(found[1], told[1])
            assert not found[1].any()
            np.testing.assert_array_equal(found[0], told[0])
        else:
            assert (found[1] > 0).all()
    wrapped.close()
    theirs.close()


def test_shaping_telescopes_in_each_environment(field):
    gamma, sums = 0.9, {}
    for reward in ("yield", "shaped", "dense"):
        many = batch(6, target="bird", reward=reward, gamma=gamma, rig=field, seconds=4.0)
        observation, _ = many.reset(seed=3)
        sums[reward] = []
        for _ in range(60):
            observation, rewards, *_ = many.step(proportional(observation))
            sums[reward].append(rewards)
        sums[reward] = np.array(sums[reward])
        many.close()
    discounts = gamma ** np.arange(60)[:, None]
    # From the state after the first step on, whose potential is the dense reward.
    difference = (discounts * (sums["shaped"] - sums["yield"]))[1:].sum(axis=0)
    wanted = gamma**60 * sums["dense"][-1] - gamma * sums["dense"][0]
    np.testing.assert_allclose(difference, wanted, atol=ROUNDING)


def test_options_set_what_randomize_draws(field):
    """A calibration that is a degree off and a lens at half its speed show in the features."""
    told = []
    for options in (None, {"pan_deg": 1.0, "lens": 0.5}):
        many = batch(4, target="book", rig=field, seconds=2.0, noise=NO_NOISE, paths=1)
        observation, _ = many.reset(seed=0, options=options)
        for _ in range(15):
            observation, *_ = many.step(np.tile([0.0, 0.0, 1.0], (4, 1)))
        told.append(observation)
        many.close()
    degrees = (told[0][:, 11] - told[1][:, 11]) * 158.9
    assert degrees == pytest.approx(1.0, abs=0.01)
    assert (told[1][:, 10] > told[0][:, 10] + 0.2).all()  # the lens is farther behind


@pytest.mark.parametrize(("make", "named"), [
    (lambda: FollowBatch(0), "num_envs: 0"),
    (lambda: FollowBatch(2, paths=0), "paths: 0"),
    (lambda: FollowBatch(2, autoreset_mode="Disabled"), "autoreset_mode: 'Disabled'"),
    (lambda: FollowBatch(2, observation="images"), "observation: "),
    (lambda: FollowBatch(2, target="dragon"), "target: 'dragon'"),
])  # fmt: skip
def test_invalid_arguments_are_refused_in_one_line(make, named):
    with pytest.raises(ConfigError) as caught:
        make()
    assert str(caught.value).startswith(named)
    assert "\n" not in str(caught.value)


def test_invalid_actions_are_refused(field):
    many = batch(2, rig=field, seconds=1.0, randomize=Randomization(path_m=0.1))
    with pytest.raises(gymnasium.error.ResetNeeded):
        many.step(np.zeros((2, 3)))
    with pytest.raises(ConfigError, match="seed: "):
        many.reset(seed=[1, 2])
    many.reset(seed=1)
    for actions in (np.zeros(3), np.full((2, 3), np.nan), "left"):
        with pytest.raises(ConfigError, match="actions: "):
            many.step(actions)
    many.close()
