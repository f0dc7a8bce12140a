"""What the environments reward, and who does well in them: the project's own pipeline, and not chance."""

import dataclasses
import math

import gymnasium
import numpy as np
import pytest

from cotarget.config import RigConfig, SimConfig, SimEffects
from cotarget.env import FOLLOW, Follow, PipelinePolicy, Schedule
from cotarget.env.schedule import CANDIDATE_FEATURES, SLOTS
from cotarget.evaluation import closeup_of, true_calibration
from cotarget.geometry import pose
from cotarget.metrics import SERVED_S
from tests.support.env_episodes import FRAME_S, run
from tests.support.rigs import with_zoom_head


# ---------------------------------------------------------------- rewards
def textbook(field):
    """A rig without any effect, whose zoom camera stands where the wide one does and turns about its own pupil."""
    here = pose([0, 0, 0], [0, 0, 0])
    off = {f.name: False for f in dataclasses.fields(SimEffects)}
    zoom = dataclasses.replace(SimConfig().zoom, focal_mm=(6.0, 100.0))
    sim = SimConfig(scene=field.sim.scene, T_zoom0_fixed=here, T_head_zoom=here, zoom=zoom, effects=SimEffects(**off))
    return RigConfig(sim=sim)


def looking_at(env, zoom, aside_px=0.0):
    """The action that has the book so many times as large as wanted and so far from the middle, worked by hand.

    Its width of 0.234 m is f 0.234 / z pixels at a distance z; 160 are wanted. The lens's true focal length is 692 px
    where it says 6 / 0.009 = 666.7.
    """
    truth = env.episode.truth
    x, y, z = truth.T_world_fixed.inv().apply(truth.center("book", env.times[1]))
    focal = zoom * 160.0 * math.sqrt(x * x + y * y + z * z) / 0.234
    principal = np.array([326.0, 235.0]) - [319.5, 239.5]  # the lens looks a little aside of the middle
    pan, tilt = math.atan2(x, z), math.atan2(-y, math.hypot(x, z))
    pan += (principal[0] - aside_px) / focal
    tilt -= principal[1] / focal
    return env.units.action((pan, tilt, focal * 6.0 / 0.009 / 692.0))


@pytest.mark.parametrize(("zoom", "aside_px", "reward"), [
    (1.0, 0.0, 1.0),
    (0.84, 0.0, 1.0),
    (0.77, 0.0, 0.0),  # too small: below 0.8
    (1.19, 0.0, 1.0),
    (1.29, 0.0, 0.0),  # too large: above 1.25
    (1.0, 220.0, 1.0),  # half of 160 px beside 220 is 300 of 320
    (1.0, 260.0, 0.0),  # and beside 260 it is cut
    (1.0, -260.0, 0.0),
])  # fmt: skip
def test_the_reward_is_a_good_closeup_by_the_metrics(field, zoom, aside_px, reward):
    """Of a book that stands 10 m away, its cover turned to the camera but for a few degrees."""
    env = Follow("book", rig=textbook(field), seconds=1.0)
    env.reset(seed=3)
    for _ in range(3):  # head and lens jump; the last frame was exposed after the first command
        _, earned, _, _, info = env.step(looking_at(env, zoom, aside_px))
    assert info["size_ratio"] == pytest.approx(zoom, rel=0.03)  # it swings
    center = info["center_px"] - [319.5, 239.5]
    assert center == pytest.approx([aside_px, 0.0], abs=3.0)  # the tangent is no angle
    assert info["offset_px"] == pytest.approx(np.hypot(*center))
    assert earned == reward == info["good"]
    env.close()


def test_a_zoom_frame_is_rewarded_once(field):
    """The zoom camera has half the rate of the fixed one, which gives the steps."""
    rig = textbook(field)
    zoom = dataclasses.replace(rig.sim.zoom, rate_hz=rig.sim.fixed.rate_hz / 2)
    env = Follow("book", rig=dataclasses.replace(rig, sim=dataclasses.replace(rig.sim, zoom=zoom)), seconds=1.0)
    env.reset(seed=3)
    told = [env.step(looking_at(env, 1.0, 0.0)) for _ in range(12)][4:]
    assert all(info["good"] for *_, info in told)
    assert sum(reward for _, reward, *_ in told) == len(told) / 2
    env.close()


def test_rewards_are_those_of_the_exact_truth(field):
    """Outlines are told by tables; a close-up that is good by the truth is one by them, but at the very bounds."""
    env = Follow("bird", rig=field, seconds=4.0)
    policy, same = PipelinePolicy(env), []
    observation, _ = env.reset(seed=1)
    for _ in range(99):
        observation, reward, *_ = env.step(policy(observation))
        same.append(closeup_of(env.episode.truth, "bird", env.target, env.times[1]).good == reward)
    assert np.mean(same) >= 0.97
    env.close()


def test_scheduling_is_rewarded_by_seconds_and_by_targets_served(monkeypatch, field):
    """The first target well in the close-up for 1.2 s from the third frame on, the second for 0.4 s."""
    env = Schedule("bird", rig=field, seconds=2.0, served_reward=3.0)
    env.reset(seed=0)
    frame = [0]

    def good():
        frame[0] += 1
        first = 3 <= frame[0] < 33
        return {"bird": first, "bird2": 10 <= frame[0] < 20, "bird3": False, "bird4": False, "bird5": False}

    monkeypatch.setattr(env, "_good", good)
    steps = [env.step(0) for _ in range(49)]
    rewards = np.array([step[1] for step in steps])
    wanted = np.zeros(49)
    wanted[2:32] += FRAME_S
    wanted[9:19] += FRAME_S
    wanted[2 + round(SERVED_S / FRAME_S) - 1] += 3.0  # the 25th frame makes up a second
    assert rewards == pytest.approx(wanted)
    assert steps[-1][4]["good_s"] == pytest.approx([1.2, 0.4, 0, 0, 0])
    assert [step[4]["served"] for step in steps] == [0] * 26 + [1] * 23
    env.close()


# ---------------------------------------------------------------- scheduling
def test_a_track_keeps_its_slot_and_the_slot_chosen_is_followed(field):
    env = Schedule("bird", rig=field, seconds=6.0)
    observation, info = env.reset(seed=0)
    assert not observation["tracks"].any()
    assert not info["action_mask"].any()
    slots, followed = [], []
    for k in range(149):
        there = np.flatnonzero(info["action_mask"])
        wish = int(there[-1]) if len(there) else 0
        if k > 100:
            wish = SLOTS - 1  # nobody
            assert not info["action_mask"][wish]
        was_there = bool(info["action_mask"][wish])
        observation, _, _, _, info = env.step(wish)
        tracks = {name: observation["tracks"][:, i] for i, name in enumerate(CANDIDATE_FEATURES)}
        np.testing.assert_array_equal(tracks["there"], info["action_mask"])
        assert not observation["tracks"][info["action_mask"] == 0].any()
        for each in env.candidates:  # a rate in half ranges a second, a time in parts of 20 s
            row = {name: values[env.slot_of(each.id)] for name, values in tracks.items()}
            rates = 2 * each.rate / (np.ptp(env.limits.pan.range), np.ptp(env.limits.tilt.range))
            assert (row["pan_rate"], row["tilt_rate"]) == pytest.approx(np.clip(rates, -1, 1), rel=1e-5, abs=1e-6)
            assert row["leaves_in"] == pytest.approx(min(each.leaves_in / 20.0, 1.0), rel=1e-5)
        slot_of = {env.slot_of(each.id): each.id for each in env.candidates}
        slots.append([slot_of.get(slot, 0) for slot in range(SLOTS)])
        there = was_there and bool(tracks["there"][wish])
        followed.append((wish, np.flatnonzero(tracks["followed"]).tolist(), there))
    for number in {number for row in slots for number in row if number}:
        assert len({row.index(number) for row in slots if number in row}) == 1
    assert len({number for row in slots for number in row if number}) >= 3
    assert all(seen == [wish] for wish, seen, there in followed if there)
    assert all(seen == [] for _, seen, _ in followed[102:])
    env.close()


# ---------------------------------------------------------------- who does well
@pytest.mark.parametrize(("target", "seconds", "least"), [("book", 4.0, 0.6), ("bird", 4.0, 0.5)])
def test_the_pipeline_follows_and_chance_does_not(field, target, seconds, least):
    env = gymnasium.make(FOLLOW, rig=field, target=target, seconds=seconds)
    env.action_space.seed(0)
    earned = [
        np.mean([reward for _, reward, _ in run(env, policy, seed=5)])
        for policy in (PipelinePolicy(env), lambda _: env.action_space.sample())
    ]
    assert earned[0] > least
    assert earned[1] < 0.05
    env.close()


def test_a_calibration_that_is_wrong_serves_worse(field):
    """Turned by 3 degrees: what the pipeline aims at by it is beside the close-up."""
    rig = Follow("book", rig=field, seconds=4.0)
    rig.reset(seed=5)
    true = true_calibration(rig.episode.world)
    wrong = with_zoom_head(true, T_zoom0_fixed=pose([0, 0, 0], [0, 3, 0]) * true.zoom_head.T_zoom0_fixed)
    earned = []
    for calibration in (true, wrong):
        env = Follow("book", rig=field, seconds=4.0, calibration=calibration)
        earned.append(sum(reward for _, reward, _ in run(env, PipelinePolicy(env), seed=5)))
        env.close()
    assert earned[0] > 60
    assert earned[1] < 10
    rig.close()
