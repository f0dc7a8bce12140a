"""cotarget/Follow-v1: aims, features, actions and rewards, what varies between episodes, and targets of one's own."""

import dataclasses
import itertools
import math

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import cotarget as ct
from cotarget.config import DEFAULT_TARGETS, RigConfig
from cotarget.control.policy import TASK_FEATURES, proportional
from cotarget.env import Follow, FollowV1, PipelinePolicy, Randomization
from cotarget.env.aiming import AimSolver
from cotarget.env.rewards import closeness, shaped
from cotarget.errors import CotargetError
from cotarget.evaluation import TruthNoise, true_calibration
from cotarget.sim.world import SimWorld
from cotarget.targeting import Reach, WantedSize, depth_of, point_at
from tests.support.env_episodes import run
from tests.support.rolled_rig import rolled_config
from tests.support.target_models import BOX

NO_NOISE = TruthNoise(center_px=0.0, size=0.0, miss=0.0)
STILL = np.zeros(3, np.float32)
TELESCOPED = 1e-9  # rounding of a discounted sum
PLACE_RAD, FOCAL = 1e-4, 3e-4  # of a tabulated aim at 3 m or farther; a step of the head is 9e-4 rad
REPORTED_RAD = 1e-3  # a step of the head


def named(features):
    """Task features by name."""
    return dict(zip(TASK_FEATURES, np.asarray(features).tolist(), strict=True))


# ---------------------------------------------------------------- gymnasium
@pytest.mark.parametrize(("action", "reward"), [("rates", "dense"), ("residual", "shaped"), ("absolute", "yield")])
def test_it_passes_the_checker(field, action, reward):
    env = FollowV1("bird", action, reward, rig=field, seconds=1.0, randomize=True)
    check_env(env, skip_render_check=True)
    env.close()


# ---------------------------------------------------------------- aims
@pytest.mark.parametrize("rolled_deg", [None, 90.0])
@pytest.mark.parametrize("name", ["book", "person", "bird"])
def test_tabulated_aims_are_the_exact_ones(tmp_path, name, rolled_deg):
    """With distortion, drifting optics and axes that do not cross; and with a fixed camera on its side."""
    config = RigConfig() if rolled_deg is None else rolled_config(tmp_path, name, 0, fixed_deg=rolled_deg)
    world = SimWorld(config, rendered=())
    calibration, target, focal_range = true_calibration(world), DEFAULT_TARGETS[name], world.rig.zoom.focal_range
    u, v, lengths = np.random.default_rng(0).uniform([60, 60, 8], [580, 420, 40], (40, 3)).T
    pixels = np.stack([u, v])
    found = AimSolver(calibration, target, focal_range).solve(pixels, lengths, pixels)
    reach = Reach((-math.pi, math.pi), (-math.pi, math.pi), focal_range)
    wanted = WantedSize(target.size, target.wanted_px, target.is_vertical())
    for pixel, length, (pan, tilt, focal) in zip(pixels.T, lengths, found.T, strict=True):
        vertical = target.is_vertical() != (rolled_deg is not None)  # the image's axis along the size
        along = dataclasses.replace(target, dimension="height" if vertical else "width")
        x_fixed = point_at(calibration, pixel, depth_of(calibration, along, length, pixel))
        exact = ct.aim(calibration, x_fixed, reach, wanted_size=wanted)
        assert (pan, tilt) == pytest.approx((exact.pan, exact.tilt), abs=PLACE_RAD)
        assert math.exp(focal) == pytest.approx(exact.nominal_px, rel=FOCAL)


def test_offsets_are_the_aim_less_the_head_in_half_widths(field):
    """A book that stands, detected without noise, and a head and a lens that stand aside."""
    env = FollowV1("book", rig=field, seconds=4.0, noise=NO_NOISE)
    told = run(env, lambda _: np.array([0.1, -0.05, 0.2], np.float32) * (env.closeup.t < 0.4), seed=0)
    features, rig, outlines, t = named(told[-1][0]), env.episode.rig, env.episode.outlines, env.wide.t
    low, high = outlines.box("book", "fixed", t)
    size = np.array([high[0] - low[0], high[1] - low[1]])
    depth = depth_of(env.calibration, env.target, size[0], (low + high) / 2)
    reach = Reach((-3.0, 3.0), (-1.0, 1.0), rig.zoom.focal_range)
    wanted = WantedSize(env.target.size, env.target.wanted_px)
    aim = ct.aim(env.calibration, point_at(env.calibration, (low + high) / 2, depth), reach, wanted_size=wanted)
    state, nominal_px = rig.head.state(), rig.zoom.state().focal_px
    assert (state.moving, rig.zoom.state().moving) == (False, False)
    assert state.pan > 0.1  # it was turned aside
    half_width = rig.zoom.size[0] / 2 / env.calibration.zoom_head.lens.at(nominal_px).focal_px[0]
    assert features["pan_off"] * half_width == pytest.approx(aim.pan - state.pan, abs=REPORTED_RAD)
    assert features["tilt_off"] * half_width == pytest.approx(aim.tilt - state.tilt, abs=REPORTED_RAD)
    assert features["zoom_off"] == pytest.approx(math.log(aim.nominal_px / nominal_px), abs=0.01)
    still = ("pan_rate", "tilt_rate", "zoom_rate", "pan_speed", "tilt_speed", "zoom_left", "unseen_s")
    assert [features[name] for name in still] == pytest.approx([0.0] * len(still), abs=0.01)
    there = env.units.numbers(aim.pan, aim.tilt, aim.nominal_px)
    assert [features[name] for name in ("pan", "tilt", "focal")] == pytest.approx(there, abs=0.01)
    env.close()


# ---------------------------------------------------------------- actions
def test_a_unit_turns_by_half_a_close_ups_width_a_frame_and_zooms_by_a_tenth(field):
    env = FollowV1("bird", rig=field, seconds=4.0)
    env.reset(seed=0)
    for _ in range(40):  # zoom in first
        env.step(np.array([0.0, 0.0, 1.0], np.float32))
    before, focal_px = env.episode.rig.head.state(), env.episode.rig.zoom.state().focal_px
    lens = env.calibration.zoom_head.lens
    half_width = 320 / lens.at(focal_px).focal_px[0]
    assert focal_px == pytest.approx(env.episode.rig.zoom.focal_range[1])
    for _ in range(20):
        env.step(np.array([0.5, -0.25, -0.1], np.float32))
    after, later_px = env.episode.rig.head.state(), env.episode.rig.zoom.state().focal_px
    assert math.log(focal_px / later_px) == pytest.approx(0.01 * 18, abs=0.03)  # two frames of delay; whole positions
    # The half width grows by a fifth meanwhile, and the head takes two frames to begin.
    assert after.pan - before.pan == pytest.approx(0.5 * 20 * half_width, rel=0.15)
    assert (after.tilt - before.tilt) / (after.pan - before.pan) == pytest.approx(-0.5, abs=0.03)
    for _ in range(10):
        env.step(STILL)
    assert not env.episode.rig.head.state().moving
    env.close()


def test_no_residual_is_the_proportional_controller(field):
    told = []
    for action, policy in (("rates", proportional), ("residual", lambda _: STILL)):
        env = FollowV1("bird", action, "yield", rig=field, seconds=1.5)
        told.append([(o.tolist(), r) for o, r, _ in run(env, policy, seed=2)])
        env.close()
    assert told[0] == told[1]
    assert sum(reward for _, reward in told[0]) > 5


def test_absolute_actions_and_yield_do_what_they_do_in_version_0(field):
    told = []
    for make in (Follow, lambda *args, **more: FollowV1(*args, "absolute", "yield", **more)):
        env = make("bird", rig=field, seconds=2.0)
        policy = PipelinePolicy(env)
        told.append([(r, i["box_closeup"].tolist()) for _, r, i in run(env, policy, seed=3)])
        env.close()
    assert told[0] == told[1]


# ---------------------------------------------------------------- rewards
def test_closeness_is_1_for_a_centred_target_of_the_wanted_size_and_falls_to_0():
    assert closeness(0.0, 1.0) == 1.0
    assert closeness(1.0, 1.0) == 0.5
    assert closeness(0.0, 2.0) == pytest.approx(0.5)
    assert closeness(0.0, 0.25) == pytest.approx(1 / 3)
    assert closeness(math.inf, 1.0) == closeness(0.0, 0.0) == 0.0


def test_shaping_adds_the_difference_of_two_potentials_to_the_return(field):
    """The discounted sum less the yield's is gamma^T Phi_T - Phi_0; the episode ends by truncation."""
    gamma, told = 0.97, {}
    for reward in ("yield", "shaped"):
        env = FollowV1("bird", "rates", reward, gamma=gamma, rig=field, seconds=2.0)
        told[reward] = run(env, proportional, seed=1)
        env.close()
    sums = {name: sum(gamma**k * r for k, (_, r, _) in enumerate(steps[1:])) for name, steps in told.items()}
    potentials = [info["potential"] for _, _, info in told["shaped"]]
    ends = gamma ** (len(potentials) - 1) * potentials[-1] - potentials[0]
    assert sums["shaped"] - sums["yield"] == pytest.approx(ends, abs=TELESCOPED)
    assert potentials[-1] > 0.3  # it is not 0 at the truncation
    assert sums["yield"] > 1


@pytest.mark.parametrize("reward", ["dense", "yield"])
def test_wear_costs_the_way_from_command_to_command(field, reward):
    """In absolute actions: pan and tilt over half-widths of 320 px, focal lengths in tenths; worked by hand."""
    rng, wear, told = np.random.default_rng(0), 0.05, []
    actions = rng.uniform(-0.2, 0.2, (20, 3)).astype(np.float32)
    for cost in (0.0, wear):
        env = FollowV1("book", "absolute", reward, wear=cost, rig=field, seconds=2.0)
        env.reset(seed=0)
        told.append([env.step(action)[1] for action in actions])
        units, step_rad = env.units, env.episode.rig.head.limits.pan.step
        env.close()
    commands = [np.array([0.0, 0.0, units.focal_px[0]]), *(np.array(units.command(action)) for action in actions)]
    for k, (before, after) in enumerate(itertools.pairwise(commands)):
        turned = np.abs(after - before)[:2].sum() / (320 / after[2])
        zoomed = abs(math.log(after[2] / before[2])) / 0.1
        # Commands are rounded to steps of the head and to positions of the lens, 0.019 apart in the logarithm.
        rounding = wear * (2 * step_rad / (320 / after[2]) + 0.019 * (turned + 1 / 0.1))
        assert told[0][k] - told[1][k] == pytest.approx(wear * (turned + zoomed), abs=rounding)


def test_a_head_that_stands_does_not_wear(field):
    env = FollowV1("bird", reward="yield", wear=1.0, rig=field, seconds=2.0)
    assert [reward for _, reward, _ in run(env, lambda _: STILL, seed=0)] == [0.0] * 51
    env.close()


def best_actions(rewards, after, gamma, ends):
    """The best actions of each state of a small decision process, by value iteration."""
    values = np.zeros(len(rewards))
    for _ in range(2000):
        q = rewards + gamma * np.where(ends[after], 0.0, values[after])
        values = q.max(axis=1)
    return [set(np.flatnonzero(row > row.max() - 1e-9).tolist()) for row in q]


def test_shaping_keeps_the_best_policies_of_a_small_decision_process():
    """Seven states, three actions, one state that ends; any potential. Without the 0 there, the best policy differs."""
    rng, gamma = np.random.default_rng(0), 0.9
    after, rewards = rng.integers(7, size=(7, 3)), rng.integers(0, 3, size=(7, 3)).astype(float)
    ends, potential = np.arange(7) == 6, np.array([0.0, 3.0, -2.0, 5.0, 1.0, -4.0, 30.0])
    before, later = np.broadcast_to(potential[:, None], (7, 3)), potential[after]
    wanted = best_actions(rewards, after, gamma, ends)[:6]
    assert best_actions(shaped(rewards, gamma, before, later, ends[after]), after, gamma, ends)[:6] == wanted
    assert best_actions(shaped(rewards, gamma, before, later), after, gamma, ends)[:6] != wanted


# ---------------------------------------------------------------- variation
def test_episodes_vary_within_their_ranges_and_options_set_one(field):
    wide = Randomization(delay=1.0, noise=0.0, lens=0.0, pointing_deg=0.5, focal=0.0)
    env, delays, errors = FollowV1("book", rig=field, seconds=1.0, randomize=wide), [], []
    usual = field.sim.head.command_delay_s
    for seed in range(8):
        env.reset(seed=seed)
        delays.append(env.episode.rig.spec.head.delay_s / usual)
        errors.append(math.degrees(env.calibration.zoom_head.axes.pan_zero))
    assert 0.5 <= min(delays) < 0.9
    assert 1.1 < max(delays) <= 2.0
    assert -0.5 <= min(errors) < 0 < max(errors) <= 0.5
    env.reset(seed=0)
    assert env.episode.rig.spec.head.delay_s / usual == delays[0]
    env.reset(seed=0, options={"delay": 1.5, "pan_deg": 0.0, "tilt_deg": 0.0})
    assert env.episode.rig.spec.fixed.latency_s == pytest.approx(1.5 * field.sim.fixed.latency_s)
    assert env.calibration.zoom_head.axes.pan_zero == 0.0
    env.close()


def test_a_calibration_error_moves_the_aim_by_itself(field):
    """A true pan of 1 degree where the head reports 0: the reported pan that points at the target is 1 degree less."""
    pans = []
    for pan_deg in (0.0, 1.0):
        env = FollowV1("book", rig=field, seconds=1.0, noise=NO_NOISE)
        env.reset(seed=0, options={"pan_deg": pan_deg})
        for _ in range(15):
            observation, *_ = env.step(STILL)
        pans.append(env.units.command([named(observation)["pan"], 0, 0])[0])
        env.close()
    assert math.degrees(pans[0] - pans[1]) == pytest.approx(1.0, abs=0.01)


# ---------------------------------------------------------------- a target of one's own
RIG = """
[sim]
effects = { noise = false, jpeg = false, blur = false, multisampling = false }
[sim.models]
dog = "dog.obj"
[sim.paths]
dog = [[0, -3, 12, 1], [10, 3, 13, 1], [20, -3, 12, 1]]
[targets.dog]
size = 0.6
dimension = "height"
wanted_px = 200
"""


def test_a_target_and_a_rig_of_ones_own_by_rig_toml(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    (tmp_path / "dog.obj").write_text(BOX)
    env = gymnasium.make("cotarget.env:cotarget/Follow-v1", target="dog", rig=tmp_path / "rig.toml", seconds=6.0)
    told = run(env, proportional, seed=0)
    assert np.mean([info["good"] for *_, info in told[50:]]) > 0.8
    env.close()


@pytest.mark.parametrize(("make", "named"), [
    (lambda: FollowV1("dragon"), "target: 'dragon'"),
    (lambda: FollowV1(action="jump"), "action: 'jump'"),
    (lambda: FollowV1(reward="praise"), "reward: 'praise'"),
    (lambda: FollowV1(gamma=1.5), "gamma: 1.5"),
    (lambda: FollowV1(wear=-0.1), "wear: -0.1"),
    (lambda: FollowV1(wear="much"), "wear: 'much'"),
    (lambda: FollowV1(randomize=3), "randomize: 3"),
    (lambda: FollowV1(randomize=Randomization(delay=-1.0)), "randomize.delay: -1.0"),
    (lambda: PipelinePolicy(FollowV1()), "env: the pipeline's actions are 'absolute'"),
    (lambda: FollowV1().reset(options={"wind": 3}), "options: {'wind': 3}"),
    (lambda: FollowV1().reset(options={"delay": 0}), "options.delay: 0"),
    (lambda: FollowV1().reset(options={"x_m": math.nan}), "options.x_m: nan"),
])  # fmt: skip
def test_invalid_arguments_are_refused_in_one_line(make, named):
    with pytest.raises(CotargetError) as caught:
        make()
    assert str(caught.value).startswith(named)
    assert "\n" not in str(caught.value)


@pytest.mark.render
def test_both_has_features_and_pictures(field):
    env = FollowV1("bird", observation="both", rig=field, seconds=1.0)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert {name: part.shape for name, part in observation.items()} == {
        "tracks": (14,), "rig": (11,), "wide": (64, 64, 3), "closeup": (64, 64, 3),
    }  # fmt: skip
    env.close()
