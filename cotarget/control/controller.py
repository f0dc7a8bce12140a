"""Command head and lens from a target's estimate, predicted over the delays.

The head is held while the target stays in the deadband (`cotarget.control.head`). The zoom follows from the
probability that the target stays in the image (`cotarget.control.zoom`).
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from cotarget.calibration import Calibration
from cotarget.control.head import HeadController, HeadSettings
from cotarget.control.policy import OnnxPolicy, Situation, ahead_s, rates_of, task_features, zoomed
from cotarget.control.zoom import ZoomController, ZoomSettings
from cotarget.errors import UnreachableError
from cotarget.estimation import Estimate
from cotarget.pantilt import towards
from cotarget.rig import Angles, PanTiltState, Rig, Speed
from cotarget.targeting import Aim, Reach, aim

NO_CHANGE = 1e-6  # least change of the logarithm of the focal length that is commanded
Predict = Callable[[float], Estimate | None]


class Controller:
    """Drive head and lens after one target at a time; remember what was commanded, and how often.

    Args:
        rig: rig whose head, lens and clock are used.
        calibration: calibration of that rig, for its streams.
        head: settings of the head controller.
        zoom: settings of the zoom controller.
        predict: whether to predict the target's motion; without it the head goes to where the target was seen.
        policy: a learnt policy, which drives head and lens in place of the two controllers.
    """

    def __init__(
        self,
        rig: Rig,
        calibration: Calibration,
        *,
        head: HeadSettings | None = None,
        zoom: ZoomSettings | None = None,
        predict: bool = True,
        policy: OnnxPolicy | None = None,
    ) -> None:
        head = head or HeadSettings()
        self._rig, self._calibration, self._predict = rig, calibration, predict
        shortest, longest = (self._true(nominal) for nominal in rig.zoom.focal_range)
        speeds = [(self._true(nominal), speed) for nominal, speed in rig.spec.head.zoomed_speeds]
        self._zoom = ZoomController((shortest, longest), rig.zoom.size, zoom or ZoomSettings(), speeds)
        self._head_controller = HeadController(rig.head.limits, head)
        state = rig.head.state()
        self.commanded = (state.pan, state.tilt, rig.zoom.zoom(rig.zoom.focal_range[0]))
        self.head_commands, self.lens_commands = 0, 1  # number sent so far
        self._policy = policy
        # Logarithm of the focal length that the policy wants, and what the lens made of it.
        self._wanted_focal, self._zoomed_px = 0.0, math.nan

    def drive(
        self, predict: Predict, seen_t: float, interval: float, *, shape: float = 1.0, missed: bool = False
    ) -> tuple[Aim, str]:
        """Send head and lens after a target.

        Args:
            predict: gives the target's estimate at any time [s].
            seen_t: time at which it was last seen [s].
            interval: time from one command to the next [s].
            shape: width over height of its box.
            missed: whether the newest fixed frame does not show it; then the lens stays as it is.

        Returns:
            The aim at where the target will be when a command given now takes effect; and the reason for the focal
            length, see `cotarget.control.zoom.ZoomController.choose`.

        Raises:
            UnreachableError: no pan and tilt within the limits do it, or there is no estimate yet.
        """
        effect_t, target, later = self._predict_over_lead(predict, seen_t, interval)
        first, then = self._aims(target, later)
        if self._policy is not None:
            self._obey(self._policy, effect_t, first, then, seen_t, interval)
            return first, "wanted"
        self._command_head(predict, effect_t, target, first, then, interval)
        return first, "wanted" if missed else self._command_lens(predict, seen_t, first, then, interval, shape)

    def _obey(self, policy: OnnxPolicy, effect_t: float, first: Aim, then: Aim, seen_t: float, interval: float) -> None:
        """Send head and lens as a learnt policy wants; arguments as for `_command_head`, and when it was last seen."""
        rig, limits, (shortest, longest) = self._rig, self._rig.head.limits, self._rig.zoom.focal_range
        if self.commanded[2] != self._zoomed_px:  # something else has zoomed
            self._wanted_focal = math.log(self.commanded[2])
        motion, nominal_px = np.array(self._head_controller.head.motion_at(effect_t)), rig.zoom.state().focal_px
        half_width = np.array(rig.zoom.size[0] / 2 / self._true(nominal_px))
        focal, focal_then = math.log(first.nominal_px), math.log(first.nominal_px * then.range / first.range)
        ranges = limits.pan.range, limits.tilt.range, (math.log(shortest), math.log(longest))
        aim_now = (first.pan, first.tilt, focal)
        absolute = [2 * (at - low) / (high - low) - 1 for at, (low, high) in zip(aim_now, ranges, strict=True)]
        unseen_s = max(rig.clock.now() - rig.spec.fixed.latency_s - seen_t, 0.0)
        logs = np.log([self.commanded[2], nominal_px])
        situation = Situation(motion[:, 0], motion[:, 1], logs[0], logs[1], half_width, interval)
        aims = np.array(aim_now), np.array([then.pan, then.tilt, focal_then])
        features = task_features(*aims, np.array(absolute), np.array(1.0), np.array(unseen_s), situation)
        action = policy.rates(features)
        pan, tilt = rates_of(action, half_width, interval).tolist()
        command = self._head_controller.turn(effect_t, (pan, tilt), ahead_s(limits, interval))
        self._move(command.pan, command.tilt, command.speed)
        self._wanted_focal = float(zoomed(action, self._wanted_focal, shortest, longest))
        self._zoomed_px = rig.zoom.zoom(math.exp(self._wanted_focal))
        self.lens_commands += self._zoomed_px != self.commanded[2]
        self.commanded = (*self.commanded[:2], self._zoomed_px)

    def search(self, predict: Predict, seen_t: float, interval: float) -> Aim | None:
        """Point the head where a target out of sight should be; the lens stays as it is.

        Args:
            predict: gives the target's estimate at any time [s].
            seen_t: time at which it was last seen [s].
            interval: time from one command to the next [s].

        Returns:
            The aim; None if the head waits, because one standard deviation of the target's place reaches beyond the
            border of the zoom image at the shortest focal length.

        Raises:
            UnreachableError: no pan and tilt within the limits do it, or there is no estimate yet.
        """
        effect_t, target, later = self._predict_over_lead(predict, seen_t, interval)
        first, then = self._aims(target, later)
        seen = target.appearance(first.pan, first.tilt, self._rig.zoom.focal_range[0])
        if seen is None or (seen.sigma_px > np.array(self._rig.zoom.size) / 2).any():
            return None
        self._command_head(predict, effect_t, target, first, then, interval)
        return first

    def _predict_over_lead(self, predict: Predict, seen_t: float, interval: float) -> tuple[float, Estimate, Estimate]:
        """Predict the target over the lead: to when a command given now takes effect, and one frame further.

        Returns:
            The time at which a command given now takes effect [s]; the estimates at that time and one frame later.

        Raises:
            UnreachableError: there is no estimate yet.
        """
        effect_t = self._rig.clock.now() + self._rig.spec.head.delay_s
        times = (effect_t, effect_t + interval) if self._predict else (seen_t, seen_t)
        target, later = (predict(t) for t in times)
        if target is None or later is None:
            raise UnreachableError("where the target is was not seen yet")
        return effect_t, target, later

    def _aims(self, target: Estimate, later: Estimate) -> tuple[Aim, Aim]:
        """Aim at a target when a command takes effect, and one frame later at the same focal length.

        Raises:
            UnreachableError: no pan and tilt within the limits do it.
        """
        state = self._rig.head.state()
        self._head_controller.head.add_report(state)  # a halted or slow head is not where it was sent
        reach = reach_of(self._rig, state)
        first = self._aim(target, reach)
        return first, self._aim(later, reach, first)

    def _command_head(
        self, predict: Predict, effect_t: float, target: Estimate, first: Aim, then: Aim, interval: float
    ) -> None:
        """Send the head unless it is held.

        Args:
            predict: gives the target's estimate at any time [s].
            effect_t: time at which a command given now takes effect [s].
            target: estimate of the target at that time.
            first: aim at ``effect_t``.
            then: aim one frame later.
            interval: time from one command to the next [s].
        """
        pan, tilt, focal = self.commanded
        command = self._head_controller.decide(
            effect_t,
            interval,
            (first.pan, first.tilt),
            ((then.pan - first.pan) / interval, (then.tilt - first.tilt) / interval),
            self._rig.zoom.size[0] / self._true(focal),
            self._lead(predict, effect_t, target),
            effect_t - target.measured_t,
        )
        if command is not None:
            pan, tilt = self._rig.head.move(command.pan, command.tilt, command.speed)
            self.head_commands += 1
            self.commanded = (pan, tilt, focal)

    def _command_lens(
        self, predict: Predict, seen_t: float, first: Aim, then: Aim, interval: float, shape: float
    ) -> str:
        """Send the lens unless it is best left alone; arguments as for `drive` and `_command_head`.

        Returns:
            The reason for the focal length.
        """
        pan, tilt, focal = self.commanded
        now = self._rig.clock.now()
        exposed = interval + (now + self._rig.spec.zoom.delay_s)
        (pan_then, _), (tilt_then, _) = self._head_controller.head.motion_at(exposed)
        at_exposure = predict(exposed if self._predict else seen_t)
        focal_px, reason = self._zoom.choose(
            None if at_exposure is None else at_exposure.appearance(pan_then, tilt_then, focal, shape),
            first.focal_px * then.range / first.range,
            self._true(focal),
            now,
            self._true(self._rig.zoom.state().focal_px),
            max(abs(then.pan - first.pan), abs(then.tilt - first.tilt)) / interval,
        )
        nominal = self._calibration.zoom_head.lens.nominal_for(focal_px)
        if abs(math.log(nominal / focal)) > NO_CHANGE:
            self.commanded = (pan, tilt, self._rig.zoom.zoom(nominal))
            self.lens_commands += 1
        return reason

    def _lead(self, predict: Predict, effect_t: float, target: Estimate) -> Angles:
        """Compute the way of pan and tilt from a target's last measurement to its estimate at ``effect_t`` [rad].

        The rate at its end would not do: an acceleration that is noise moves it twice as far as the target.
        """
        measured = predict(target.measured_t) if target.measured_t < effect_t else None
        if measured is None:
            return 0.0, 0.0
        T = self._calibration.zoom_head.T_base_fixed
        (pan, tilt), (pan_before, tilt_before) = (towards(T.apply(each.x_fixed)) for each in (target, measured))
        return pan - pan_before, tilt - tilt_before

    def zoom_out(self) -> None:
        """Send the lens to its shortest focal length; the head waits."""
        pan, tilt, focal = self.commanded
        shortest = self._rig.zoom.focal_range[0]
        if focal > shortest:
            self.commanded = (pan, tilt, self._rig.zoom.zoom(shortest))
            self.lens_commands += 1

    def stand(self) -> None:
        """Halt the head where it is; the lens stays as it is."""
        self._rig.head.halt()
        state = self._rig.head.state()
        self.commanded = (state.pan, state.tilt, self.commanded[2])

    def turn(self, rates: Angles, seconds: float) -> None:
        """Turn the head by hand for a time [s].

        Args:
            rates: rates of pan and tilt, in parts of the field of view a second.
            seconds: for how long, unless another command comes.
        """
        self._head_controller.head.add_report(self._rig.head.state())
        lens = self._rig.zoom.state().focal_px
        field = self._rig.zoom.size[0] / self._true(lens)
        effect_t = self._rig.clock.now() + self._rig.spec.head.delay_s
        command = self._head_controller.turn(effect_t, (rates[0] * field, rates[1] * field), seconds)
        self._move(command.pan, command.tilt, command.speed)

    def go_to(self, pan: float, tilt: float) -> None:
        """Send the head to angles [rad], and the lens to its shortest focal length."""
        self.zoom_out()
        self._move(pan, tilt, None)

    def zoom_by(self, factor: float) -> None:
        """Multiply the commanded focal length, within the lens's range."""
        pan, tilt, focal = self.commanded
        shortest, longest = self._rig.zoom.focal_range
        wanted = min(max(focal * factor, shortest), longest)
        if abs(math.log(wanted / focal)) > NO_CHANGE:
            self.commanded = (pan, tilt, self._rig.zoom.zoom(wanted))
            self.lens_commands += 1

    def _move(self, pan: float, tilt: float, speed: Speed | None) -> None:
        """Command the head, and remember what was commanded."""
        pan, tilt = self._rig.head.move(pan, tilt, speed)
        self.head_commands += 1
        self.commanded = (pan, tilt, self.commanded[2])

    def can_reach(self, estimate: Estimate) -> bool:
        """Whether the head can point at an estimated target."""
        try:
            self._aim(estimate, reach_of(self._rig))
        except UnreachableError:
            return False
        return True

    def _true(self, nominal_px: float) -> float:
        """True focal length at a nominal one [px]."""
        return self._calibration.zoom_head.lens.at(nominal_px).focal_px[0]

    def _aim(self, estimate: Estimate, reach: Reach, zoomed: Aim | None = None) -> Aim:
        """Solve the aim at an estimate, corrected by the head's bias; at the focal length of another aim if given."""
        if zoomed is None:
            found = aim(self._calibration, estimate.x_fixed, reach, wanted_size=estimate.wanted_size)
        else:
            found = aim(self._calibration, estimate.x_fixed, reach, nominal_px=zoomed.nominal_px)
        pan, tilt = found.pan - estimate.bias[0], found.tilt - estimate.bias[1]
        pan = min(max(pan, reach.pan[0]), reach.pan[1])
        tilt = min(max(tilt, reach.tilt[0]), reach.tilt[1])
        return dataclasses.replace(found, pan=pan, tilt=tilt)


def reach_of(rig: Rig, state: PanTiltState | None = None) -> Reach:
    """Collect the limits of a rig's head and lens, and where the head is; by default its state is read."""
    limits, head = rig.head.limits, rig.head.state() if state is None else state
    steps = (limits.pan.step, limits.tilt.step)
    return Reach(limits.pan.range, limits.tilt.range, rig.zoom.focal_range, (head.pan, head.tilt), steps)
