"""From an estimate to commands, on a rig whose cameras and axes all meet in one point: every angle is an arctangent."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import DEFAULT_TARGETS
from cotarget.control.controller import Controller, reach_of
from cotarget.control.head import HeadSettings
from cotarget.control.zoom import ZoomSettings
from cotarget.errors import UnreachableError
from cotarget.estimation import Appearance
from cotarget.geometry import pose
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.targeting import WantedSize
from tests.support.formula_rig import FormulaRig
from tests.support.rigs import alike, rig_of

SIZE, CENTER = (640, 480), (319.5, 239.5)
SHORTEST, LONGEST = 700.0, 7000.0
CLEARLY = 1.02  # times as large, where rounding makes 1e-6
TRUE = 1.1  # what the lens magnifies over what its device tells
BOOK = DEFAULT_TARGETS["book"]
LIMITS = alike((-1.0, 1.0), (-0.8, 0.5), math.radians(149), math.radians(206), 0.0)
DELAY, FRAME = 0.1, 0.04
HERE = pose([0, 0, 0], [0, 0, 0])
CALIBRATION = Calibration(
    fixed=FixedCamera(Intrinsics(SIZE, (700.0, 700.0), CENTER)),
    zoom_head=ZoomHead(
        ZoomLens(
            (SHORTEST, LONGEST),
            tuple(Intrinsics(SIZE, (TRUE * f, TRUE * f), CENTER) for f in (SHORTEST, LONGEST)),
            (0, 0),
        ),
        HERE,
        HERE,
    ),
)


class Rig(FormulaRig):
    """A rig without steps, whose head stands somewhere; the lens is there at once."""

    def __init__(self, t=0.0, pan=0.0, tilt=0.0):
        super().__init__(LIMITS, t=t, delay_s=DELAY, focal_range=(SHORTEST, LONGEST))
        self.pan.command(-10.0, pan)
        self.tilt.command(-10.0, tilt)

    @property
    def sent(self):
        return [tuple(move[1:]) for move in self.moves]

    @property
    def zoomed(self):
        return [focal for _, focal in self.zooms]


@dataclass
class Known:
    """What is known of a book at a time, and how surely [rad]."""

    x_fixed: np.ndarray
    t: float
    sigma: float = 1e-4
    bias: tuple = (0.0, 0.0)
    target = BOOK
    calibration = CALIBRATION

    @property
    def measured_t(self):
        return self.t

    @property
    def wanted_size(self):
        return WantedSize(BOOK.size, BOOK.wanted_px)

    def appearance(self, pan, tilt, nominal_px, shape=1.0):
        x, y, z = self.x_fixed
        focal = TRUE * nominal_px
        off = np.tan([math.atan2(x, z) - pan, math.atan2(y, math.hypot(x, z)) + tilt])
        covariance = np.eye(2) * (focal * self.sigma) ** 2
        return Appearance(
            focal * off, covariance, focal * BOOK.size / z, 0.0, np.full(2, focal), self.target.sides(shape)
        )


def moving(speed, **known):
    """To the right at a speed [m/s], 10 m away and 1 m up, in the middle at time 0."""
    return lambda t: Known(np.array([speed * t, -1.0, 10.0]), t, **known)


def still(x, **known):
    return lambda t: Known(np.array([x, -1.0, 10.0]), t, **known)


def controller(rig, **settings):
    return Controller(rig_of(rig, delay_s=DELAY), CALIBRATION, **settings)


def test_the_lens_starts_at_its_shortest_and_the_head_where_it_is():
    rig = Rig()
    assert controller(rig).commanded == (0.0, 0.0, SHORTEST)
    assert (rig.sent, rig.zoomed) == ([], [SHORTEST])


def test_whatever_is_sent_is_counted():
    """Without a dead zone the head is told where a book is with every frame: by turns two places for a unit's one."""
    rig = Rig(t=2.0)
    move, goal = rig.head.move, (0.05, 0.1)
    rig.head.move = lambda *command: move(*command) and goal
    driver = controller(rig, head=HeadSettings(deadband=False))
    for i in range(20):
        driver.drive(still(0.5 + 1e-4 * (i % 2)), rig.t, FRAME)
        assert driver.commanded[:2] == goal
        rig.t += FRAME
    assert driver.head_commands == len(rig.sent) == 20
    driver.zoom_out()
    driver.zoom_out()  # it is there already
    assert driver.lens_commands == len(rig.zoomed) > 2


def test_the_aim_is_at_where_the_target_will_be_when_the_command_takes_effect():
    rig = Rig(t=2.0)
    found = controller(rig).drive(moving(2.0), 1.9, FRAME)[0]
    assert found.pan == pytest.approx(math.atan(4.2 / 10))
    assert found.tilt == pytest.approx(math.atan(1 / math.hypot(4.2, 10)))  # up
    # The head was at rest in the middle: it is sent farther than there, as the target goes on.
    assert rig.sent[-1][0] > found.pan


def test_without_prediction_the_aim_is_at_where_it_was_seen():
    rig = Rig(t=2.0)
    found = controller(rig, predict=False).drive(moving(1.0), 1.9, FRAME)[0]
    assert found.pan == pytest.approx(math.atan(1.9 / 10))
    assert rig.sent == [(found.pan, found.tilt, None)]  # at full speed, for it is taken to stand there


def test_the_bias_of_the_head_is_taken_off_within_its_limits():
    found = controller(Rig()).drive(still(2.0, bias=(0.01, -0.02)), 0.0, FRAME)[0]
    assert found.pan == pytest.approx(math.atan(0.2) - 0.01)
    assert found.tilt == pytest.approx(math.atan(1 / math.hypot(2, 10)) + 0.02)
    edge = 10 * math.tan(0.999)
    assert controller(Rig()).drive(still(edge, bias=(-0.01, 0.0)), 0.0, FRAME)[0].pan == LIMITS.pan.range[1]


@pytest.mark.parametrize(
    ("predict", "why"), [(lambda t: None, "not seen yet"), (still(30.0), "beyond the limits"), (still(-30.0), "beyond")]
)
def test_what_cannot_be_aimed_at_moves_nothing(predict, why):
    rig = Rig()
    driver = controller(rig)
    with pytest.raises(UnreachableError, match=why):
        driver.drive(predict, 0.0, FRAME)
    assert (rig.sent, rig.zoomed) == ([], [SHORTEST])
    assert driver.commanded == (0.0, 0.0, SHORTEST)


def test_a_target_that_stands_gets_one_command_of_head_and_lens():
    """Once the head is there, and the lens is told its own number for the true focal length of Eq. 17."""
    rig = Rig()
    driver = controller(rig)
    for i in range(50):
        rig.t = i * FRAME
        aim, reason = driver.drive(still(0.5), rig.t, FRAME)
    assert rig.sent == [(pytest.approx(math.atan(0.05)), pytest.approx(math.atan(1 / math.hypot(0.5, 10))), None)]
    distance = math.sqrt(0.5**2 + 1 + 10**2)
    wanted = BOOK.wanted_px * distance / BOOK.size
    assert aim.focal_px == pytest.approx(wanted)
    assert rig.zoomed[-1] == driver.commanded[2] == pytest.approx(wanted / TRUE, rel=ZoomSettings().deadband)
    assert reason == "wanted"


def test_the_less_is_known_the_wider_the_lens_stays():
    """A direction known to 0.05 rad: by the table of the normal distribution, 95 % of both axes is 2.24 sigma each."""
    rig = Rig(tilt=math.atan(0.1))  # it looks there already
    _, reason = controller(rig).drive(still(0.0, sigma=0.05), 0.0, FRAME)
    assert reason == "unsure"
    # Of the height alone, the narrower axis, 95 % are within 1.96 sigma; half the book comes on top.
    half = (SIZE[1] / 2 - ZoomSettings().rim_px) / (TRUE * rig.zoomed[-1])
    assert 1.96 < (half - 0.5 * BOOK.size / 10) / 0.05 < 2.24


def test_zooming_out_leaves_the_head_alone_and_is_told_once():
    rig = Rig()
    driver = controller(rig)
    driver.drive(still(0.5), 0.0, FRAME)
    moves, zooms = len(rig.sent), len(rig.zoomed)
    for _ in range(3):
        driver.zoom_out()
    assert len(rig.sent) == moves
    assert rig.zoomed[zooms:] == [SHORTEST]
    # Whoever moved it meanwhile: what was commanded before does not count.
    for axis, q in ((rig.pan, -0.5), (rig.tilt, 0.0)):
        axis.command(rig.t + DELAY, q)
    rig.t += 2.0
    driver.drive(still(0.5), rig.t, FRAME)
    assert len(rig.sent) == moves + 1
    assert rig.sent[-1][:2] == pytest.approx((math.atan(0.05), math.atan(1 / math.hypot(0.5, 10))))


def test_a_head_that_was_halted_on_its_way_is_sent_again():
    """As a watchdog does after a gap in the frames; whoever took it to have arrived would leave it where it stands."""
    rig = Rig()
    driver = controller(rig)
    driver.drive(still(5.0), rig.t, FRAME)
    rig.t = 0.3
    halted = [axis.halt(rig.t) for axis in (rig.pan, rig.tilt)]
    rig.t = max(halted) + 0.5
    assert abs(rig.head.state().pan - math.atan(0.5)) > 0.1
    driver.drive(still(5.0), rig.t, FRAME)
    rig.t += 2.0
    assert len(rig.sent) == 2
    assert rig.head.state().pan == pytest.approx(math.atan(0.5))


def test_a_lost_target_is_looked_for_with_the_focal_length_it_had():
    rig = Rig()
    driver = controller(rig)
    driver.drive(still(0.5), 0.0, FRAME)
    zoomed = list(rig.zoomed)
    assert zoomed[-1] == driver.commanded[2] > SHORTEST
    rig.t = 1.0
    found = driver.search(still(2.0), 0.0, FRAME)
    assert (rig.zoomed, driver.commanded[2]) == (zoomed, zoomed[-1])
    assert found.pan == pytest.approx(math.atan(0.2))
    assert rig.sent[-1][:2] == driver.commanded[:2] == pytest.approx((found.pan, found.tilt))


def test_a_lost_target_of_which_too_little_is_known_is_waited_for():
    """Half the height of the widest close-up is 240 px of 770: 0.31 rad."""
    for sigma, goes in ((0.30, True), (0.32, False)):
        rig = Rig()
        assert (controller(rig).search(still(2.0, sigma=sigma), 0.0, FRAME) is not None) == goes
        assert len(rig.sent) == goes
    rig = Rig()
    with pytest.raises(UnreachableError):
        controller(rig).search(still(30.0), 0.0, FRAME)
    assert not rig.sent


def test_the_lens_has_a_delay_of_its_own():
    for delay in (0.5, 0.0):
        rig, asked = Rig(t=2.0), []

        def predict(t, asked=asked):
            asked.append(t)
            return Known(np.array([0.5, -1.0, 10.0]), t)

        made = rig_of(rig, delay_s=DELAY)
        slow = replace(made, spec=replace(made.spec, zoom=replace(made.spec.zoom, delay_s=delay)))
        Controller(slow, CALIBRATION).drive(predict, 1.9, FRAME)
        assert asked == pytest.approx([2.0 + DELAY, 2.0 + DELAY + FRAME, 2.0 + delay + FRAME])


def test_a_narrow_target_may_be_larger():
    """Its direction is known badly along the width, of which it takes but a part."""
    focals = []
    for shape in (1.0, 2.5):
        rig = Rig(tilt=math.atan(0.1))
        controller(rig).drive(still(0.0, sigma=0.02), 0.0, FRAME, shape=shape)  # of a book its width is told
        focals.append(rig.zoomed[-1])
    assert focals[1] > CLEARLY * focals[0]


def test_what_can_be_reached():
    driver = controller(Rig())
    assert driver.can_reach(still(10 * math.tan(0.99))(0.0))
    assert not driver.can_reach(still(10 * math.tan(1.01))(0.0))


def test_the_reach_of_a_rig_is_that_of_its_devices():
    rig = Rig(pan=0.2, tilt=0.1)
    reach = reach_of(rig)
    assert (reach.pan, reach.tilt, reach.focal_px) == (LIMITS.pan.range, LIMITS.tilt.range, (SHORTEST, LONGEST))
    assert (reach.now, reach.steps) == ((0.2, 0.1), (0.0, 0.0))
