"""Safety layer in front of any Rig: soft limits, speed cap, watchdog, emergency stop, frame age, halt at every exit.

It runs in the same process as the program that it watches. It cannot act when that process is killed at once (SIGKILL),
frozen (SIGSTOP; on Ctrl-Z, another signal, the head is halted first), or blocked by a C library that holds Python's
interpreter lock. The head then ends at the goal of its last command, which lies within the soft limits.
"""

from typing import TYPE_CHECKING, Any

from cotarget.safety.signals import end_politely
from cotarget.safety.stop_file import clear_stop_file, refuse_if_stopped, stop_reason, write_stop_file

if TYPE_CHECKING:
    from cotarget.safety.safe_rig import SafeRig
    from cotarget.safety.watchdog import StopLook

__all__ = [
    "SafeRig",
    "StopLook",
    "clear_stop_file",
    "end_politely",
    "refuse_if_stopped",
    "stop_reason",
    "write_stop_file",
]


def __getattr__(name: str) -> Any:
    # Imported on demand: these import numpy and SciPy, and `cotarget stop` must start fast.
    if name == "SafeRig":
        from cotarget.safety.safe_rig import SafeRig

        return SafeRig
    if name == "StopLook":
        from cotarget.safety.watchdog import StopLook

        return StopLook
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
