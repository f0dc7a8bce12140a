"""Wraps any Rig: soft limits, a speed cap, a watchdog, an emergency stop, no stale frames, halt on every way out.

What it cannot do: it lives in the same process as the program that it watches. Where that process is killed at once
(SIGKILL), frozen (SIGSTOP; Ctrl-Z is another signal, at which the head is halted first), or held by a C library that
keeps Python's lock, nothing runs here; the head then ends at the goal of its last command, which lies within the soft
limits.
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
    # These import numpy and SciPy, for which `cotarget stop` must not wait.
    if name == "SafeRig":
        from cotarget.safety.safe_rig import SafeRig

        return SafeRig
    if name == "StopLook":
        from cotarget.safety.watchdog import StopLook

        return StopLook
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
