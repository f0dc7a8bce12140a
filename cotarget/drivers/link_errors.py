"""Errors of the link to a pan-tilt unit, which a driver raises and `PolledHead` acts on."""

from cotarget.errors import DeviceError

NO_DATA = "returned no data"  # pyserial's text for a port that has disappeared


class InUseError(DeviceError):
    """Another program uses the device."""


class NoPermissionError(DeviceError):
    """This user has no permission to use the device."""


class SilentError(DeviceError):
    """The unit did not answer in time."""


class AwayError(SilentError):
    """Nothing listens at the unit's address: it has gone, or starts anew."""


class ReplyError(DeviceError):
    """What arrived is no answer of the unit to the command."""


class RefusedError(DeviceError):
    """The unit understood a command and refused it."""


class LostError(DeviceError):
    """The port itself failed: unplugged, or closed by the other side."""

    def __init__(self, name: str, error: OSError) -> None:
        why = "unplugged, or another program reads there too" if NO_DATA in str(error) else error
        super().__init__(f"the line to the pan-tilt unit at {name} is lost ({why}); plug it in and open it again")


class CutError(DeviceError):
    """The unit was silent, and the link halted it before it answered again."""


class PositionLostError(DeviceError):
    """The unit's position may be lost; the head must not move before its reset."""

    def __init__(self, name: str, what: str) -> None:
        super().__init__(f"the pan-tilt unit at {name} {what}; see that it is free, then run cotarget reset-head")
