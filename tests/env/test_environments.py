"""The gymnasium environments: spaces, seeds, what they take, show and refuse, and rigs of one's own in them."""

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
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from cotarget.config import RigConfig, SafetyConfig
from cotarget.detection import Detections
from cotarget.env import FOLLOW, SCHEDULE, Follow, PipelinePolicy, Schedule, SchedulingPolicy
from cotarget.env.common import DEFAULT_RIG, RIG_FEATURES
from cotarget.env.follow import TRACK_FEATURES
from cotarget.env.schedule import SLOTS
from cotarget.errors import ConfigError, CotargetError
from cotarget.evaluation import TruthNoise
from tests.support.env_episodes import FIELD, FRAME_S, run, uncollected

NO_NOISE = TruthNoise(center_px=0.0, size=0.0, miss=0.0)
STILL = np.zeros(3, np.float32)
TRACK, RIG = list(TRACK_FEATURES), list(RIG_FEATURES)
# Without noise the filter is as far off as limbs move a box's edges: a part of the picture; relative, of the median.
PLACE, WIDTH, HEIGHT = 0.01, 0.5, 0.05


def named(observation):
    """The numbers of a track observation by name."""
    return dict(zip(TRACK + RIG, observation.tolist(), strict=True))


# ---------------------------------------------------------------- gymnasium's own checks
@pytest.mark.parametrize("make", [Follow, Schedule])
def test_tracks_pass_the_checker(field, make):
    env = make("bird", rig=field, seconds=2.0)
    check_env(env, skip_render_check=True)
    env.close()


def test_both_are_registered():
    for name, kind in ((FOLLOW, Follow), (SCHEDULE, Schedule)):
        env = gymnasium.make(name, seconds=1.0)
        assert isinstance(env.unwrapped, kind)
        env.close()
    env = gymnasium.make("cotarget.env:cotarget/Follow-v0", target="book", seconds=0.2)
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]
    env.close()


def flat(observation, *index):
    """All numbers of an observation, or of one of those of a vector of environments."""
    parts = [observation[key] for key in sorted(observation)] if isinstance(observation, dict) else [observation]
    return np.concatenate([np.ravel(each[index]).astype(float) for each in parts])


def make_book():
    return gymnasium.make(f"cotarget.env:{FOLLOW}", target="book", seconds=1.0)  # a spawned process knows no more


def in_vector(vector, seconds, action=STILL):
    """What the first and the second of two environments tell: observations, rewards, and boxes in the fixed image."""
    observations, infos = vector.reset(seed=[7, 8])
    told = [(observations, np.zeros(2), infos)]
    for _ in range(round(seconds / FRAME_S)):
        observations, rewards, _, _, infos = vector.step(np.stack([action, action]))
        told.append((observations, rewards, infos))
    vector.close()
    return [[(flat(o, i).tolist(), r[i], n["box_wide"][i].tolist()) for o, r, n in told] for i in (0, 1)]


@pytest.mark.parametrize("opened", [
    SyncVectorEnv,
    pytest.param(lambda makers: AsyncVectorEnv(makers, context="spawn"), marks=pytest.mark.slow),
    pytest.param(lambda makers: AsyncVectorEnv(makers, context="forkserver"), marks=pytest.mark.slow),
], ids=["sync", "spawn", "forkserver"])  # fmt: skip
def test_an_environment_in_a_vector_does_what_it_does_alone(opened):
    first, second = in_vector(opened([make_book] * 2), seconds=0.4)
    assert first == [
        (flat(o).tolist(), r, i["box_wide"].tolist()) for o, r, i in run(make_book(), lambda _: STILL, 7, 0.4)
    ]
    assert first[-1] != second[-1]


# ---------------------------------------------------------------- seeds
@pytest.mark.parametrize("make", [Follow, Schedule])
def test_the_same_seed_gives_the_same_episode_and_no_seed_a_different_one(field, make):
    env = make("bird", rig=field, seconds=1.0)
    env.action_space.seed(1)
    actions = [env.action_space.sample() for _ in range(20)]

    def told(**seed):
        observation, info = env.reset(**seed)
        steps = [env.step(action) for action in actions]
        arrays = [flat(each) for each in (observation, *(step[0] for step in steps))]
        return np.array(arrays), [s[1] for s in steps], info["direction"]

    first, again, other, another = told(seed=3), told(seed=3), told(), told()
    np.testing.assert_array_equal(first[0], again[0])
    assert first[1] == again[1]
    directions = [np.ravel(each[2]) for each in (first, other, another)]
    for i, j in ((0, 1), (1, 2), (0, 2)):
        assert np.abs(directions[i] - directions[j]).max() > 1e-3
    repeated = told(seed=3), told()
    np.testing.assert_array_equal(repeated[1][2], other[2])  # what follows a seed is told by it, too
    env.close()


def test_head_and_lens_go_where_the_action_says(field):
    env = Follow("book", rig=field, seconds=3.0)
    env.reset(seed=0)
    action = np.array([0.1, -0.2, 0.5], np.float32)
    for _ in range(70):
        observation, *_ = env.step(action)
    told, limits, lens = named(observation), env.episode.rig.head.limits, env.episode.rig.zoom
    state = env.episode.rig.head.state()
    assert state.pan == pytest.approx(0.1 * limits.pan.range[1], abs=limits.pan.step)  # its range is symmetric
    assert state.tilt == pytest.approx(limits.tilt.range[0] + 0.4 * np.ptp(limits.tilt.range), abs=limits.pan.step)
    shortest, longest = lens.focal_range
    assert lens.state().focal_px == pytest.approx(shortest**0.25 * longest**0.75, rel=0.02)  # a lens of 129 positions
    for name, wanted in zip(("pan", "tilt", "focal"), action, strict=True):
        assert told[name] == told[f"{name}_commanded"] == pytest.approx(wanted, abs=0.01)
    assert (told["head_moves"], told["lens_moves"]) == (0.0, 0.0)
    assert told["age_s"] == told["closeup_age_s"] == pytest.approx(0.06)  # the default latency
    assert told["gone"] == pytest.approx(70 / 75)
    env.close()


def test_track_features_follow_the_true_box(field):
    """Without noise: where the truth is, as large, and as fast as the box has moved in the last half second."""
    env = Follow("person", rig=field, seconds=5.0, noise=NO_NOISE)
    told = run(env, lambda _: STILL, seed=1)
    width, height = env.config.sim.fixed.size
    assert not any(named(told[0][0])[name] for name in TRACK)  # nobody is there yet
    (observation, _, info), (_, _, before) = told[-1], told[-1 - 12]
    track, (left, top, right, bottom) = named(observation), info["box_wide"]
    assert (track["known"], track["detected"], track["unseen_s"]) == (1.0, 1.0, 0.0)
    assert track["u"] == pytest.approx((left + right + 1) / width - 1, abs=2 * PLACE)
    assert track["v"] == pytest.approx((top + bottom + 1) / height - 1, abs=2 * PLACE)
    assert track["width"] == pytest.approx((right - left) / width, rel=WIDTH)
    assert track["height"] == pytest.approx((bottom - top) / height, rel=HEIGHT)
    assert track["larger_side"] == pytest.approx((bottom - top) / width, rel=HEIGHT)
    assert 0.9 < track["confidence"] < 1.0
    moved = np.mean((info["box_wide"] - before["box_wide"]).reshape(2, 2), axis=0) / (12 * FRAME_S)
    assert abs(moved[0]) > 20.0  # px/s: it walks
    assert track["du"] == pytest.approx(2 * moved[0] / width, rel=0.3)
    assert track["dv"] == pytest.approx(2 * moved[1] / height, abs=0.05)
    env.close()


def test_a_target_that_is_missed_is_still_known_for_a_while(field):
    env = Follow("book", rig=field, seconds=2.0, noise=NO_NOISE)
    env.reset(seed=0)
    for _ in range(20):
        observation, *_ = env.step(STILL)
    sure = named(observation)
    env.episode.detector.detect = lambda frame: Detections([])
    for k in range(1, 4):
        unseen = named(env.step(STILL)[0])
        assert (unseen["known"], unseen["detected"]) == (1.0, 0.0)
        assert unseen["unseen_s"] == pytest.approx(k * FRAME_S)
        assert unseen["confidence"] < sure["confidence"]
    env.close()


class Shrunk:
    """The truth of targets so many times as large."""

    def __init__(self, outlines, factor):
        self.outlines, self.factor = outlines, factor

    def __getattr__(self, name):
        return getattr(self.outlines, name)

    def box(self, *asked):
        low, high = self.outlines.box(*asked)
        middle = (low + high) / 2
        return middle + self.factor * (low - middle), middle + self.factor * (high - middle)


@pytest.mark.parametrize(("make", "name", "action", "steps"), [
    (Follow, "book", STILL, 20), (Schedule, "bird", 0, 70),
])  # fmt: skip
def test_the_truth_is_in_info_alone(field, make, name, action, steps):
    """The same detections of another true size: the same observations, and another truth."""
    told = []
    for factor in (1.0, 0.7):
        env = make(name, rig=field, seconds=4.0)
        env.reset(seed=4)
        env.episode.outlines = Shrunk(env.episode.outlines, factor)
        told.append([env.step(action) for _ in range(steps)])
        env.close()
    for one, other in zip(*told, strict=True):
        np.testing.assert_array_equal(flat(one[0]), flat(other[0]))
        boxes = [each[4]["box_wide"].reshape(-1, 2, 2) for each in (one, other)]
        sizes = [box[:, 1] - box[:, 0] for box in boxes]
        assert sizes[1] == pytest.approx(0.7 * sizes[0])
    assert (one[0]["tracks"] if make is Schedule else one[0]).any()


# ---------------------------------------------------------------- what is refused
@pytest.mark.parametrize(("make", "named"), [
    (lambda: Follow("dragon"), "target: 'dragon'"),
    (lambda: Schedule("book"), "kind: 'book'"),
    (lambda: Follow(observation="smell"), "observation: 'smell'"),
    (lambda: Follow(render_mode="human"), "render_mode: 'human'"),
    *((lambda given=given: Follow(seconds=given), f"seconds: {given!r}") for given in (21, 0.0, math.nan, "5")),
    *((lambda given=given: Follow(image_size=given), f"image_size: {given!r}") for given in ((4, 64), 64, (6.4, 64))),
    (lambda: Follow(rig="nothing.toml"), "nothing.toml: "),
    (lambda: Follow(rig=RigConfig(backend="hardware")), "rig: its backend is 'hardware'"),
    (lambda: Follow(rig=3), "rig: 3"),
    (lambda: Follow(calibration=3), "calibration: 3"),
    (lambda: Follow(calibration="nothing.json"), "nothing.json: "),
    (lambda: Follow(noise=0.5), "noise: 0.5"),
    (lambda: Schedule(served_reward=math.inf), "served_reward: inf"),
    (lambda: PipelinePolicy(Schedule()), "env: "),
    (lambda: SchedulingPolicy(Follow()), "env: "),
    (lambda: SchedulingPolicy(Schedule(), "best"), "policy: 'best'"),
    *((lambda given=given: Follow().reset(options=given), f"options: {given!r}") for given in ({"wind": 3}, 3)),
])  # fmt: skip
def test_invalid_arguments_are_refused_in_one_line(make, named):
    with pytest.raises(CotargetError) as caught:
        make()
    assert str(caught.value).startswith(named)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("make", "good", "wrong"), [
    (lambda field: Follow("book", rig=field, seconds=1.0), STILL,
     [[0.0, 0.0], [0.0, math.nan, 0.0], [[0.0, 0.0, 0.0]], np.zeros((40, 40)), "left", None, [[1], [2, 3]]]),
    (lambda field: Schedule("bird", rig=field, seconds=1.0), 0,
     [SLOTS, -1, 0.5, math.nan, np.zeros((40, 40)), "first", None]),
], ids=["follow", "schedule"])  # fmt: skip
def test_invalid_actions_are_refused(field, make, good, wrong):
    env = make(field)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(good)
    env.reset(seed=0)
    for action in wrong:
        with pytest.raises(ConfigError) as caught:
            env.step(action)
        assert str(caught.value).startswith("action: ")
        assert "\n" not in str(caught.value)
    env.close()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(good)


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
