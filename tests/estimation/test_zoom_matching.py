"""Registration in the zoom image, in drawn and in rendered scenes, and its correlation against the definition."""

import dataclasses
import math

import cv2
import numpy as np
import pytest

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import DEFAULT_TARGETS
from cotarget.demo import SCENES, sim_config
from cotarget.estimation.correlation import correlate, resample, summit
from cotarget.estimation.measurement_model import Pose
from cotarget.estimation.zoom_matching import CloseupFinder, Outline, ZoomMeasurement, look, outline_in
from cotarget.evaluation import true_calibration
from cotarget.geometry import pose
from cotarget.rig import Detection, Frame
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.sim.world import SimWorld
from cotarget.targeting import Reach, aim

SIZE = (640, 480)
FINE = 8  # scenes are drawn with this many bits of sub-pixel, and antialiased
FOCAL, CENTER, DISTORTION = 690.0, (319.5, 239.5), np.array([-0.2, 0.0, 0.0, 0.0])
BASELINE = 0.4  # [m]
SIGMA_PX = 20.0  # of the expected place in the zoom image: 2 m of 10 m in depth at 700 px
REGISTERED_PX = 0.25  # of the fixed image: a sixtieth of the smallest target below
OUTLINED = 0.06  # of an outline's side, in parts of the expected one: two of forty samples, and their edges
BIRD = DEFAULT_TARGETS["bird"]
# A bird with a wing up, seen from the side, in metres about its middle.
OUTLINE = np.array(
    [(-0.28, 0.02), (-0.12, -0.02), (-0.05, -0.27), (0.09, -0.3), (0.1, -0.05), (0.24, -0.02), (0.2, 0.05), (0, 0.1)]
)


def calibration(roll_deg=0.0):
    fixed = Intrinsics(SIZE, (FOCAL, FOCAL), CENTER, (*DISTORTION, 0.0))
    home = pose([-BASELINE, 0.0, 0.0], [0.0, 0.0, roll_deg])
    return Calibration(
        fixed=FixedCamera(fixed),
        zoom_head=ZoomHead(
            ZoomLens((FOCAL,), (Intrinsics(SIZE, (FOCAL, FOCAL), CENTER),)), home, pose([0, 0, 0], [0, 0, 0])
        ),
    )


def matrix(focal):
    return np.array([[focal, 0, CENTER[0]], [0, focal, CENTER[1]], [0, 0, 1.0]])


def turned(pan, tilt):
    """Orientation of the camera in its frame at home: to the right by pan, then up by tilt."""
    return cv2.Rodrigues(np.array([0.0, pan, 0.0]))[0] @ cv2.Rodrigues(np.array([tilt, 0.0, 0.0]))[0]


class Scene:
    """Birds before a cloudy sky in both images, with different clouds in each as if by parallax."""

    def __init__(self, birds, nominal=3000.0, roll_deg=0.0, aim_off_px=(0.0, 0.0), seed=0, colour=(45, 50, 55)):
        self.rng = np.random.default_rng(seed)
        self.calibration = calibration(roll_deg)
        self.nominal, self.birds, self.colour = nominal, [np.asarray(b, float) for b in birds], colour
        self.R = cv2.Rodrigues(np.array([0.0, 0.0, math.radians(roll_deg)]))[0]
        target = self.R @ self.birds[0] + [-BASELINE, 0.0, 0.0]
        u, v = (-np.array(aim_off_px) / nominal).tolist()  # where the axis is aimed at, from the target
        self.pan = math.atan2(target[0], target[2]) + u
        self.tilt = -math.atan2(target[1], math.hypot(target[0], target[2])) - v

    def fixed_px(self, points):
        return cv2.projectPoints(np.atleast_2d(points), np.zeros(3), np.zeros(3), matrix(FOCAL), DISTORTION)[0][:, 0]

    def zoom_px(self, points):
        x = np.atleast_2d(points) @ self.R.T + [-BASELINE, 0.0, 0.0]
        x = x @ turned(self.pan, self.tilt)
        return cv2.projectPoints(x, np.zeros(3), np.zeros(3), matrix(self.nominal), None)[0][:, 0]

    def draw(self, project, magnified, which=None):
        """Draw sky, clouds and birds, then add noise of 2 grey levels and JPEG of quality 90."""
        clouds = self.rng.normal(0, 1, (12, 16)).astype(np.float32)
        clouds = np.clip(cv2.resize(clouds, SIZE, interpolation=cv2.INTER_CUBIC), -1, 1)[..., None]
        image = np.array([215.0, 180.0, 140.0]) + clouds * [20.0, 35.0, 50.0]
        image = np.clip(image, 0, 255).astype(np.uint8)
        for bird in self.birds if which is None else which:
            corners = bird + np.column_stack([OUTLINE, np.zeros(len(OUTLINE))])
            px = np.rint(project(corners) * 2**FINE).astype(np.int32)
            cv2.fillPoly(image, [px], self.colour, cv2.LINE_AA, FINE)
        if magnified < 1.5:
            image = cv2.GaussianBlur(image, (0, 0), 0.5)
        noisy = np.clip(np.rint(image + self.rng.normal(0, 2.0, image.shape)), 0, 255).astype(np.uint8)
        return cv2.imdecode(cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 90])[1], cv2.IMREAD_COLOR)

    def fixed(self, t=0.0):
        """Return frame, detection and foreground of the first bird."""
        corners = self.fixed_px(self.birds[0] + np.column_stack([OUTLINE, np.zeros(len(OUTLINE))]))
        low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
        mask = np.zeros(SIZE[::-1], np.uint8)
        cv2.fillPoly(mask, [np.rint(corners * 2**FINE).astype(np.int32)], 255, cv2.LINE_8, FINE)
        return Frame(self.draw(self.fixed_px, 1.0), t), Detection((low + high) / 2, high - low + 1, 0.9), mask

    def zoom(self, which=None, t=0.0):
        return Frame(self.draw(self.zoom_px, self.nominal / FOCAL, which), t)

    def expected(self, off_px=(0.0, 0.0), sigma_px=SIGMA_PX):
        """Return the expected position, its covariance and the pose, wrong by `off_px` in the zoom image."""
        depth = self.birds[0][2]
        x = self.birds[0] + np.array([*off_px, 0.0]) * depth / self.nominal
        return x, sigma_px**2 * np.eye(2), Pose(self.pan, self.tilt, self.nominal)

    def finder(self):
        finder = CloseupFinder(self.calibration, BIRD)
        finder.store(*self.fixed())
        return finder

    def error(self, found, finder=None):
        """Distance of the found point from that of the fixed image [px of the fixed image]."""
        body_px = (self.finder() if finder is None else finder).fixed_view_at(0.0).body_px
        ray = np.append(cv2.undistortPoints(body_px.reshape(1, 1, 2), matrix(FOCAL), DISTORTION)[0, 0], 1.0)
        there = self.zoom_px(ray * self.birds[0][2])[0]
        return float(np.linalg.norm(found.center_px - there)) * FOCAL / self.nominal


@pytest.mark.parametrize("nominal", [700.0, 1800.0, 4000.0, 7500.0])
@pytest.mark.parametrize("roll_deg", [0.0, 8.0])
def test_a_target_is_registered_at_any_focal_length_and_roll(nominal, roll_deg):
    scene = Scene([(1.5, -1.0, 20.0)], nominal, roll_deg)
    found = scene.finder().find(scene.zoom(), *scene.expected((15.0, -10.0)))
    assert found is not None
    error = scene.error(found)
    assert error < REGISTERED_PX
    assert error < 4 * found.sigma_px * FOCAL / nominal
    # A wing moves the body's centre, which is no error of the registration.
    assert (found.body_sigma_px > found.sigma_px / 4).all()


@pytest.mark.parametrize("wrong", [0.6, 1.0, 1.7])
@pytest.mark.parametrize("nominal", [1800.0, 4000.0, 7500.0])
def test_an_outline_is_measured_whatever_size_is_expected(nominal, wrong):
    scene = Scene([(1.5, -1.0, 20.0)], nominal)
    size_px = np.ptp(OUTLINE, axis=0) * nominal / 20.0
    found = outline_in(scene.zoom().image, scene.zoom_px(scene.birds[0])[0], wrong * size_px.max())
    assert found is not None
    assert found.size_px == pytest.approx(size_px, abs=OUTLINED * wrong * size_px.max())


@pytest.mark.parametrize("wing", [-0.3, 0.0, 0.3])
def test_the_body_of_a_bird_stays_where_it_is_when_it_beats_its_wings(wing):
    """A round body with a tail and a wing that points up, at the camera or down, before a plain sky."""
    image = np.full((480, 640, 3), 200, np.uint8)
    body_px, scale = np.array([300.0, 250.0]), 400.0  # [px], [px/m]
    tip = body_px + scale * np.array([0.1, wing])
    tail = body_px + np.array([(0, -8), (110, -14), (110, 14), (0, 8)])
    shoulder, half = np.array([16, 0]), np.array([8, 0])
    for shape in (tail, np.array([body_px - shoulder, tip - half, tip + half, body_px + shoulder])):
        cv2.fillPoly(image, [np.rint(shape).astype(np.int32)], (40, 40, 40))
    cv2.circle(image, body_px.astype(int).tolist(), 26, (40, 40, 40), -1)
    found = outline_in(image, body_px + np.array([10.0, 15.0]), 150.0)
    assert found is not None
    assert found.body_px == pytest.approx(body_px, abs=150.0 / 40)  # one sample of forty


@pytest.mark.parametrize(("off_px", "taken"), [(20.0, True), (50.0, False)])
def test_an_outline_refines_what_was_found_there_and_nothing_else(off_px, taken):
    """A body found with a standard deviation of 10 px along each axis."""
    found = ZoomMeasurement(np.array([300.0, 200.0]), 1.0, np.array([10.0, 10.0]), 0.0)
    outline = Outline(np.array([100.0, 60.0]), np.array([300.0 + off_px, 200.0]))
    refined = outline.refine(found)
    assert refined.center_px == pytest.approx(outline.body_px if taken else found.center_px)
    assert (refined.body_sigma_px < found.body_sigma_px).all() == taken


def test_what_is_no_whole_outline_measures_no_size():
    scene = Scene([(1.5, -1.0, 20.0)])
    zoom, at = scene.zoom().image, scene.zoom_px(scene.birds[0])[0]
    larger_px = np.ptp(OUTLINE, axis=0).max() * scene.nominal / 20.0
    assert outline_in(zoom, at, 0.4 * larger_px) is None  # it fills the square
    assert outline_in(zoom, at + 1.4 * larger_px, 2.0 * larger_px) is None  # beside it
    assert outline_in(scene.zoom(which=[]).image, at, larger_px) is None


def test_nothing_is_found_in_an_empty_zoom_image():
    for seed in range(8):
        scene = Scene([(1.5, -1.0, 20.0)], seed=seed)
        assert scene.finder().find(scene.zoom(which=[]), *scene.expected()) is None


def test_a_target_outside_the_gate_is_not_found():
    scene = Scene([(1.5, -1.0, 20.0)])
    finder, zoom = scene.finder(), scene.zoom()
    assert finder.find(zoom, *scene.expected((100.0, 0.0), sigma_px=10.0)) is None
    assert finder.find(zoom, *scene.expected((100.0, 0.0), sigma_px=40.0)) is not None


def test_two_equal_targets_in_the_gate_are_ambiguous():
    scene = Scene([(1.5, -1.0, 20.0), (2.1, -1.0, 20.0)])  # 0.6 m at 20 m and 3000 px: 90 px
    finder, zoom = scene.finder(), scene.zoom()
    halfway = scene.expected((45.0, 0.0), sigma_px=40.0)
    assert finder.find(zoom, *halfway) is None
    sure = finder.find(zoom, *scene.expected((5.0, 0.0), sigma_px=15.0))
    assert sure is not None
    assert scene.error(sure) < REGISTERED_PX


def test_a_target_clipped_by_the_zoom_image_is_found_while_most_of_it_shows():
    for off, found_there in ((0.0, True), (300.0, True), (-290.0, True), (360.0, False), (420.0, False)):
        scene = Scene([(1.5, -1.0, 20.0)], aim_off_px=(off, 0.0))
        found = scene.finder().find(scene.zoom(), *scene.expected((10.0, 5.0)))
        assert (found is not None) == found_there, off
        if found is not None:
            assert scene.error(found) < 2 * REGISTERED_PX


def test_a_zoom_stream_of_half_the_size_is_registered():
    scene = Scene([(1.5, -1.0, 20.0)])
    half = Frame(cv2.resize(scene.zoom().image, (320, 240), interpolation=cv2.INTER_AREA), 0.0)
    finder = CloseupFinder(scene.calibration.for_streams(SIZE, (320, 240)), BIRD)
    finder.store(*scene.fixed())
    x, covariance, there = scene.expected()
    found = finder.find(half, x, covariance, dataclasses.replace(there, nominal_px=scene.nominal / 2))
    assert found is not None
    doubled = dataclasses.replace(found, center_px=(found.center_px + 0.5) * 2 - 0.5)
    assert scene.error(doubled) < REGISTERED_PX


@pytest.mark.parametrize(("gain", "offset"), [(0.5, 0.0), (0.5, 90.0), (1.15, -20.0)])
def test_the_cameras_may_be_exposed_differently(gain, offset):
    scene = Scene([(1.5, -1.0, 20.0)])
    image = np.clip(scene.zoom().image * gain + offset, 0, 255).astype(np.uint8)
    found = scene.finder().find(Frame(image, 0.0), *scene.expected())
    assert found is not None
    assert scene.error(found) < REGISTERED_PX


def test_the_fixed_frame_nearest_in_time_is_registered_and_an_old_one_is_not():
    scene = Scene([(1.5, -1.0, 20.0)])
    frame, detection, mask = scene.fixed()
    finder = CloseupFinder(scene.calibration, BIRD)
    zoom = scene.zoom(t=1.0)
    assert finder.find(zoom, *scene.expected()) is None
    for t in (0.8, 0.94, 0.98, 1.03):
        finder.store(Frame(frame.image, t), detection, mask)
    assert finder.fixed_view_at(1.0).t == 0.98
    assert finder.find(zoom, *scene.expected()).t == 1.0
    assert finder.fixed_view_at(1.2) is None
    assert finder.find(Frame(zoom.image, 1.2), *scene.expected()) is None


def test_a_target_without_foreground_is_registered_by_its_box():
    scene = Scene([(1.5, -1.0, 20.0)])
    frame, detection, mask = scene.fixed()
    for nothing in (None, np.zeros_like(mask)):
        finder = CloseupFinder(scene.calibration, BIRD)
        finder.store(frame, detection, nothing)
        found = finder.find(scene.zoom(), *scene.expected())
        assert found is not None
        assert scene.error(found, finder) < REGISTERED_PX


def test_a_clipped_box_has_an_uncertain_body_centre():
    scene = Scene([(1.5, -1.0, 20.0)])
    frame, detection, mask = scene.fixed()
    sigmas = []
    for clipped in (False, True):
        finder = CloseupFinder(scene.calibration, BIRD)
        finder.store(frame, dataclasses.replace(detection, clipped=clipped), mask)
        sigmas.append(finder.find(scene.zoom(), *scene.expected()).body_sigma_px)
    assert (sigmas[1] > 0.45 * detection.size_px * scene.nominal / FOCAL).all()
    assert (sigmas[1] > 2 * sigmas[0]).all()


@pytest.mark.parametrize("x", [(0.0, 0.0, -20.0), (0.0, 0.0, 0.0), (math.nan, 0.0, 20.0), (90.0, 0.0, 20.0)])
def test_a_target_that_a_camera_cannot_show_is_not_found(x):
    scene = Scene([(1.5, -1.0, 20.0)])
    _, covariance, there = scene.expected()
    assert scene.finder().find(scene.zoom(), np.array(x), covariance, there) is None


@pytest.mark.parametrize("center", [(-30.0, 100.0), (700.0, 100.0), (math.nan, 100.0), (0.0, 0.0), (639.0, 479.0)])
def test_boxes_at_and_beyond_the_border_are_not_registered(center):
    scene = Scene([(1.5, -1.0, 20.0)])
    frame, detection, mask = scene.fixed()
    finder = CloseupFinder(scene.calibration, BIRD)
    finder.store(frame, dataclasses.replace(detection, center_px=np.array(center)), mask)
    assert finder.find(scene.zoom(), *scene.expected()) is None


# ---------------------------------------------------------------- rendered scenes

# Registration error in rendered scenes [px of the fixed image]: the cameras see a person's limbs from two sides.
RENDERED_PX = {"book": 0.3, "person": 1.2, "bird": 0.4}


@pytest.mark.render
@pytest.mark.parametrize("name", [*(pytest.param(name, marks=pytest.mark.slow) for name in ("book", "person")), "bird"])
def test_rendered_targets_are_registered_from_the_shortest_focal_length_to_the_longest(name):
    config = sim_config(SCENES[name], (name,), 5)
    world, empty = (
        SimWorld(config),
        SimWorld(dataclasses.replace(config, sim=dataclasses.replace(config.sim, targets=()))),
    )
    truth, rig, target = world.truth(), world.rig, config.target(name)
    calibration = true_calibration(world, stops=16)
    finder = CloseupFinder(calibration, target)
    closest = target.wanted_px / target.size
    for k, part in enumerate((0.0, 0.5, 1.0)):
        t = 4.0 + k  # of the frames; the head has a second to get there
        x_fixed = truth.T_world_fixed.inv().apply(truth.center(name, t))
        shortest, longest = rig.zoom.focal_range
        nominal = rig.zoom.zoom(shortest * (min(closest * x_fixed[2], longest) / shortest) ** part)
        free = Reach((-3.0, 3.0), (-1.0, 1.0), rig.zoom.focal_range)
        there = aim(calibration, x_fixed, free, nominal_px=nominal)
        rig.head.move(there.pan, there.tilt)
        for each in (world, empty):
            each.rig.clock.sleep_until(t + config.sim.fixed.latency_s + 0.001)
        fixed, nothing, zoom = rig.fixed.read(), empty.rig.fixed.read(), rig.zoom.read()
        assert fixed.t == zoom.t == pytest.approx(t)
        mask = (np.abs(fixed.image.astype(int) - nothing.image).max(axis=2) > 25).astype(np.uint8)
        outline = truth.silhouette(name, "fixed", t)
        box = Detection((outline.low_px + outline.high_px) / 2, outline.size_px, 0.9)
        fixed_view = finder.store(fixed, box, mask)
        # The expected depth is wrong by a twentieth.
        head, lens = truth.head_at(t), truth.nominal_at(t)
        found = finder.find(zoom, x_fixed * 1.05, 30.0**2 * np.eye(2), Pose(*head, lens))
        assert found is not None, f"at {nominal:.0f} px"
        scale = truth.lens("zoom", t).focal_px[0] / truth.lens("fixed", t).focal_px[0]
        error = (found.center_px - truth.pixel("zoom", truth.center(name, t), t)) / scale
        body = fixed_view.body_px - truth.pixel("fixed", truth.center(name, t), t)
        off = float(np.linalg.norm(error - body))
        assert off < RENDERED_PX[name]
        assert (np.abs(error) * scale < 4 * found.body_sigma_px + 4 * found.sigma_px).all()
    world.close()
    empty.close()


def test_a_box_beyond_the_frame_has_no_fixed_view_though_its_margin_is_inside():
    """A user's detector may return such a box; without a pixel its correlation would be nan."""
    frame = Frame(np.full((480, 640, 3), 128, np.uint8), 0.0)
    assert look(frame, Detection(np.array([90.8, 485.4]), np.array([0.9, 8.3]), 1.0), None, BIRD) is None
    assert look(frame, Detection(np.array([90.8, 483.0]), np.array([0.9, 8.3]), 1.0), None, BIRD) is not None


def naive(image, inside, template, weight, row, column):
    """Compute correlation and visible part by definition: weighted covariances of the samples inside, all colours."""
    h, w = weight.shape
    here = weight * inside[row : row + h, column : column + w]
    n = here.sum()
    a, b = template.astype(float), image[row : row + h, column : column + w].astype(float)
    a, b = (each - np.einsum("ij,ijk->k", here, each) / n for each in (a, b))
    covariance, own, other = (np.einsum("ij,ijk,ijk->", here, x, y) for x, y in ((a, b), (a, a), (b, b)))
    noise = 0.1 * n
    return covariance / math.sqrt((own + noise) * (other + noise)), n / weight.sum()


@pytest.mark.parametrize("cut", [False, True])
def test_correlation_follows_its_definition(cut):
    rng = np.random.default_rng(3)
    image, template = rng.normal(5, 2, (21, 24, 3)).astype(np.float32), rng.normal(3, 1, (7, 9, 3)).astype(np.float32)
    weight = rng.uniform(0, 1, (7, 9)).astype(np.float32)
    inside = np.ones((21, 24), np.float32)
    if cut:
        inside[:, :6] = 0
    scores, seen = correlate(image, inside if cut else None, template, weight)
    for at in ((0, 3), (7, 8), (14, 15)):
        expected = naive(image, inside, template, weight, *at)
        assert (scores[at], seen[at]) == pytest.approx(expected, abs=1e-4)  # float32


def test_a_summit_is_that_of_a_parabola():
    v, u = np.mgrid[0:9, 0:11]
    score = 1 - 0.02 * (u - 4.3) ** 2 - 0.03 * (v - 5.2) ** 2
    assert summit(score, (5, 4)) == pytest.approx([4.3, 5.2])
    assert summit(score, (4, 5)) == pytest.approx([4.3, 5.2])  # a neighbour leads to it
    assert summit(score, (0, 4)) is None
    assert summit(score, (2, 8)) is None  # the score still rises at the border


@pytest.mark.parametrize("pitch", [0.3, 1.0, 1.7, 4.0, 11.3])
def test_samples_are_taken_at_the_mapped_pixels(pitch):
    """Averaging leaves a ramp as it is, so each sample is the coordinate where it is taken."""
    v, u = np.mgrid[0:480, 0:640].astype(np.float32)
    A = np.array([[pitch, 0.1 * pitch, 150.3], [-0.1 * pitch, pitch, 140.8]])
    for plane, row in ((u, 0), (v, 1)):
        samples, inside = resample(plane, A, (20, 17))
        j, i = np.mgrid[0:17, 0:20]
        assert inside is None
        # Linear interpolation in steps of 1/32 of a pixel of the reduced image.
        assert np.abs(samples - (A[row, 0] * i + A[row, 1] * j + A[row, 2])).max() < max(pitch, 1.0) / 16
    left = 3.2 * pitch
    _, inside = resample(u, np.array([[pitch, 0.0, -left], [0.0, pitch, 100.0]]), (20, 17))
    there = pitch * np.arange(20) - left >= -0.5  # a pixel is half a pixel wide to each side
    assert (inside == there).all()
