"""Emergency stop across processes: while a certain file exists, the head does not move; the file holds the reason."""

import os
from pathlib import Path

from cotarget.errors import ConfigError, DeviceError, EmergencyStopError

NO_REASON = "no reason given"
LONGEST_REASON = 200  # shown part of the file's first line [characters]


def stop_reason(path: Path | None) -> str | None:
    """Read why the head must not move; None if it may.

    An unreadable file also stops the head, because it may be a stop. Opening a pipe does not block. A file system that
    hangs blocks this call (see `cotarget.safety.watchdog`).
    """
    if path is None:
        return None
    try:
        with open(path, "rb", buffering=0, opener=_without_waiting) as file:
            content = file.read(4 * LONGEST_REASON) or b""  # UTF-8 takes at most 4 bytes per character
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        return f"the file cannot be read: {error.strerror}"
    lines = content.decode("utf-8", "replace").strip().splitlines()
    said = "".join(c if c.isprintable() else " " for c in lines[0])[:LONGEST_REASON].strip() if lines else ""
    return said or NO_REASON


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def refuse_if_stopped(path: Path | None) -> None:
    """Raise while the stop file exists, or if it could not be made.

    Raises:
        EmergencyStopError: the file exists; the message has the reason, and how to clear it.
        ConfigError: its folder does not exist.
    """
    if path is not None and not path.parent.is_dir():
        raise ConfigError(f"{path}: nobody could stop the head by this file: {_no_folder(path)}")
    if (reason := stop_reason(path)) is not None:
        raise stopped_by_file(path, reason)


def stopped_by_file(path: Path | None, reason: str) -> EmergencyStopError:
    """Make the error with the reason of the stop, and how to clear it."""
    return EmergencyStopError(
        f"emergency stop: {reason}; when it is safe to move, run 'cotarget clear --rig FILE' or remove {path}"
    )


def _no_folder(path: Path) -> str:
    return f"there is no folder {path.parent}; make it, or correct stop_file in [safety] of rig.toml"


def write_stop_file(path: Path, reason: str) -> None:
    """Stop every rig that watches this file; a reader finds the whole reason or no file.

    Raises:
        DeviceError: the file cannot be made, so nothing is stopped.
    """
    if not path.parent.is_dir():  # a folder made here would stop no rig: none opens without it
        raise DeviceError(f"{path}: NOT stopped: {_no_folder(path)}")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        try:
            with temporary.open("w", encoding="utf-8") as file:
                file.write(f"{reason}\n")
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except OSError:
            temporary.unlink(missing_ok=True)
            path.touch()  # a full disk still takes an empty file
    except OSError as error:
        raise DeviceError(f"{path}: NOT stopped: the file cannot be written: {error.strerror}") from None


def clear_stop_file(path: Path) -> str | None:
    """End the stop; return its reason, or None if there was none.

    The file whose reason is returned is the one removed: a stop that is written meanwhile stays.

    Raises:
        DeviceError: the file cannot be removed, so the stop lasts.
    """
    taken = path.with_name(f".{path.name}.{os.getpid()}.cleared")
    try:
        if path.is_dir():
            raise DeviceError(f"{path}: is a folder, and stops the head as a file does; remove it")
        path.rename(taken)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise DeviceError(f"{path}: still stopped: the file cannot be removed: {error.strerror}") from None
    reason = stop_reason(taken)
    taken.unlink(missing_ok=True)
    return reason
