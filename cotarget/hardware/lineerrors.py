"""What goes wrong with a line to a PTU-D46, but for answers that are no good."""

from cotarget.errors import DeviceError

NO_DATA = "returned no data"  # pyserial, of a port that has gone


class SilentError(DeviceError):
    """No answer came in time."""


class LostError(DeviceError):
    """The port itself failed: unplugged, or closed by the other side."""

    def __init__(self, name: str, error: OSError) -> None:
        why = "unplugged, or another program reads there too" if NO_DATA in str(error) else error
        super().__init__(f"the line to the pan-tilt unit at {name} is lost ({why}); plug it in and open it again")


class RestartedError(DeviceError):
    """The unit was switched off and on, and has forgotten where it is."""

    def __init__(self, name: str) -> None:
        super().__init__(
            f"the pan-tilt unit at {name} was switched off and on, so that its position may be lost; open it again"
        )
