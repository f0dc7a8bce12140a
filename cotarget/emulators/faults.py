"""Faults of an emulated device that can be switched on while it runs."""

import threading
from collections.abc import Iterable

from cotarget.errors import ConfigError, choices


class Faults:
    """The active faults of a device; safe to use from any thread.

    Args:
        known: names of all faults that the device has.
    """

    def __init__(self, known: Iterable[str]) -> None:
        self._known = frozenset(known)
        self._active = set[str]()  # no annotation: the method set hides the type
        self._changed = threading.Condition()

    def set(self, name: str, on: bool = True) -> None:
        """Switch a fault on or off.

        Raises:
            ConfigError: the device has no such fault.
        """
        if name not in self._known:
            raise ConfigError(f"unknown fault '{name}'; valid here: {choices(self._known)}")
        with self._changed:
            (self._active.add if on else self._active.discard)(name)
            self._changed.notify_all()

    def __contains__(self, name: str) -> bool:
        """Return whether a fault is on; a name that the device does not have is a bug in the device."""
        assert name in self._known, name
        with self._changed:
            return name in self._active

    def take(self, name: str) -> bool:
        """Return whether a fault is on, and switch it off: for faults that happen once."""
        with self._changed:
            on = name in self._active
            self._active.discard(name)
            return on

    def wait_while(self, name: str, timeout: float) -> bool:
        """Wait until a fault is off, at most ``timeout`` [s]; return whether it is off."""
        with self._changed:
            return self._changed.wait_for(lambda: name not in self._active, timeout)
