"""A rig whose zoom camera looks by full stills: what calibration wants where the stream is a small preview."""

from types import TracebackType

from cotarget.errors import StaleFrameError
from cotarget.rig import Board, Camera, Clock, Frame, PanTilt, Rig, ZoomCamera, ZoomState


def with_stills(rig: Rig) -> Rig:
    """The same rig, seen by full stills; itself, where its stills are no larger than its stream."""
    return rig if rig.zoom.still_size == rig.zoom.size else _StillsRig(rig)


class StillCamera:
    """A zoom camera whose every frame is a full still; its focal lengths are in the still's pixels."""

    def __init__(self, camera: ZoomCamera, clock: Clock) -> None:
        self._camera, self._clock = camera, clock
        self._factor = camera.still_size[0] / camera.size[0]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of a still [px]."""
        return self._camera.still_size

    @property
    def still_size(self) -> tuple[int, int]:
        """The same."""
        return self._camera.still_size

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest focal length [px]."""
        shortest, longest = self._camera.focal_range
        return shortest * self._factor, longest * self._factor

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Take a still, after ``newer_than`` [s] if that is still to come, however long the camera needs for it.

        Raises:
            StaleFrameError: that is farther away than ``timeout`` [s].
        """
        if newer_than is not None:
            if (ahead := newer_than - self._clock.now()) > timeout:
                raise StaleFrameError(f"a still is wanted of {ahead:.2f} s from now, and within {timeout:g} s")
            self._clock.sleep_until(newer_than)
        return self._camera.capture()

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving; the focal length [px] that it will reach."""
        return self._camera.zoom(focal_px / self._factor) * self._factor

    def state(self) -> ZoomState:
        """The lens's state now."""
        state = self._camera.state()
        return ZoomState(state.focal_px * self._factor, state.moving, state.t)

    def capture(self) -> Frame:
        """Take a still."""
        return self._camera.capture()


class _StillsRig:
    """A rig with another zoom camera in front of its own."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.fixed: Camera = rig.fixed
        self.zoom: ZoomCamera = StillCamera(rig.zoom, rig.clock)
        self.head: PanTilt = rig.head
        self.clock: Clock = rig.clock
        self.board: Board = rig.board

    def close(self) -> None:
        """Close the rig."""
        self._rig.close()

    def __enter__(self) -> "_StillsRig":
        """Give the rig itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()
