"""Faults that can be switched on in an emulated device while it runs."""

import threading
from collections.abc import Iterable

from cotarget.errors import ConfigError, choices


class Faults:
    """Which of a device's faults are on; safe to use from any thread.

    Args:
        known: the names of all faults that the device has.
    """

    def __init__(self, known: Iterable[str]) -> None:
        self._known = frozenset(known)
        self._active = set[str]()  # no annotation: a method is named as the type
        self._changed = threading.Condition()

    @property
    def known(self) -> frozenset[str]:
        """The names of all faults that the device has."""
        return self._known

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
        """Whether a fault is on; asking for one that the device does not have is a mistake in the device."""
        assert name in self._known, name
        with self._changed:
            return name in self._active

    def take(self, name: str) -> bool:
        """Whether a fault is on, and switch it off: for those that happen once."""
        assert name in self._known, name
        with self._changed:
            on = name in self._active
            self._active.discard(name)
            return on

    def wait_while(self, name: str, timeout: float) -> bool:
        """Wait until a fault is off, at most ``timeout`` [s]; whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: name not in self._active, timeout)
