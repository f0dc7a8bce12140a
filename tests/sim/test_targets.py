"""The simulated targets: their paths, gaits and sizes, and the models that carry them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cotarget.sim.render.opengl import mujoco
from cotarget.sim.targets import KINDS
from cotarget.sim.targets.models import kind_model, scale_spec
from cotarget.sim.targets.paths import MOUNT
from cotarget.sim.targets.target import make_target

ROUNDING = 1e-9  # of sums of floats
SEEDS = range(3)
SECONDS = np.arange(0.0, 40.0, 0.1)
HALF_WIDTH, HALF_HEIGHT = 25.0, 19.0  # the wide view [degrees]
MARGIN = 4.0  # kept to the view's border [degrees]
ENTERING = 1.5  # from crossing the border until the margin is kept [s]
PITCH = {"indoor": 0.0, "outdoor": 9.0}  # of the mount in the scenes [degrees]
DIMENSION = {"book": (1, 0.234), "person": (2, 1.75), "bird": (1, 0.8)}  # axis, size [m]
SIZE_TOLERANCE = 0.01  # relative; what the pipeline is told is good to this
CASES = [(name, scene) for name in KINDS for scene in PITCH]


def bearings(points, scene):
    """Horizontal and vertical angle from the mount's axis [degrees]."""
    x, y, z = np.moveaxis(points - MOUNT, -1, 0)
    c, s = np.cos(np.radians(PITCH[scene])), np.sin(np.radians(PITCH[scene]))
    ahead, up = c * y + s * z, c * z - s * y
    return np.degrees(np.arctan2(x, ahead)), np.degrees(np.arctan2(up, ahead))


def positions(target):
    return np.array([target.pose(t).position for t in SECONDS])


def make(name, scene="indoor", seed=0, scatter=False, waypoints=None):
    return make_target(name, scene, np.random.default_rng(seed), scatter, waypoints)


def extents(spec):
    """Size of a model's bounding box along x, y, z, at zero angles, from the vertices themselves."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    points = []
    for g in range(model.ngeom):
        R, p = data.geom_xmat[g].reshape(3, 3), data.geom_xpos[g]
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[g]
            start = model.mesh_vertadr[mesh]
            local = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
        else:
            signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
            local = signs * model.geom_aabb[g, 3:]
        points.append(local @ R.T + p)
    points = np.concatenate(points)
    return points.min(axis=0), points.max(axis=0)


@pytest.mark.parametrize(("name", "scene"), CASES)
def test_targets_enter_after_the_background_is_learnt_and_stay(name, scene):
    for seed in SEEDS:
        points = positions(make(name, scene, seed))
        across, up = bearings(points, scene)
        if name == "book":
            entered = 0.0
        else:
            assert np.all(np.abs(across[SECONDS < 2.0]) > HALF_WIDTH + MARGIN)
            entered = SECONDS[np.abs(across) < HALF_WIDTH][0]
            assert 2.0 < entered < 3.5
            entered += ENTERING
        inside = entered <= SECONDS
        assert np.all(np.abs(across[inside]) < HALF_WIDTH - MARGIN)
        assert np.all(np.abs(up[inside]) < HALF_HEIGHT - MARGIN)


@pytest.mark.parametrize(
    ("name", "scene", "low", "high"),
    [("book", "indoor", 0.2, 0.3), ("person", "indoor", 1.35, 1.65), ("bird", "outdoor", 4.5, 5.5)],
)
def test_moves_at_its_own_speed(name, scene, low, high):
    for seed in SEEDS:
        path = make(name, scene, seed).path
        speed = np.array([np.linalg.norm(path.motion(t)[1]) for t in SECONDS])
        assert low < speed.min()
        assert speed.max() < high


@pytest.mark.parametrize("where", ["the beginning", "where the lap begins anew"])
@pytest.mark.parametrize(("name", "scene"), CASES)
def test_motion_is_smooth(name, scene, where):
    target = make(name, scene)
    step = 0.01
    times = np.arange(0.0, 12.0, step) + (target.path.lap[1] - 6.0 if where != "the beginning" else 0.0)
    poses = [target.pose(t) for t in times]
    acceleration = np.diff([p.position for p in poses], 2, axis=0) / step**2
    assert np.abs(acceleration).max() < 12.0  # 5 m/s round 2.5 m takes 10 m/s^2
    turned = Rotation.concatenate([p.rotation for p in poses])
    turn = (turned[:-1].inv() * turned[1:]).magnitude()
    assert np.max(turn) / step < 4.0  # rad/s: no jump of heading or bank
    for joint in poses[0].joints:
        swing = np.diff([p.joints[joint] for p in poses], 2) / step**2
        assert np.abs(swing).max() < 600.0  # 35 degrees at 4 Hz take 386 rad/s^2


@pytest.mark.parametrize(("name", "scene"), CASES)
def test_loops_repeat_for_ever(name, scene):
    path = make(name, scene).path
    begin, end = path.lap
    for t in (begin + 1.0, begin + 0.7 * (end - begin)):
        days_later = t + 5000 * (end - begin)
        np.testing.assert_allclose(path.position(days_later), path.position(t), atol=1e-6)
        np.testing.assert_allclose(path.motion(days_later)[1], path.motion(t)[1], atol=1e-6)
        laps = (path.travelled(days_later) - path.travelled(t)) / (path.travelled(end) - path.travelled(begin))
        assert laps == pytest.approx(5000)
        assert np.linalg.norm(path.motion(days_later)[1]) > 0.1  # [m/s]; the book is the slowest


@pytest.mark.parametrize(("name", "scene"), CASES)
def test_same_seed_same_path(name, scene):
    first, again, other = make(name, scene, 7), make(name, scene, 7), make(name, scene, 8)
    scattered = make(name, scene, 7, scatter=True)
    assert np.array_equal(positions(first), positions(again))
    assert first.pose(9.3).joints == again.pose(9.3).joints
    assert not np.allclose(positions(first), positions(other))
    assert np.array_equal(first.path.position(8.0), scattered.path.position(8.0))


@pytest.mark.parametrize(("name", "most"), [("book", 0.0), ("person", 0.041), ("bird", 0.151)])
def test_sizes_scatter_within_bounds(name, most):
    sizes = np.array([make(name, seed=seed, scatter=True).size for seed in range(30)])
    assert np.abs(sizes - 1).max() <= most
    assert sizes.std() >= 0.3 * most
    assert make(name, scatter=False).size == 1.0


def test_walker_looks_where_it_goes_and_keeps_its_feet_on_the_ground():
    target = make("person")
    model = kind_model("person").compile()
    data = mujoco.MjData(model)
    for t in np.arange(4.0, 6.0, 0.05):
        pose = target.pose(t)
        forward = pose.rotation.apply([1.0, 0.0, 0.0])
        velocity = target.path.motion(t)[1]
        assert forward @ velocity > 0.999 * np.linalg.norm(velocity)
        for joint, angle in pose.joints.items():
            data.qpos[model.joint(joint).qposadr[0]] = angle
        mujoco.mj_kinematics(model, data)
        shoes = [
            data.geom(g).xpos[2] for g in range(model.ngeom) if model.geom_matid[g] == model.material("person_shoe").id
        ]
        standing = -0.875 + 0.04  # a shoe's middle is some 4 cm above its sole
        assert abs(pose.position[2] + min(shoes) - (0.875 + standing)) < 0.05


def test_wings_beat_four_times_a_second():
    target = make("bird", "outdoor")
    times = np.arange(0.0, 2.0, 0.002)
    angle = np.array([target.pose(t).joints["wing_inner_left"] for t in times])
    ups = np.sum((angle[:-1] < angle.mean()) & (angle[1:] >= angle.mean()))
    assert ups in (8, 9) if abs(angle[0] - angle.mean()) < 0.02 else ups == 8
    assert np.degrees(np.ptp(angle)) == pytest.approx(70.0, abs=0.5)
    assert target.kind.beat_s == 0.25


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("factor", [1.0, 1.12])
def test_model_has_the_size_that_it_claims_and_the_joints_that_move(name, factor):
    spec = kind_model(name)
    assert {joint.name for joint in spec.joints} == set(make(name).pose(0.0).joints)
    scale_spec(spec, factor)
    low, high = extents(spec)
    axis, size = DIMENSION[name]
    assert (high - low)[axis] == pytest.approx(size * factor, rel=SIZE_TOLERANCE)
    assert (high + low)[axis] == pytest.approx(0.0, abs=SIZE_TOLERANCE * size)  # the origin is its middle


def test_waypoints_replace_the_path():
    way = ((1.0, -2.0, 8.0, 1.0), (3.0, 0.0, 9.0, 1.5), (6.0, 2.0, 8.0, 1.0))
    for name in KINDS:
        target = make(name, waypoints=way)
        assert target.path.position(3.0) == pytest.approx([0.0, 9.0, 1.5])
        assert target.path.position(-5.0) == pytest.approx(way[0][1:])
        assert target.path.position(50.0) == pytest.approx(way[-1][1:])
        assert np.isfinite(target.pose(50.0).rotation.as_matrix()).all()
    held = make("person", waypoints=((0.0, 0.0, 8.0, 0.9), (9.0, 0.0, 8.0, 0.9))).pose(3.0)
    assert held.position[:2] == pytest.approx([0.0, 8.0])
    assert held.rotation.apply([1.0, 0.0, 0.0]) == pytest.approx([0.0, -1.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("waypoints", [None, [[5, 1, 9, 2], [6, 2, 9, 3], [8, 2, 7, 2]]], ids=["loop", "waypoints"])
def test_a_paths_motion_is_that_of_its_spline(waypoints):
    path = make("bird", "outdoor", waypoints=waypoints).path
    for t in (-1.0, 5.0, 5.001, 5.004, 7.996, 8.0, *SECONDS, 700.3):
        at, inside = path.within(t), 1e-3 * (path.spline.x[-1] - path.spline.x[0])
        x, v, a = path.motion(t)
        assert (x, a) == (pytest.approx(path.spline(at)), pytest.approx(path.spline(at, 2), abs=ROUNDING))
        just_inside = np.clip(at, path.spline.x[0] + inside, path.spline.x[-1] - inside)
        assert v == pytest.approx(path.spline(just_inside, 1), abs=ROUNDING)
