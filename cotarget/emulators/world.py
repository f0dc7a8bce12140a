"""The simulated rig in real time, for the emulated devices.

`LiveWorld` runs the simulation: one thread owns the world and its OpenGL context and exposes both cameras. A second
thread only publishes images, through `Feed`s once their latency is over, so that a slow render does not delay the other
camera. The servers' threads command axes and lens (`EmulatedAxis`, `EmulatedLens`).
"""

import contextlib
import heapq
import itertools
import logging
import math
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace

from cotarget.config import RigConfig, SimCamera
from cotarget.emulators.plant import Feed, Picture
from cotarget.emulators.serve import Closes
from cotarget.errors import CotargetError, DeviceError
from cotarget.geometry import RigidTransform
from cotarget.rig import Image
from cotarget.sim.motion import Axis, LensDrive
from cotarget.sim.truth import CameraName, Truth
from cotarget.sim.world import SimWorld

log = logging.getLogger(__name__)


class WallClock:
    """The machine's monotonic clock, from its construction."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> float:
        """Return the seconds since the construction."""
        return time.monotonic() - self._start

    def sleep_until(self, t: float) -> None:
        """Sleep until the clock shows ``t`` [s]."""
        time.sleep(max(t - self.now(), 0.0))

    def monotonic(self, t: float) -> float:
        """Convert a time of this clock [s] to the machine's monotonic time [s]."""
        return self._start + t


class EmulatedAxis:
    """One axis of the simulated head in the steps of a pan-tilt unit; an `AxisPlant`.

    Args:
        axis: of the simulation, in radians.
        clock: the world's.
        step: size of the unit's step, negative if the unit counts the other way [rad].
        delay: from a command to the start of motion [s].
    """

    def __init__(self, axis: Axis, clock: WallClock, step: float, delay: float) -> None:
        self._axis, self._clock, self._step, self._delay = axis, clock, step, delay
        self._stops_at = 0.0
        self._lock = threading.Lock()

    def command(self, goal: int, speed: float, acceleration: float) -> None:
        """Start a move to a goal [steps], at a speed [steps/s] and an acceleration [steps/s^2]."""
        with self._lock:
            t = self._start_time(acceleration)
            self._stops_at = self._axis.command(t, goal * self._step, speed * abs(self._step))

    def halt(self, acceleration: float) -> None:
        """Start braking at an acceleration [steps/s^2]."""
        with self._lock:
            self._stops_at = self._axis.halt(self._start_time(acceleration))

    def position(self) -> int:
        """Return the present position [steps]."""
        return round(self._axis.motor(self._clock.now())[0] / self._step)

    def speed(self) -> float:
        """Return the present speed, signed [steps/s]."""
        return self._axis.motor(self._clock.now())[1] / self._step

    def moving(self) -> bool:
        """Return whether the axis moves, or is about to."""
        return self._clock.now() < self._stops_at

    def _start_time(self, acceleration: float) -> float:
        """Return when a command given now takes effect [s]."""
        if math.isfinite(self._axis.acceleration):
            self._axis.acceleration = acceleration * abs(self._step)
        return self._clock.now() + self._delay


class EmulatedLens:
    """The simulated zoom lens; a `LensPlant`."""

    def __init__(self, drive: LensDrive, clock: WallClock, delay: float) -> None:
        self._drive, self._clock, self._delay = drive, clock, delay
        self._lock = threading.Lock()

    @property
    def last(self) -> int:
        """Number of the last position, counted from 0."""
        return self._drive.last

    def command(self, position: int) -> None:
        """Start a move to a position."""
        with self._lock:
            t = self._clock.now() + self._delay
            self._drive.axis.command(t, float(min(max(position, 0), self.last)))

    def position(self) -> int:
        """Return the present position."""
        return round(self._drive.axis.motor(self._clock.now())[0])


# The world

FIXED_HZ, ZOOM_HZ = 15.0, 10.0  # frame rates that one core renders, with a client on another core
STILL_TIMEOUT = 5.0  # [s]
START_TIMEOUT = 60.0  # time limit to compile the world and open OpenGL on a slow machine [s]
STILL_INDEX = 1_000_000_000  # first frame index of stills, whose noise must differ from the stream's
CHECK_S = 0.25  # period of checking for the end [s]


def paced(config: RigConfig) -> RigConfig:
    """Adapt a configuration to real time: lower frame rates, no shadows, no multisampling, and JPEG by the servers."""
    sim = config.sim
    effects = replace(sim.effects, shadows=False, multisampling=False, jpeg=False)
    fixed = replace(sim.fixed, rate_hz=min(sim.fixed.rate_hz, FIXED_HZ))
    zoom = replace(sim.zoom, rate_hz=min(sim.zoom.rate_hz, ZOOM_HZ))
    return replace(config, sim=replace(sim, effects=effects, fixed=fixed, zoom=zoom))


class LiveWorld(Closes):
    """The simulated world in real time; a context manager.

    Args:
        config: of the rig in real time; see `paced`.
        pan_sign: -1 if the unit counts pan to the left.

    Raises:
        ConfigError: an unknown scene or target.
        DeviceError: the machine cannot render, or the world failed at its first images.
    """

    def __init__(self, config: RigConfig, *, pan_sign: int = 1) -> None:
        self.config = config
        self.feeds: dict[CameraName, Feed] = {"fixed": Feed(), "zoom": Feed()}
        self.clock = WallClock()
        # Requests of stills: time of the exposure [s], and queue for the image.
        self._stills: queue.SimpleQueue[tuple[float, queue.SimpleQueue[Image]]] = queue.SimpleQueue()
        self._due: queue.SimpleQueue[tuple[float, CameraName, Picture] | None] = queue.SimpleQueue()
        self._ended = threading.Event()
        self._failure = ""
        self._started: queue.SimpleQueue[SimWorld | CotargetError] = queue.SimpleQueue()
        self._threads = [
            threading.Thread(target=self._guarded, args=(run,), name=f"world {name}", daemon=True)
            for name, run in (("render", self._render), ("publish", self._publish))
        ]
        for thread in self._threads:
            thread.start()
        try:
            world = self._started.get(timeout=START_TIMEOUT)
        except queue.Empty:
            world = DeviceError(f"the simulated world did not start within {START_TIMEOUT:g} s")
        if isinstance(world, CotargetError):
            self.close()
            raise world
        self._world = world
        head, effects = config.sim.head, config.sim.effects
        step = math.radians(head.step_deg)
        delay = head.command_delay_s if effects.command_delay else 0.0
        self.pan = EmulatedAxis(world.head_drive.pan, self.clock, step * pan_sign, delay)
        self.tilt = EmulatedAxis(world.head_drive.tilt, self.clock, step, delay)
        self.lens = EmulatedLens(world.lens_drive, self.clock, delay)

    def check(self) -> None:
        """Raise if the world has failed; its feeds then publish nothing more.

        Raises:
            DeviceError: the world has failed; the message says why.
        """
        if self._failure:
            raise DeviceError(self._failure)

    def still(self) -> Image:
        """Take an image with the zoom camera now, (H, W, 3) BGR.

        Raises:
            DeviceError: the world has ended, failed, or took no image within `STILL_TIMEOUT`.
        """
        self.check()
        answer: queue.SimpleQueue[Image] = queue.SimpleQueue()
        self._stills.put((self.clock.now(), answer))
        try:
            return answer.get(timeout=STILL_TIMEOUT)
        except queue.Empty:
            raise DeviceError(f"the simulated world took no still within {STILL_TIMEOUT:g} s") from None

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        """Put the board at a pose; None removes it."""
        self._world.rig.board.present(T_fixed_board)

    def swing(self, T_fixed_board: RigidTransform) -> None:
        """Swing the board about a pose."""
        self._world.rig.board.swing(T_fixed_board)

    def head_truth(self) -> tuple[float, float]:
        """Return the true pan and tilt of the platform now [rad], independent of the unit's count."""
        return self._world.head_drive.angles_at(self.clock.now())

    def truth(self) -> Truth:
        """Return the ground truth, also of past times."""
        return self._world.truth()

    def close(self) -> None:
        """End the threads and release the renderer; may be called again."""
        self._ended.set()
        self._due.put(None)
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    def _guarded(self, run: Callable[[], None]) -> None:
        """Run a thread; its failure is passed to the constructor and to later calls of `check`."""
        try:
            run()
        except Exception as error:
            log.debug("the simulated world failed", exc_info=True)
            known = isinstance(error, CotargetError)
            self._failure = str(error) if known else f"the simulated world failed: {error!r}"
            self._started.put(error if isinstance(error, CotargetError) else DeviceError(self._failure))

    def _render(self) -> None:
        """Make the world and render it until the end."""
        with contextlib.closing(SimWorld(self.config, self.clock)) as world:
            sim = self.config.sim
            cameras: dict[CameraName, SimCamera] = {"fixed": sim.fixed, "zoom": sim.zoom}
            for name in cameras:
                world.expose(name, 0, 0.0)  # each camera's first render compiles shaders, which takes seconds
            self._started.put(world)
            self._expose_frames(world, cameras)

    def _expose_frames(self, world: SimWorld, cameras: Mapping[CameraName, SimCamera]) -> None:
        """Expose both cameras at their rates, and stills on request."""
        latency = self.config.sim.effects.latency
        next_index = {name: math.ceil(self.clock.now() * camera.rate_hz) for name, camera in cameras.items()}
        numbers = itertools.count(STILL_INDEX)
        while not self._ended.is_set():
            try:
                t, answer = self._stills.get_nowait()
            except queue.Empty:
                pass
            else:
                answer.put(world.expose("zoom", next(numbers), t))
                continue
            name = min(next_index, key=lambda n: next_index[n] / cameras[n].rate_hz)
            index, rate = next_index[name], cameras[name].rate_hz
            t = index / rate
            wait = t - self.clock.now()
            if wait > 0:
                self._ended.wait(min(wait, CHECK_S))
                continue
            picture = Picture(world.expose(name, index, t), index, self.clock.monotonic(t))
            self._due.put((t + (cameras[name].latency_s if latency else 0.0), name, picture))
            # A world that cannot keep up drops frames; those that it publishes have their true times.
            next_index[name] = max(index + 1, math.ceil(self.clock.now() * rate - 1))

    def _publish(self) -> None:
        """Publish images when they are due."""
        waiting: list[tuple[float, int, CameraName, Picture]] = []
        while not self._ended.is_set():
            wait = waiting[0][0] - self.clock.now() if waiting else None
            if wait is not None and wait <= 0:
                _, _, name, picture = heapq.heappop(waiting)
                self.feeds[name].publish(picture)
                continue
            try:
                item = self._due.get(timeout=wait)
            except queue.Empty:
                continue
            if item is not None:
                t, name, picture = item
                heapq.heappush(waiting, (t, picture.index, name, picture))
