"""What is measured in the simulated field: by hand-worked cases, what a target seen well must give, and its scenes."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from matplotlib.figure import Figure

from cotarget.config import parse_config
from cotarget.control.head import HeadSettings
from cotarget.detection import Detections
from cotarget.errors import ConfigError
from cotarget.evaluation import TruthDetector, TruthNoise, true_calibration
from cotarget.geometry import pose
from cotarget.pipeline import FollowSettings
from cotarget.rig import Frame
from cotarget.sim.targets.random_paths import SECONDS
from cotarget.sim.targets.target import marker_of
from cotarget.sim.world import SimWorld
from cotarget.targeting import Reach
from experiments.following import delay, field, first_shot
from experiments.following.field import five_targets_config, hold_config
from experiments.following.first_shot import CAUSES, Shot, budget
from experiments.following.single_ptz import TruthFinder
from experiments.following.wide_view import Seen, WideView, open_on, record
from tests.support.rigs import with_zoom_head

SMALL = 0.03  # relative: products of angles of a hundredth that are taken for sums


def names(texts):
    """What is missed, without the values."""
    return [text.rpartition(": ")[0] for text in texts]


def seen_well(config, target, seconds, *, pictures=False):
    """What `record` gives, of a detector that finds the targets where they are; nothing is rendered."""
    with (world := SimWorld(config, rendered=())).rig:
        detector = TruthDetector(world.truth(), config.sim.seed, TruthNoise(0.2, 0.01, 0.0))
        image = np.zeros((480, 640, 3), np.uint8)
        times = [k / config.sim.fixed.rate_hz for k in range(round(seconds * config.sim.fixed.rate_hz) + 1)]
        frames = {round(t * 1e6): Seen(tuple(detector.detect(Frame(image, t)).boxes)) for t in times}
    return WideView(frames, pictures=False)


@pytest.fixture(scope="module")
def exact():
    return field.calibrated(field.FieldSettings(calibrated=False))


# ---------------------------------------------------------------- the wide view, once
@pytest.mark.render
def test_a_recorded_view_gives_the_same_frames_and_detections():
    config = hold_config("book", 2)
    target = config.target("book")
    view = record(config, target, 0.04)
    late = delay.delayed(config, 0.5)
    with (seen := SimWorld(config)).rig, (world := open_on(view, late, closed_loop=True)[0]).rig:
        detector, again = field.make_detector(target, 25.0), open_on(view, late, closed_loop=False)[1]
        t = None
        for _ in range(2):
            frame, recorded = seen.rig.fixed.read(newer_than=t), world.rig.fixed.read(newer_than=t)
            t = frame.t
            assert recorded.t == t
            np.testing.assert_array_equal(recorded.image, frame.image)
            assert world.rig.clock.now() == pytest.approx(t + 0.3)
            again_found, found = again.detect(recorded), detector.detect(frame)
            for old, new in zip(again_found.boxes, found.boxes, strict=True):
                np.testing.assert_array_equal(old.center_px, new.center_px)
            np.testing.assert_array_equal(again_found.mask, found.mask)
        assert len(again.detect(recorded).boxes) == 1


def test_without_prediction_the_offset_is_speed_times_delay(exact, monkeypatch):
    """1.5 m/s and 0.2 s are 0.3 m, of 1.75 m that are 300 px large: 51 px of 640, and a frame or two more on the way.

    The way across the line of sight is shorter by some cosine.
    """
    monkeypatch.setattr(delay, "record", seen_well)
    settings = delay.DelaySettings(targets=("person",), delays=(delay.FIELD_S,), seconds=5.0, calibrated=False)
    rows = delay.one(settings, 1)
    summary = delay.summarise(rows)
    found = summary["person"]["wide view alone"]["200 ms"]
    behind = 1.5 * 0.2 / 1.75 * 300 / 640
    assert 0.9 * behind < found["without"]["median"] < 1.5 * behind
    assert found["times"] == pytest.approx(found["without"]["median"] / found["with"]["median"])
    assert found["times"] > 1.5
    delay.plot(rows, Figure())


WALKED = 3.0, 5.0  # of a person who walks from 1 s on; nothing is left of how it was acquired [s]
SETTLED = 7.4, 9.0  # who stops at 5 s and is known of 0.6 s later, with a head that was on its way [s]
NO_WORSE = 1.2  # times the wide view's own offset: medians of 50 frames
ZONE = HeadSettings().zone  # the head of who stands is left alone in it
SWING = ZONE / 2  # an offset that goes to and fro beyond it on both sides swings
SEEDS = 1, 7  # of the detector's noise; seen 0.6 s late, they swung 2 and 4 times with a lead by the rate at its end


def offsets_of_who_stops(exact, delay_s, closed_loop, seed=SEEDS[0]):
    """Offsets over the width, (n, 2), of one who walks past 10 m away at 1.5 m/s and stops, while walking and after.

    Nothing is rendered: both views show the person where it is, with noise.
    """
    config = delay.delayed(hold_config("person", 0), delay_s)
    path = [(t, -3.0 + 1.5 * float(np.clip(t - 1.0, 0.0, 4.0)), 10.0, 0.875) for t in np.arange(-1.0, 12.0, 0.1)]
    config = dataclasses.replace(config, sim=dataclasses.replace(config.sim, paths={"person": tuple(path)}))
    world = SimWorld(config, rendered=())
    truth = world.truth()
    detector = TruthDetector(truth, seed, TruthNoise(0.5, 0.04, 0.05))
    how = FollowSettings(
        closed_loop=closed_loop, finder=lambda calibration, target: TruthFinder(calibration, target, truth, "person", 0)
    )
    target, end = config.target("person"), SETTLED[1]
    steps = [step for step, _ in field.watched_in(world, detector, exact, target, end, how)]
    t = np.array([step.zoom.t for step in steps])
    off = np.array([truth.pixel("zoom", truth.center("person", each), each) - (319.5, 239.5) for each in t]) / 640
    walking, after = ((t > begin) & (t < end) for begin, end in (WALKED, SETTLED))
    found = np.array([step.found is not None for step in steps])
    assert found[walking].mean() > 0.5 if closed_loop else not found.any()
    return off[walking], off[after]


def swings(values):
    """How often a signal goes from beyond SWING on one side to beyond it on the other."""
    sides = np.sign(values[np.abs(values) > SWING])
    return int(np.count_nonzero(np.diff(sides)))


@pytest.mark.parametrize("delay_s", [*(pytest.param(delay, marks=pytest.mark.slow) for delay in (0.2, 0.4)), 0.6])
def test_the_whole_loop_does_not_oscillate_however_late_it_is(exact, delay_s):
    """Corrections that come late add nothing to the offset of who walks, and come to rest when that stops."""
    wide, _ = offsets_of_who_stops(exact, delay_s, closed_loop=False)
    alone = float(np.median(np.linalg.norm(wide, axis=1)))
    for seed in SEEDS:
        walking, after = offsets_of_who_stops(exact, delay_s, closed_loop=True, seed=seed)
        assert float(np.median(np.linalg.norm(walking, axis=1))) < NO_WORSE * alone
        assert np.linalg.norm(after, axis=1).max() < ZONE
        assert [swings(axis) for axis in after.T] == [0, 0]


@pytest.mark.slow
def test_the_head_swings_with_no_seed_seen_late(exact):
    """Eight seeds of the detector's noise."""
    ends = [offsets_of_who_stops(exact, 0.6, closed_loop=True, seed=seed)[1] for seed in range(8)]
    assert [swings(axis) for after in ends for axis in after.T] == [0] * 2 * len(ends)
    assert max(np.linalg.norm(after, axis=1).max() for after in ends) < ZONE


# ---------------------------------------------------------------- first shot
@pytest.fixture(scope="module")
def still():
    """A book 10 m ahead, the zoom camera 0.4 m to the right, all effects off: a head that turns about its lens."""
    home = {"translation": [0, 0, 0], "rotvec_deg": [0, 0, 0]}
    sim = {
        "scene": "indoor",
        "targets": ["book"],
        "effects": {"all": False},
        "T_zoom0_fixed": home | {"translation": [-0.4, 0, 0]},
        "T_head_zoom": home,
        "paths": {"book": [[0, 0, 10, 1.6], [9, 0, 10, 1.6]]},
    }
    return SimWorld(parse_config({"sim": sim}), rendered=())


def test_each_cause_alone(still):
    truth, exact = still.truth(), true_calibration(still, stops=2)
    shortest = still.rig.zoom.focal_range[0]
    reach = Reach((-2.7, 2.7), (-0.8, 0.5), still.rig.zoom.focal_range)
    at = truth.pixel("fixed", truth.center("book", 0.0), 0.0)
    perfect = Shot(0.0, 1.0, at, 10.0, np.zeros(3), 2 * shortest, 0.0, 0.0, 2 * shortest)

    def parts(calibration=exact, step=0.0, **changes):
        shot = dataclasses.replace(perfect, **changes)
        return budget(truth, exact, calibration, dataclasses.replace(reach, steps=(step, step)), "book", shot)

    assert tuple(parts()) == CAUSES
    assert parts() == pytest.approx(dict.fromkeys(CAUSES, 0.0), abs=1e-7)

    def alone(cause, found):
        assert {key: value for key, value in found.items() if key != cause} == pytest.approx(
            {key: 0.0 for key in CAUSES if key != cause}, abs=1e-7
        )
        return found[cause]

    away = math.hypot(10, 0.4)
    off = alone("detection", parts(pixel=at + np.array([3.0, 4.0])))
    assert off == pytest.approx(math.hypot(30 / 686, 40 / 684) / away, rel=SMALL)
    assert alone("size", parts(depth=12.0)) == pytest.approx(math.atan(0.4 / 10) - math.atan(0.4 / 12), rel=SMALL)
    assert alone("delay", parts(moved=np.array([0.0, 0.1, 0.0]))) == pytest.approx(0.1 / away, rel=SMALL)
    longer = parts(moved=np.array([0.0, 0.1, 0.0]), depth=12.0)["delay"]
    assert longer == pytest.approx(0.1 * 10 / 12 / away, rel=SMALL)
    turned = with_zoom_head(exact, T_zoom0_fixed=pose([0, 0, 0], [0, 0.1, 0]) * exact.zoom_head.T_zoom0_fixed)
    assert alone("calibration", parts(turned)) == pytest.approx(math.radians(0.1), rel=SMALL)
    # The middle of the image is 6.5 and 4.5 px beside the principal point, at 1384 and 2768 px.
    lens = alone("lens", parts(nominal_px=4 * shortest))
    assert lens == pytest.approx(math.hypot(6.5, 4.5) * (1 / 1384 - 1 / 2768), rel=SMALL)
    # Pan is -0.04 less 6.5 px of 1384, tilt is 4.5 px; to the nearest 0.03.
    pan, tilt = -math.atan(0.04) + 6.5 / 1384, 4.5 / 1386
    steps = alone("steps", parts(step=0.03))
    assert steps == pytest.approx(math.hypot(pan + 0.03, tilt), rel=0.2)


def test_a_shot_is_skipped_while_the_target_is_not_detected(exact, monkeypatch):
    """Chances come at 3.0, 3.8, 4.6 and 5.4 s, and from 4.3 s on nothing is detected any more."""

    class Blinded(TruthDetector):
        def detect(self, frame, held=()):
            return super().detect(frame) if frame.t < 4.3 else Detections([])

    config = hold_config("book", 1)
    with (world := SimWorld(config, rendered=())).rig:
        finder = Blinded(world.truth(), 1, TruthNoise(0.2, 0.01, 0.0))
        monkeypatch.setattr(first_shot, "make_detector", lambda *_: finder)
        monkeypatch.setattr(first_shot, "SimWorld", lambda config: SimWorld(config, rendered=()))
        settings = first_shot.FirstShotSettings(targets=("book",), seconds=5.9, calibrated=False)
        rows = first_shot.one(settings, 1)
    assert [row["fired"] for row in rows] == [True, True, False, False]
    figures = first_shot.summarise(rows)["book"]
    assert (figures["shots"], figures["not fired"]) == (2, 2)
    blind = first_shot.summarise([row for row in rows if not row["fired"]])["book"]
    assert (blind["shots"], blind["not fired"]) == (0, 2)
    assert set(names(first_shot.missed({"book": blind}))) == {f"book: {key}" for key in first_shot.WANTED}


def test_a_budget_is_summed_in_quadrature_over_shots_at_the_target():
    shot = {"seed": 0, "target": "book", "fired": True, "on_target": True, "in_frame": True, "tpo_width": 0.05}
    shot |= {"found": True, "corrected_width": 0.01, "measured": 0.05} | dict.fromkeys(CAUSES, 0.0)
    hit, none = shot | {"detection": 0.03, "size": 0.04}, shot | {"corrected_width": None}
    elsewhere = hit | {"seed": 1, "on_target": False, "in_frame": False, "measured": 4.0, "detection": 4.0}
    figures = first_shot.summarise([hit, hit, elsewhere])["book"]
    assert (figures["sum"], figures["measured"], figures["in_frame"]) == pytest.approx((0.05, 0.05, 2 / 3))
    assert figures[first_shot.SEEDS]["in_frame"] == {"median": 0.5, "least": 0.0, "largest": 1.0}
    # A correction that could not be fired counts as one that missed.
    assert first_shot.summarise([hit, none, none])["book"]["corrected_width"] == math.inf


SEEDS = (0, 1, 2, 100, 101)
STEP = 0.04
TIMES = np.arange(0.0, SECONDS + STEP / 2, STEP)
MOUNT = np.array([0.0, 0.0, 1.6])
SAMPLING = 0.02  # relative: speeds and radii from differences of samples


def blind(config):
    return SimWorld(config, rendered=())


def track(name, seed):
    with (w := blind(hold_config(name, seed))).rig:
        truth = w.truth()
        return np.array([truth.center(name, t) for t in TIMES]), truth


def seen_wholly(truth, name, times):
    """Whether the whole target is within the wide picture, at each time."""
    boxes = [truth.box(name, "fixed", t) for t in times]
    return np.array([b is not None and (b[0] > -0.5).all() and (b[1] < [639.5, 479.5]).all() for b in boxes])


def speeds(x):
    return np.linalg.norm(np.diff(x, axis=0), axis=1) / STEP


def test_the_book_is_put_elsewhere_once():
    for seed in SEEDS:
        x, truth = track("book", seed)
        distance = np.linalg.norm(x - MOUNT, axis=1)
        assert distance.min() > 9.5
        assert distance.max() < 10.5
        moving = speeds(x) > 0.05  # the spline through the knots trembles less than that
        assert np.count_nonzero(np.diff(moving.astype(int))) == 2  # sets out once, arrives once
        assert 0.8 < moving.sum() * STEP < 1.7
        assert 1.4 < np.linalg.norm(x[-1] - x[0]) < 4.1
        assert seen_wholly(truth, "book", TIMES[::10]).all()


def test_the_bird_flies_fast_wide_turns_and_stays_in_view():
    for seed in SEEDS:
        x, truth = track("bird", seed)
        v, a = np.gradient(x, STEP, axis=0), np.gradient(np.gradient(x, STEP, axis=0), STEP, axis=0)
        speed = np.linalg.norm(v, axis=1)
        assert (np.abs(speed[2:-2] / 10 - 1) <= 0.2).all()
        radius = speed**3 / np.maximum(np.linalg.norm(np.cross(v, a), axis=1), 1e-9)
        assert radius[3:-3].min() > 10 * (1 - SAMPLING)
        assert seen_wholly(truth, "bird", TIMES).all()
        distance = np.linalg.norm(x - MOUNT, axis=1)
        assert np.mean(x[:, 1]) == pytest.approx(25, abs=4)  # rounds of 10 m are not over in 20 s
        assert np.median(distance) == pytest.approx(26, abs=5)
        assert distance.min() > 14
        assert distance.max() < 39
        assert abs(truth.targets["bird"].size - 1) <= 0.15


@pytest.mark.parametrize("kind", [pytest.param("person", marks=pytest.mark.slow), "bird"])
def test_five_at_once_cross_and_are_told_apart(kind):
    for seed in SEEDS[:3]:
        config = five_targets_config(seed, kind)
        names = config.sim.targets
        assert names == (kind, *(f"{kind}{i}" for i in range(2, 6)))
        assert len({marker_of(name) for name in names}) == 5
        with (w := blind(config)).rig:
            truth = w.truth()
            seen = np.array([seen_wholly(truth, name, TIMES[::5]) for name in names])
            x = np.array([[truth.center(name, t) for t in TIMES[::5]] for name in names])
        assert (seen.sum(axis=0) == 5).sum() * 5 * STEP > 0.5  # all at once for a while
        assert (seen.sum(axis=1) * 5 * STEP > 2.0).all()  # each long enough for a close-up
        assert not seen[:, TIMES[::5] < 1.0].any()
        assert not seen[:, -1].all()
        across = x[:, :, 0] / x[:, :, 1]
        swapped = [(np.diff(np.sign(across[i] - across[j])) != 0).any() for i, j in itertools.combinations(range(5), 2)]
        assert sum(swapped) >= 4  # lines of sight cross


def test_other_names_are_refused():
    with pytest.raises(ConfigError, match="the scenes to hold are: bird, book, person"):
        hold_config("dragon", 0)
    with pytest.raises(ConfigError, match="five at once there are of: bird, person"):
        five_targets_config(0, "book")
