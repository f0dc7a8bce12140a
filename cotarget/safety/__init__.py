"""Wraps any Rig: soft limits, a speed cap, a watchdog, an emergency stop, no stale frames, halt on every way out.

What it cannot do: it lives in the same process as the program that it watches. Where that process is killed at once
(SIGKILL), frozen (SIGSTOP; Ctrl-Z is another signal, at which the head is halted first), or held by a C library that
keeps Python's lock, nothing runs here; the head then ends at the goal of its last command, which lies within the soft
limits.
"""

from typing import TYPE_CHECKING, Any

from cotarget.safety.signals import end_politely
from cotarget.safety.stopfile import clear_stop_file, refuse_if_stopped, stop_reason, write_stop_file
from cotarget.safety.stoplook import StopLook

if TYPE_CHECKING:
    from cotarget.safety.saferig import SafeRig

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
    # What SafeRig needs takes a second to import, by which `cotarget stop` would come later.
    if name == "SafeRig":
        from cotarget.safety.saferig import SafeRig

        globals()[name] = SafeRig  # found without asking from now on, by documentation tools too
        return SafeRig
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
