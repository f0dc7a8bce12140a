"""Emergency stop across processes by a file: while it exists, the head does not move; it holds the reason.

A program that watches a stop file keeps a locked file in the user's state folder that names it, so that `cotarget stop`
finds every open rig. The lock ends with the program, however it ends.
"""

import contextlib
import fcntl
import logging
import math
import os
import re
import threading
import time
import tomllib
import weakref
from collections.abc import Callable
from pathlib import Path
from time import monotonic

from cotarget.errors import ConfigError, DeviceError, EmergencyStopError

log = logging.getLogger(__name__)
STATE_HOME, STATE_HOME_DEFAULT = "XDG_STATE_HOME", "~/.local/state"  # XDG base directory specification
WATCHING = "watching-"  # begins the names of the files that name watched stop files
# Age from which such a file without a lock counts as left over; a younger one may be about to be locked [s].
LEFT_OVER_S = 60.0
NO_REASON = "no reason given"
LONGEST_REASON = 200  # shown part of the file's first line [characters]
SUFFIX = ".stop"  # of the default stop file
# Lines of a file that is no valid TOML, which still say where the stop file is.
STOP_FILE_LINE = r"""^[^#\n]*\bstop_file[ \t]*=[ \t]*(?:(["'])([^"'\n]+)\1|(false)\b)?"""
HARDWARE_LINE = r"""^[ \t]*backend[ \t]*=[ \t]*["']hardware["']"""


def locate_stop_file(rig: Path, backend: object, said: object) -> Path | None:
    """Locate the stop file of a rig.toml: commands, the guard and the position-lost marker use this path.

    Args:
        rig: path of the rig.toml; a relative path is relative to its folder.
        backend: its `backend`.
        said: its `stop_file`; None where it has none, and False to do without one.

    Returns:
        The path, absolute, because the program may change its working directory; None for none. By default a rig of
        real devices has RIG.stop beside rig.toml, or beside the file that rig.toml links to, and another rig has none.
    """
    rig = rig.absolute()
    if isinstance(said, str) and "\0" in said:
        raise ConfigError(f"{rig}: safety.stop_file: {said!r} is no name of a file")
    if said is None:
        if backend != "hardware":
            return None
        return (rig.resolve() if rig.is_symlink() else rig).with_suffix(SUFFIX)
    return rig.parent / said if isinstance(said, str) else None


def find_stop_file(rig: Path) -> Path:
    """Find the stop file of a rig.toml, even in one that is invalid otherwise; or that of a simulation with a page.

    Raises:
        ConfigError: the file cannot be read, or the rig has no stop file.
    """
    by_hand = "the rig's stop file itself can be made and removed by hand"
    try:
        text = rig.read_bytes().decode("utf-8-sig", "replace")
    except OSError as error:
        if isinstance(error, FileNotFoundError) and (path := _stop_file_of_session(rig)) is not None:
            return path
        raise ConfigError(f"{rig}: {error.strerror}; {by_hand}") from None
    try:
        tables = tomllib.loads(text)
        backend, safety = tables.get("backend"), tables.get("safety")
        said = safety.get("stop_file") if isinstance(safety, dict) else None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        lines = re.findall(STOP_FILE_LINE, text, re.MULTILINE)
        backend = "hardware" if re.search(HARDWARE_LINE, text, re.MULTILINE) else None
        said = (lines[0][1] or (False if lines[0][2] else "")) if len(lines) == 1 else None
        if said == "" or len(lines) > 1 or not (lines or backend):
            raise ConfigError(f"{rig}: is not TOML: {error}; {by_hand}") from None
    if not isinstance(said, str | None) and said is not False:
        raise ConfigError(f'{rig}: safety.stop_file: {said!r} is not a text; name a file, as "stop"')
    path = locate_stop_file(rig, backend, said) or _stop_file_of_session(rig)
    if path is None or path.name in ("", "..") or path == rig.absolute().parent:
        raise ConfigError(f'{rig}: has no stop file; give one: [safety] stop_file = "stop"')
    return path


def session_stop_file(rig: Path) -> Path:
    """Return the stop file that a simulation has while it is steered from a page: RIG.stop beside rig.toml."""
    path = locate_stop_file(rig, "hardware", None)
    assert path is not None, "that of real devices"
    return path


def _stop_file_of_session(rig: Path) -> Path | None:
    """Return that file if it stops the simulation, or if a program watches it; else None."""
    path = session_stop_file(rig)
    return path if path.exists() or same_place(path) in watched_stop_files() else None


def stop_reason(path: Path | None) -> str | None:
    """Read why the head must not move; None if it may.

    An unreadable file also stops the head, because it may be a stop. Opening a pipe does not block, but a file system
    that hangs blocks this call (see `StopLook`).
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
        ConfigError: its folder does not exist, or cannot be written.
    """
    if path is None:
        return
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: the head could not be stopped by this file: {_no_folder(path)}")
    if not os.access(path.parent, os.W_OK):
        raise ConfigError(
            f"{path}: the head could not be stopped by this file: {path.parent} cannot be written; allow it, or name a "
            "file elsewhere: stop_file in [safety] of rig.toml"
        )
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


# The stop files that programs watch


def state_folder() -> Path:
    """Return the folder of what one program of this user leaves for another."""
    return Path(os.environ.get(STATE_HOME) or STATE_HOME_DEFAULT).expanduser().absolute() / "cotarget"


def same_place(path: Path) -> Path:
    """Return one spelling of all paths of a file."""
    return path.parent.resolve() / path.name


def _announce(path: Path | None) -> Callable[[], None]:
    """Make the locked file by which `watched_stop_files` finds a stop file; return what removes it.

    A failure is logged.
    """
    import tempfile

    made = contextlib.ExitStack()
    try:
        if path is not None:
            (folder := state_folder()).mkdir(parents=True, exist_ok=True)
            descriptor, name = tempfile.mkstemp(prefix=WATCHING, dir=folder)
            made.callback(os.close, descriptor)
            made.callback(Path(name).unlink, missing_ok=True)
            os.write(descriptor, os.fsencode(same_place(path)))
            fcntl.flock(descriptor, fcntl.LOCK_EX)
    except (OSError, RuntimeError) as error:  # a user may have no home
        log.warning("%s: is watched, but only 'cotarget stop --rig' finds it: %s", path, error)
    return made.close


def watched_stop_files() -> set[Path]:
    """Find the stop files that running programs of this user watch, each by `same_place`."""
    found, files = set(), list[Path]()
    with contextlib.suppress(RuntimeError):  # there is no home
        files += state_folder().glob(f"{WATCHING}*")
    for each in files:
        with contextlib.suppress(OSError), each.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                found.add(Path(os.fsdecode(file.read())))
            else:
                if time.time() - each.stat().st_mtime > LEFT_OVER_S:
                    each.unlink()
    return found


# Reading the file from a program that must not wait for it

LOOK_POLL_S = 0.05  # reading the stop file takes well below 1 ms; the answer is awaited in slices of this time [s]
MOST_MISSED = 6  # slices without an answer after which the file counts as a stop; a suspended machine misses none
# Age up to which a command trusts an answer; the watchdog halts the head for a newer file [s].
RECENT_S = 2 * LOOK_POLL_S
LOOK_JOIN_S = 0.2  # time limit for the thread to end, which a hanging file may block [s]


class StopLook:
    """Reader of the stop file, with a time limit that does not depend on the file system.

    Args:
        path: of the stop file; None for none, which never stops.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._withdraw = weakref.finalize(self, _announce(path))
        self._changed = threading.Condition()
        self._asked = self._answered = self._missed = 0
        self._reason: str | None = None
        self._looked_at = -math.inf
        self._thread: threading.Thread | None = None
        self._closed = False

    def reason(self, longest: float | None = None) -> str | None:
        """Read the stop file, beginning now; return the reason of a stop, or None.

        A file that does not answer counts as a stop.

        Args:
            longest: how long to wait for a new answer before the last one is returned [s]; None to wait for it.
        """
        if self._path is None or self._closed:
            return self._reason
        with self._changed:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="cotarget-stop-file", daemon=True)
                self._thread.start()
            self._asked += 1
            question = self._asked
            self._changed.notify_all()
            while True:
                wait = LOOK_POLL_S if longest is None else min(longest, LOOK_POLL_S)
                if self._changed.wait_for(lambda: self._answered >= question, wait):
                    return self._reason
                self._missed += wait == LOOK_POLL_S
                if self._missed >= MOST_MISSED:
                    return f"the stop file cannot be looked at: no answer within {MOST_MISSED * LOOK_POLL_S:g} s"
                if longest is not None:
                    return self._reason

    def is_clear(self) -> bool:
        """Return at once whether a recent answer found no stop."""
        with self._changed:
            return self._path is None or (self._reason is None and monotonic() - self._looked_at <= RECENT_S)

    def close(self) -> None:
        """End the thread; a thread that the file blocks ends when the file answers."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(LOOK_JOIN_S)
        with contextlib.suppress(OSError):
            self._withdraw()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._asked > self._answered)
                if self._closed:
                    return
                question = self._asked
            begun = monotonic()
            try:
                reason = stop_reason(self._path)
            except Exception as error:  # an unreadable file counts as a stop
                reason = f"the file cannot be read: {error}"
            with self._changed:
                self._answered, self._reason, self._missed, self._looked_at = question, reason, 0, begun
                self._changed.notify_all()
