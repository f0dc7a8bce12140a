"""A rig that notes every call on it and every answer, in order; it changes neither."""

import threading
from collections.abc import Callable
from types import TracebackType
from typing import TypeVar

from cotarget.geometry import RigidTransform
from cotarget.recordformat import FIXED, ZOOM, Event, Number, RigFacts, facts_table, move_args
from cotarget.recordwriter import RecordWriter
from cotarget.rig import (
    Board,
    Camera,
    Clock,
    Frame,
    PanTilt,
    PanTiltLimits,
    PanTiltState,
    Rig,
    Speed,
    ZoomCamera,
    ZoomState,
)

T = TypeVar("T")


class _Notebook:
    """Where all of a rig's devices note their calls; the thread that opens it is the run's own."""

    def __init__(self, clock: Clock, writer: RecordWriter) -> None:
        self._clock, self._writer, self._thread = clock, writer, threading.get_ident()

    def ask(
        self, call: str, args: tuple[Number, ...], answer: Callable[[], T], numbers: Callable[[T], tuple[Number, ...]]
    ) -> T:
        """Call and note what came of it."""
        return self._ask(call, args, answer, lambda given: (numbers(given), "", None))

    def look(self, call: str, camera: str, args: tuple[Number, ...], answer: Callable[[], Frame]) -> Frame:
        """Ask for a frame and note it with its image."""
        return self._ask(call, args, answer, lambda frame: ((frame.t,), camera, frame))

    def _ask(
        self,
        call: str,
        args: tuple[Number, ...],
        answer: Callable[[], T],
        parts: Callable[[T], tuple[tuple[Number, ...], str, Frame | None]],
    ) -> T:
        aside = threading.get_ident() != self._thread
        if aside and call == "clock.now":  # a watchdog asks for it all the time
            return answer()
        try:
            given = answer()
        except Exception as error:
            failure = (type(error).__name__, str(error))
            self._writer.put(Event(call, self._clock.now(), args, error=failure, aside=aside))
            raise
        result, camera, frame = parts(given)
        at = float(result[0] or 0.0) if call == "clock.now" else self._clock.now()
        event = Event(call, at, args, result, aside=aside)
        self._writer.put(event, camera, None if frame is None else frame.image)
        return given


class _Camera:
    def __init__(self, camera: Camera, notes: _Notebook, name: str) -> None:
        self._camera, self._notes, self._name = camera, notes, name

    @property
    def size(self) -> tuple[int, int]:
        return self._camera.size

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        args = (newer_than, timeout)
        return self._notes.look(f"{self._name}.read", self._name, args, lambda: self._camera.read(newer_than, timeout))


class _ZoomCamera(_Camera):
    def __init__(self, camera: ZoomCamera, notes: _Notebook) -> None:
        super().__init__(camera, notes, ZOOM)
        self._lens = camera

    @property
    def still_size(self) -> tuple[int, int]:
        return self._lens.still_size

    @property
    def focal_range(self) -> tuple[float, float]:
        return self._lens.focal_range

    def zoom(self, focal_px: float) -> float:
        return self._notes.ask("zoom.zoom", (focal_px,), lambda: self._lens.zoom(focal_px), lambda reached: (reached,))

    def state(self) -> ZoomState:
        return self._notes.ask(
            "zoom.state", (), self._lens.state, lambda state: (state.focal_px, state.moving, state.t)
        )

    def capture(self) -> Frame:
        return self._notes.look("zoom.capture", ZOOM, (), self._lens.capture)


class _Head:
    def __init__(self, head: PanTilt, notes: _Notebook) -> None:
        self._head, self._notes = head, notes

    @property
    def limits(self) -> PanTiltLimits:
        return self._head.limits

    def state(self) -> PanTiltState:
        return self._notes.ask(
            "head.state", (), self._head.state, lambda state: (state.pan, state.tilt, state.moving, state.t)
        )

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        args = move_args(pan, tilt, speed, wait)
        return self._notes.ask("head.move", args, lambda: self._head.move(pan, tilt, speed, wait), lambda both: both)

    def halt(self) -> None:
        self._notes.ask("head.halt", (), self._head.halt, lambda _: ())


class _Clock:
    def __init__(self, clock: Clock, notes: _Notebook) -> None:
        self._clock, self._notes = clock, notes

    def now(self) -> float:
        return self._notes.ask("clock.now", (), self._clock.now, lambda t: (t,))

    def sleep_until(self, t: float) -> None:
        self._notes.ask("clock.sleep_until", (t,), lambda: self._clock.sleep_until(t), lambda _: ())


class _Board:
    def __init__(self, board: Board, notes: _Notebook) -> None:
        self._board, self._notes = board, notes

    @property
    def patience(self) -> float:
        return self._board.patience

    def present(self, T_fixed_board: RigidTransform | None) -> None:
        args = () if T_fixed_board is None else _numbers(T_fixed_board)
        self._notes.ask("board.present", args, lambda: self._board.present(T_fixed_board), lambda _: ())

    def swing(self, T_fixed_board: RigidTransform) -> None:
        args = _numbers(T_fixed_board)
        self._notes.ask("board.swing", args, lambda: self._board.swing(T_fixed_board), lambda _: ())


def _numbers(T: RigidTransform) -> tuple[float, ...]:
    return tuple(float(v) for v in (*T.translation, *T.rotation.as_rotvec()))


class RecordingRig:
    """Any rig, with everything noted that is asked of its devices and what they answer.

    It belongs below the safety layer, next to the devices, so that what is noted is what they really did.
    """

    def __init__(self, rig: Rig, writer: RecordWriter) -> None:
        self._rig = rig
        try:
            zoom = rig.zoom
            self.real_time = bool(getattr(rig, "real_time", False))
            facts = RigFacts(
                rig.fixed.size, zoom.size, zoom.still_size, zoom.focal_range, rig.head.limits, self.real_time
            )
            writer.put({"rig": facts_table(facts)})
        except BaseException:
            rig.close()
            raise
        notes = _Notebook(rig.clock, writer)
        self.fixed: Camera = _Camera(rig.fixed, notes, FIXED)
        self.zoom: ZoomCamera = _ZoomCamera(rig.zoom, notes)
        self.head: PanTilt = _Head(rig.head, notes)
        self.clock: Clock = _Clock(rig.clock, notes)
        self.board: Board = _Board(rig.board, notes)

    def close(self) -> None:
        """Close the rig, which halts its head."""
        self._rig.close()

    def __enter__(self) -> "RecordingRig":
        """Give the rig itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Halt, then close."""
        self.close()
