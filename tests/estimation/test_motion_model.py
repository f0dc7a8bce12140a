"""Motion and sight lines against written-out matrices, closed forms and numeric derivatives."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from cotarget.camera import ZoomLens
from cotarget.estimation.measurement_model import SightLines
from cotarget.estimation.motion_model import MOTIONS, STATES, MotionSettings, propagate
from experiments.calibration.synthetic.rig import NOMINAL_PX, Truth
from tests.support.moving_targets import calibration_of
from tests.support.rigs import with_zoom_head

EXACT = 1e-9  # double precision through a dozen operations
DIFFERENCE = 1e-6
# Central differences of that width err by its square, and by rounding over it, times second derivatives of some units.
DERIVATIVE = 1e-6
SPLIT = 0.15  # relative difference of variances after one prediction and after two, of a person over half a second
WHITE_JERK = 0.03  # white jerk in place of Singer's decay is off by dt / tau, which is 0.03 at most
ZERO = np.zeros((STATES, STATES))


def jacobian(function, at):
    """Numeric derivative of a function of a vector."""
    steps = DIFFERENCE * np.eye(len(at))
    return np.stack([(function(at + step) - function(at - step)) / (2 * DIFFERENCE) for step in steps], axis=1)


def state(**components):
    """A state at rest, straight ahead at 1 m, but for the first components given as lists."""
    x = np.zeros(STATES)
    for first, values in components.items():
        i = {"position": 0, "velocity": 3, "acceleration": 6}[first]
        x[i : i + 3] = values
    return x


def test_a_sight_line_is_that_of_written_out_matrices():
    truth = Truth(pan_scale=1.001, tilt_scale=0.998)
    sight = SightLines(calibration_of(truth)).at(0.4, 0.2, NOMINAL_PX)

    def in_zoom(at):
        a, b, log_depth, pan, tilt = at
        x_fixed = np.array([a, b, 1.0]) * math.exp(log_depth)
        return truth.in_zoom(x_fixed, *truth.stands(np.array([0.4 + pan, 0.2 + tilt])))

    at = np.array([0.3, -0.1, math.log(9.0), 0.0, 0.0])
    tangent, J, d = sight.project(state(position=at[:3]))
    np.testing.assert_allclose(d * 9.0, in_zoom(at), atol=EXACT)
    np.testing.assert_allclose(tangent, d[:2] / d[2], atol=EXACT)
    np.testing.assert_allclose(J, jacobian(lambda at: in_zoom(at)[:2] / in_zoom(at)[2], at), atol=DERIVATIVE)


def test_a_sight_line_starts_at_the_entrance_pupil():
    """A lens whose pupil moves forward by 0.2 m sees the same direction less 0.2 m along its own z."""
    truth, forward = Truth(), 0.2
    still = calibration_of(truth)
    lens = still.zoom_head.lens.stops[0]
    zoom = ZoomLens((NOMINAL_PX, 2 * NOMINAL_PX), (lens, lens.scaled(2.0)), (0.0, forward))
    sight = SightLines(with_zoom_head(still, lens=zoom)).at(0.4, 0.2, 2 * NOMINAL_PX)
    x_fixed = np.array([2.7, -0.9, 9.0])
    _, _, d = sight.project(state(position=[*x_fixed[:2] / 9.0, math.log(9.0)]))
    np.testing.assert_allclose(d * 9.0, truth.in_zoom(x_fixed, 0.4, 0.2) - [0.0, 0.0, forward], atol=EXACT)


def test_a_constant_acceleration_is_a_parabola():
    endless = MotionSettings(1.0, 1e6, 1e6, 0.04)
    x0, v, c, dt = np.array([1.0, -2.0, 10.0]), np.array([3.0, 1.0, -4.0]), np.array([0.0, 2.0, 1.0]), 0.8
    x = state(position=[0.1, -0.2, math.log(10.0)], velocity=v / 10, acceleration=c / 10)
    y, _ = propagate(x, ZERO, dt, endless)
    tolerance = 1e-5  # a time constant of 1e6 s is no eternity, and its closed form loses half the digits
    there = math.exp(y[2]) * np.array([y[0], y[1], 1.0])
    np.testing.assert_allclose(there, x0 + v * dt + c * dt**2 / 2, atol=tolerance)
    np.testing.assert_allclose(math.exp(y[2]) * y[3:6], v + c * dt, atol=tolerance)


def test_a_turn_is_a_circle():
    """By its closed form, of a bird that circles upright in the image, at some distance that changes nothing."""
    endless = MotionSettings(1.0, 1e6, 1e6, 0.04, turns=True)
    radius, speed, depth, dt = 10.0, 8.0, 20.0, 1.5
    x = state(position=[0.1, -0.2, math.log(depth)], velocity=[0.0, speed / depth, 0.0])
    x[6] = speed**2 / radius / depth
    y, _ = propagate(x, ZERO, dt, endless)
    angle = speed / radius * dt
    way = radius * np.array([1 - math.cos(angle), math.sin(angle), 0.0])
    tolerance = 1e-5  # a time constant of 1e6 s is no eternity
    np.testing.assert_allclose(
        depth * np.array([y[0], y[1], 1.0]), depth * np.array([0.1, -0.2, 1.0]) + way, atol=tolerance
    )
    np.testing.assert_allclose(
        depth * y[3:6], speed * np.array([math.sin(angle), math.cos(angle), 0.0]), atol=tolerance
    )


def test_a_target_without_a_certain_velocity_has_no_turn():
    """Its acceleration is predicted as that of a target that walks."""
    x = state(position=[0.1, -0.2, 2.3], velocity=[0.1, 0.0, 0.0], acceleration=[0.0, 0.3, 0.0])
    unknown = np.diag([0.0] * 3 + [100.0] * 3 + [0.0] * 7)  # standard deviation of a hundred times the velocity
    turning, straight = (
        propagate(x, unknown, 0.5, MotionSettings(1.0, 1.0, 10.0, 0.04, turns=turns))[0] for turns in (True, False)
    )
    np.testing.assert_allclose(turning, straight, atol=1e-3 * 0.3)  # a thousandth of the acceleration's effect


@pytest.mark.parametrize("kind", ["walking", "flying"])
def test_the_covariance_is_propagated_by_the_motions_derivative(kind):
    x = np.array([0.2, -0.1, 2.5, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.1, 0.1, 0.01, 0.01])
    motion, P = MOTIONS[kind], np.diag(np.linspace(1e-6, 3e-6, STATES))
    F = jacobian(lambda x: propagate(x, P, 0.3, motion)[0], x)
    moved = F @ P @ F.T
    known = np.zeros_like(P)  # but for the velocity's variance, on which a turn depends
    known[3:6, 3:6] = P[3:6, 3:6]
    moved_known = F @ known @ F.T
    noise = propagate(x, known, 0.3, motion)[1] - moved_known
    # The mean of 1 / depth^2: an uncertain depth makes the noise larger.
    noise[:9, :9] *= math.exp(2 * (moved[2, 2] - moved_known[2, 2]))
    np.testing.assert_allclose(propagate(x, P, 0.3, motion)[1] - noise, moved, atol=1e-6 * DERIVATIVE)


def test_two_short_predictions_are_one_long_one():
    x, motion = (
        state(position=[0.1, -0.1, 2.3], velocity=[0.2, -0.1, 0.0], acceleration=[0.3, 0.2, 0.0]),
        MOTIONS["walking"],
    )
    root = np.random.default_rng(0).normal(size=(STATES, STATES)) * 1e-3
    once = propagate(x, root @ root.T, 0.5, motion)
    twice = propagate(*propagate(x, root @ root.T, 0.2, motion), 0.3, motion)
    np.testing.assert_allclose(twice[0], once[0], atol=2e-3)  # the depth's fading velocity is applied at the end
    np.testing.assert_allclose(np.diag(twice[1]), np.diag(once[1]), rtol=SPLIT)  # as is the depth that scales the noise
    assert np.linalg.eigvalsh(once[1]).min() > 0


@pytest.mark.parametrize(("dt", "tolerance"), [(0.02, WHITE_JERK), (0.5, 1e-6)])
def test_the_noise_is_that_of_singers_acceleration(dt, tolerance):
    """By Van Loan's integral of x' = F x + white noise, for a target straight ahead at 1 m."""
    tau, acceleration = 1.0, 3.0
    _, P = propagate(state(), ZERO, dt, MotionSettings(acceleration, tau, 1e6, 0.04))
    F = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1 / tau]])
    M = expm(np.block([[-F, np.diag([0.0, 0.0, 2 * acceleration**2 / tau])], [np.zeros((3, 3)), F.T]]) * dt)
    for axis in range(3):
        own = [axis, 3 + axis, 6 + axis]
        np.testing.assert_allclose(P[np.ix_(own, own)], M[3:, 3:].T @ M[:3, 3:], rtol=tolerance)


def test_who_walks_changes_its_height_less_than_its_place():
    """On a slope of 0.2, the variance along the pan axis is 0.04 of that across it, in a camera that looks down."""
    down = np.array([0.0, 0.8, 0.6])
    P = propagate(state(), ZERO, 0.5, MotionSettings(3.0, 1.0, 1e6, 0.04, slope=0.2, pan_axis=tuple(down)))[1]
    across, ahead = np.array([1.0, 0.0, 0.0]), np.array([0.0, -0.6, 0.8])
    for begin in (0, 3, 6):  # position at 1 m, velocity, acceleration
        of = P[begin : begin + 3, begin : begin + 3]
        assert ahead @ of @ ahead == pytest.approx(across @ of @ across)
        assert down @ of @ down == pytest.approx(0.04 * (across @ of @ across))
        assert down @ of @ ahead == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("speed", "deviation"), [(0.0, 1.0), (2.0, 1.0), (6.0, math.hypot(1.0, (36 - 4) / 8))])
def test_who_runs_turns_and_brakes_harder(speed, deviation):
    """The centripetal acceleration on a circle of 8 m, less that of 2 m/s, is a part of the deviation."""
    motion = MotionSettings(1.0, 0.5, 1.0, 0.04, turn_m=8.0)
    P = propagate(state(velocity=[speed, 0.0, 0.0]), ZERO, 0.5, motion)[1]
    assert P[6, 6] == pytest.approx(deviation**2 * -math.expm1(-2 * 0.5 / 0.5))


def test_noise_along_the_axis_moves_a_target_off_the_axis_in_the_image():
    """a = X / Z, b = Y / Z and l = log Z change by (dX - a dZ) / Z, (dY - b dZ) / Z and dZ / Z."""
    a, b, Z = 0.5, -0.25, 8.0
    motion = MotionSettings(3.0, 1.0, 1e6, 0.04)
    variance = propagate(state(), ZERO, 0.5, motion)[1][0, 0]  # of X, Y and Z each
    J = np.array([[1.0, 0.0, -a], [0.0, 1.0, -b], [0.0, 0.0, 1.0]]) / Z
    found = propagate(state(position=[a, b, math.log(Z)]), ZERO, 0.5, motion)[1][:3, :3]
    np.testing.assert_allclose(found, variance * J @ J.T, rtol=EXACT)


def test_attitude_and_bias_return_to_their_priors():
    """A Gauss-Markov process that starts known has 1 - exp(-2 dt / tau) of its variance after dt."""
    motion = MotionSettings(1.0, 1.0, 1.0, 0.04, attitude_sigma=0.3, attitude_s=2.0, bias_sigma=0.01, bias_s=50.0)
    _, P = propagate(state(), ZERO, 1.5, motion)
    bias = 0.01**2 * (1 - math.exp(-2 * 1.5 / 50.0))
    np.testing.assert_allclose(np.diag(P)[9:], [0.0, 0.3**2 * (1 - math.exp(-2 * 1.5 / 2.0)), bias, bias], rtol=EXACT)
