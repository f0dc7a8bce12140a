"""Give a run an operator: orders from other threads, one operator in control, and what happens without one.

The session's own thread is the run's. The methods that give orders may be called from any thread; the run obeys them
with its next frame. Only a stop does not wait for a frame: on a rig in real time it halts the head at once.
"""

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from cotarget.config import FollowConfig
from cotarget.control.orders import MANUAL_S, Order
from cotarget.errors import ConfigError, CotargetError, DeviceError
from cotarget.pipeline import HEAD, Mode, Run, State, Step
from cotarget.rig import Rig
from cotarget.safety.stop_file import StopLook, clear_stop_file, write_stop_file

CONFIRMED_S = 0.3  # until a new run has confirmed a track: 0.24 to 0.36 s in the demo


class ControlError(CotargetError):
    """Somebody else has control."""


class Records(Protocol):
    """What records a session, when it is asked to.

    Attributes:
        folder: folder of the recording; empty while nothing is recorded.
    """

    folder: str

    def add(self, order: Order) -> None:
        """Record an order before the run obeys it, if anything is recorded."""

    def begin(self) -> Run:
        """Record from now on, and make the new run that the recording begins with."""

    def end(self) -> None:
        """Complete the recording."""


class Session:
    """A run that stands, follows or is moved by hand, as an operator orders.

    Args:
        rig: the guarded rig.
        run: the run on it.
        stop_file: stop file of the session; a stop is written there too, and lasts until it is cleared.
        config: what happens when nothing is followed, and without an operator.
        now: time on the wall [s], for orders by hand that end.
        records: records it; None for none.

    Attributes:
        control: who has control; None for nobody.
        stopped: reason of the stop; None if the heads may move.
        notice: what went wrong last in the run's thread, as a sentence; empty if nothing did.
    """

    def __init__(
        self,
        rig: Rig,
        run: Run,
        stop_file: Path | None,
        config: FollowConfig,
        now: Callable[[], float],
        records: Records | None = None,
    ) -> None:
        self.control: str | None = None
        self._rig, self._run, self._config, self._now, self._records = rig, run, config, now, records
        self._stop_file = stop_file
        self._look, self._in_file = StopLook(stop_file), False  # whether the stop was in its file at the frame before
        self._lock = threading.Lock()
        self._orders: list[Order] = [Order("stand", HEAD)]
        self._turning: dict[str, tuple[tuple[float, float], float]] = {}  # rates by head, and when they end
        self._zooms: list[tuple[Order, float]] = []  # orders to zoom, and when they end
        self._to_clear = False
        self.stopped: str | None = None
        self.notice = ""
        self._to_record: bool | None = None
        self._idle_since: float | None = None

    @property
    def heads(self) -> tuple[str, ...]:
        """Names of the heads."""
        return (HEAD,)

    def mode(self, head: str) -> Mode:
        """Return the mode of a head."""
        self._check(head)
        return self._run.head.mode

    # Orders

    def follow(self, head: str, target: int | tuple[float, float] | None = None, *, by: str | None = None) -> None:
        """Follow the track with a number, the target at a pixel of the fixed image, or what the policy selects.

        Args:
            head: name of the head.
            target: number of a track, or pixel (u, v).
            by: who gives the order; None for the program itself. So for all orders.

        Raises:
            ControlError: somebody else has control. So for all orders but a stop.
            ConfigError: there is no such head or pixel.
        """
        if isinstance(target, tuple):
            width, height = self._rig.fixed.size
            if not (-0.5 <= target[0] <= width - 0.5 and -0.5 <= target[1] <= height - 0.5):
                raise ConfigError("this place is not in the fixed camera's picture")
            self._give(Order("follow", head, click=target), by)
        else:
            self._give(Order("follow", head, track=target), by)

    def stand(self, head: str, *, by: str | None = None) -> None:
        """Let a head and its lens stand."""
        self._give(Order("stand", head), by)

    def manual(self, head: str, rates: tuple[float, float], *, by: str | None = None) -> None:
        """Turn a head by hand for `MANUAL_S`, or until the next order.

        Args:
            head: name of the head.
            rates: rates of pan and tilt, in parts of the field of view a second.
            by: who gives the order.
        """
        self._refuse_other(by)
        self._check(head)
        if self.stopped is not None:
            return
        with self._lock:
            self._turning[head] = rates, self._now() + MANUAL_S

    def zoom(self, head: str, factor: float, *, by: str | None = None) -> None:
        """Multiply the focal length of a head that does not follow, with a frame within `MANUAL_S`.

        Raises:
            ConfigError: it follows.
        """
        if self.mode(head) is Mode.FOLLOWING:
            raise ConfigError("while a target is followed the lens follows it too; let the head stand first")
        self._give(Order("zoom", head, factor=factor), by)

    def home(self, head: str, *, by: str | None = None) -> None:
        """Send a head and its lens home: straight ahead, and the shortest focal length."""
        self._give(Order("home", head), by)

    def stop(self, reason: str) -> None:
        """Stop all heads, and keep them stopped until `clear` or `cotarget clear`; anybody may.

        Raises:
            DeviceError: the stop file cannot be written; this run is stopped all the same.
        """
        with self._lock:
            self.stopped, self._to_clear = reason, False
            self._orders, self._turning, self._zooms = [Order("stop", reason=reason)], {}, []
        if self._rig.spec.real_time:  # a simulation's devices are the run's thread's alone
            self._rig.stop(reason)
        try:
            if self._stop_file is not None:
                write_stop_file(self._stop_file, reason)
        except DeviceError as error:
            raise DeviceError(f"this run is stopped, but no other program is, nor the next run: {error}") from None

    def clear(self, *, by: str | None = None) -> None:
        """End the stop before the next frame; all heads stand then."""
        self._refuse_other(by)
        with self._lock:
            self._to_clear, self._orders, self._turning, self._zooms = True, [], {}, []

    @property
    def recording(self) -> str:
        """Folder of the recording; empty while nothing is recorded."""
        return "" if self._records is None else self._records.folder

    def record(self, on: bool, *, by: str | None = None) -> None:
        """Begin a recording, or complete it.

        A recording begins with a new run, so that its replay knows all that the run does: tracks begin again, and a
        head that followed follows again as soon as there is a track.
        """
        self._refuse_other(by)
        if self._records is None:
            raise ConfigError("this session cannot be recorded")
        if on and self.stopped is not None:  # a new run moves the lens
            raise ConfigError("stopped: nothing moves before Clear")
        with self._lock:
            self._to_record = on

    # Control

    def take(self, who: str) -> None:
        """Give somebody control; the heads of whoever had it stand."""
        with self._lock:
            before, self.control = self.control, who
            if before not in (None, who):
                self._let_stand()

    def leave(self, who: str) -> None:
        """Take control from somebody who has left; a head that he moved by hand stands."""
        with self._lock:
            if self.control == who:
                self.control = None
                self._let_stand(Mode.MANUAL)

    def left_alone(self) -> None:
        """Do as [follow] unattended says when the last page has closed."""
        with self._lock:
            self._let_stand(Mode.MANUAL)
            if self._config.unattended == "stand":
                self._let_stand()

    def _let_stand(self, *modes: Mode) -> None:
        """Let the heads stand, of these modes only if any are given; with the lock held."""
        if not modes or self._run.head.mode in modes or self._turning:
            self._turning, self._zooms = {}, []
            self._orders = [*(each for each in self._orders if each.kind == "stop"), Order("stand", HEAD)]

    def _give(self, order: Order, by: str | None) -> None:
        """Add an order that takes the place of others of its kind."""
        self._refuse_other(by)
        self._check(order.of)
        with self._lock:
            if self.stopped is not None and order.kind != "stand":
                raise ConfigError("stopped: nothing moves before Clear")
            self._idle_since = None
            if order.kind == "zoom":
                self._zooms.append((order, self._now() + MANUAL_S))
                return
            self._turning.pop(order.of, None)
            self._zooms = []
            self._orders = [*(each for each in self._orders if each.kind == "stop"), order]

    def _refuse_other(self, by: str | None) -> None:
        if by is not None and by != self.control:
            raise ControlError("somebody else has control" if self.control else "take control first")

    def _check(self, head: str) -> None:
        if head not in self.heads:
            raise ConfigError(f"there is no head '{head}'; give one of: {', '.join(self.heads)}")

    # The run

    def steps(self, seconds: float) -> Iterator[Step]:
        """Yield the run's steps, for a time on the rig's clock [s]."""
        end, steps = self._rig.clock.now() + seconds, 0
        try:
            while True:
                first = steps
                for step in self._run.follow(end - self._rig.clock.now(), self._due):
                    steps = first + step.index + 1
                    self._notice(step)
                    yield replace(step, index=steps - 1)
                    if self._renewed(step):
                        break
                else:
                    return
        finally:
            self._look.close()

    def _renewed(self, step: Step) -> bool:
        """Begin or complete a recording where that is wanted; return whether there is a new run."""
        with self._lock:
            wanted, self._to_record = self._to_record, None
        if wanted is None or self._records is None or wanted == bool(self._records.folder):
            return False
        before = self._run.head
        try:
            if not wanted:
                self._records.end()
                return False
            self._run = self._records.begin()
        except CotargetError as error:
            self.notice = str(error)
            return False
        order = Order("stand", HEAD)
        if before.mode is Mode.FOLLOWING and before.selector is before.policy:
            order = Order("follow", HEAD)
        elif before.mode is Mode.FOLLOWING and step.target is not None:  # tracks have new numbers
            ahead = step.target.center_px + step.target.velocity_px * CONFIRMED_S
            u, v = np.clip(ahead, 0, np.array(self._rig.fixed.size) - 1).tolist()
            order = Order("follow", HEAD, click=(u, v))
        with self._lock:
            self._orders.insert(0, order)
        return True

    def _due(self) -> list[Order]:
        """Take the orders that the run obeys with the newest frame, and record them."""
        # A rig in real time watches its stop file by itself; that another program has removed it is seen here alone.
        looks = self.stopped is not None or not self._rig.spec.real_time
        in_file = self._look.reason() if looks else None
        there = in_file or self._rig.stopped
        with self._lock:  # a stop that comes meanwhile writes its file after that of the last was removed
            orders, self._orders = self._orders, []
            removed, self._in_file = self._in_file and in_file is None, in_file is not None
            if any(each.kind == "stop" for each in orders):  # later than any Clear
                orders = [each for each in orders if each.kind == "stop"]
            elif (self._to_clear and self._is_file_cleared()) or (self.stopped is not None and removed):
                orders, self.stopped = [Order("clear")], None
            elif self.stopped is None and there is not None:  # by another program
                orders, self.stopped = [Order("stop", reason=there)], there
            self._to_clear = False
            if self.stopped is not None:
                self._turning, self._zooms = {}, []
            orders += self._by_hand()
        if self._records is not None:
            for order in orders:
                self._records.add(order)
        return orders

    def _by_hand(self) -> list[Order]:
        """Orders by hand that hold now, and for each turn that has ended one to stand."""
        orders = [order for order, until in self._zooms if self._now() < until]
        self._zooms = []
        for head, (rates, until) in list(self._turning.items()):
            if self._now() < until:
                orders.append(Order("manual", head, rates=rates))
            else:
                del self._turning[head]
                orders.append(Order("stand", head))
        return orders

    def _is_file_cleared(self) -> bool:
        """Remove the stop file; return whether there is none now."""
        try:
            if self._stop_file is not None:
                clear_stop_file(self._stop_file)
        except CotargetError as error:
            self.notice = str(error)
            return False
        return True

    def _notice(self, step: Step) -> None:
        """Do as [follow] when_idle says once nothing was followed for long enough."""
        if step.state is not State.SEARCHING or self._config.when_idle == "wait":
            self._idle_since = None
            return
        if self._idle_since is None:
            self._idle_since = step.t
        elif step.t - self._idle_since >= self._config.idle_s:
            self._idle_since = None
            with self._lock:
                if self._orders:  # the operator's own count
                    return
                self._orders.append(Order("stand" if self._config.when_idle == "stand" else "home", HEAD))
