"""From an estimate to commands: where the head is sent so that it keeps up, and how far the lens zooms in.

The head is spared by a dead zone; how far the lens may zoom in follows from how surely the target will be in the image.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field

from cotarget.calibration import Calibration
from cotarget.deadzone import Steering, SteeringSettings
from cotarget.errors import UnreachableError
from cotarget.estimation import Estimate
from cotarget.rig import PanTiltState, Rig
from cotarget.targeting import Aim, Reach, aim
from cotarget.zoompolicy import ZoomPolicy, ZoomSettings, expect

NO_CHANGE = 1e-6  # of the logarithm of the focal length

Predict = Callable[[float], Estimate | None]


@dataclass(frozen=True)
class ServoSettings:
    """How head and lens are driven.

    Attributes:
        command_delay_s: from a command to the start of motion [s].
        predict: whether the target's motion is allowed for; without it the head is sent where the target was seen.
        steering: how the head keeps up, and when it is left alone.
        zoom: when the lens zooms in and out.
    """

    command_delay_s: float = 0.0
    predict: bool = True
    steering: SteeringSettings = field(default_factory=SteeringSettings)
    zoom: ZoomSettings = field(default_factory=ZoomSettings)


@dataclass(frozen=True)
class Drive:
    """What a frame led to.

    Attributes:
        aim: at where the target will be when a command given now takes effect.
        chance: that the whole target will be in the next zoom frame.
        zoom_reason: why the lens is where it is, as `cotarget.zoompolicy` says it.
    """

    aim: Aim
    chance: float
    zoom_reason: str


class Servo:
    """Drives head and lens after one target at a time; remembers what was commanded.

    Args:
        rig: its head, lens and clock.
        calibration: of that rig, for its streams.
        settings: how.
    """

    def __init__(self, rig: Rig, calibration: Calibration, settings: ServoSettings = ServoSettings()) -> None:
        self._rig, self._calibration, self._settings = rig, calibration, settings
        shortest, longest = (self._true(nominal) for nominal in rig.zoom.focal_range)
        self._zoom = ZoomPolicy((shortest, longest), rig.zoom.size, settings.zoom)
        self._steering = Steering(rig.head.limits, settings.steering)
        state = rig.head.state()
        self.commanded = (state.pan, state.tilt, rig.zoom.zoom(rig.zoom.focal_range[0]))

    def drive(self, predict: Predict, seen_t: float, interval: float) -> Drive:
        """Send head and lens after a target.

        Args:
            predict: the target at any time [s].
            seen_t: when it was seen last [s].
            interval: from one command to the next [s].

        Raises:
            UnreachableError: no pan and tilt within the limits do it, or nothing is known of it.
        """
        now = self._rig.clock.now()
        effect = now + self._settings.command_delay_s
        times = (effect, effect + interval) if self._settings.predict else (seen_t, seen_t)
        at_effect, then = (predict(t) for t in times)
        if at_effect is None or then is None:
            raise UnreachableError("where the target is was not seen yet")
        state = self._rig.head.state()
        self._steering.head.saw(state)  # a head that was halted, or is slow, is not where it was sent
        reach = reach_of(self._rig, state)
        first = self._aim(at_effect, reach)
        found = self._aim(then, reach, first)
        rates = (found.pan - first.pan) / interval, (found.tilt - first.tilt) / interval
        pan, tilt, focal = self.commanded
        focal_now = self._true(focal)
        view = self._rig.zoom.size[0] / focal_now
        command = self._steering.decide(
            effect, interval, (first.pan, first.tilt), rates, view, effect - at_effect.measured_t
        )
        if command is not None:
            pan, tilt = self._rig.head.move(command.pan, command.tilt, command.speed)
        (pan_then, _), (tilt_then, _) = self._steering.head.at(effect + interval)
        choice = self._zoom.choose(
            expect(then, pan_then, tilt_then, focal),
            first.focal_px * found.range / first.range,
            focal_now,
            now,
            self._true(self._rig.zoom.state().focal_px),
        )
        nominal = self._calibration.zoom.nominal_for(choice.focal_px)
        if abs(math.log(nominal / focal)) > NO_CHANGE:
            focal = self._rig.zoom.zoom(nominal)
        self.commanded = (pan, tilt, focal)
        return Drive(first, choice.chance, choice.reason)

    def zoom_out(self) -> None:
        """Send the lens to its shortest focal length; the head waits."""
        pan, tilt, focal = self.commanded
        shortest = self._rig.zoom.focal_range[0]
        if focal > shortest:
            self.commanded = (pan, tilt, self._rig.zoom.zoom(shortest))

    def can_reach(self, estimate: Estimate) -> bool:
        """Whether the head can point at where a target is estimated to be."""
        try:
            self._aim(estimate, reach_of(self._rig))
        except UnreachableError:
            return False
        return True

    def _true(self, nominal_px: float) -> float:
        """The true focal length at a nominal one [px]."""
        return self._calibration.zoom.at(nominal_px).focal_px[0]

    def _aim(self, estimate: Estimate, reach: Reach, zoomed: Aim | None = None) -> Aim:
        """Solve for an estimate, the head's bias allowed for; at the focal length of another aim, if there is one."""
        if zoomed is None:
            found = aim(self._calibration, estimate.x_fixed, reach, closeup=estimate.closeup)
        else:
            found = aim(self._calibration, estimate.x_fixed, reach, nominal_px=zoomed.nominal_px)
        pan, tilt = found.pan - estimate.bias[0], found.tilt - estimate.bias[1]
        pan = min(max(pan, reach.pan[0]), reach.pan[1])
        tilt = min(max(tilt, reach.tilt[0]), reach.tilt[1])
        return dataclasses.replace(found, pan=pan, tilt=tilt)


def reach_of(rig: Rig, state: PanTiltState | None = None) -> Reach:
    """What a rig's head and lens can do, and where the head is; asked by default."""
    limits, head = rig.head.limits, rig.head.state() if state is None else state
    return Reach(limits.pan, limits.tilt, rig.zoom.focal_range, (head.pan, head.tilt), limits.step)
