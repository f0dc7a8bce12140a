"""What the thread of a gphoto2 camera shares with those who use the camera."""

import math
import threading
from concurrent.futures import Future
from dataclasses import dataclass, field

from cotarget.errors import DeviceError
from cotarget.hardware.lens import LensMotion
from cotarget.rig import Frame


@dataclass
class Desk:
    """What the camera's thread shares with others, who hold ``changed`` to look at it or to change it.

    Attributes:
        changed: told of every change.
        frame: the newest of the viewfinder.
        arrived: when it did [s].
        wanted: the position that the lens is to have.
        order: counts the lens's commands.
        standing: whether the lens has taken the last of them.
        motion: where the lens is; None before the camera is open.
        lens_trouble: why the lens does not do what it was told; empty if it does.
        called: whether the camera's thread has something new to do.
        still: who waits for a still.
        trouble: what keeps frames from coming; empty while they come.
        dropped: frames that were broken, late or of another size.
        gone: why the camera cannot be used any more; empty while it can.
    """

    changed: threading.Condition = field(default_factory=threading.Condition)
    frame: Frame | None = None
    arrived: float = -math.inf
    wanted: int = 0
    order: int = 0
    standing: bool = True
    motion: LensMotion | None = None
    lens_trouble: str = ""
    called: bool = False
    still: "Future[Frame] | None" = None
    trouble: str = ""
    dropped: int = 0
    gone: str = ""

    def dismiss(self, why: str) -> None:
        """Let everybody know that the camera cannot be used any more."""
        with self.changed:
            self.gone, self.called = self.gone or why, True
            still, self.still = self.still, None
            self.changed.notify_all()
        if still is not None and not still.done():
            still.set_exception(DeviceError(why))
