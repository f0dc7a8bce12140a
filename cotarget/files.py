"""Files that appear under their name only when complete, and that one run at a time writes.

Where the files that come with cotarget lie.

Files that are either the old one or the new one, never half of one.

Signals that would end the program, held back while what must not stay half done is done: a halt, a file's end.
"""

import contextlib
import csv
import fcntl
import os
import signal
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from cotarget.errors import CalibrationError, ConfigError, CotargetError


def assets_dir() -> Path:
    """The folder sim_assets: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).parent
    inside = package / "sim_assets"
    return inside if inside.is_dir() else package.parent / "sim_assets"


# --- atomic ---


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file's content in one step, also when the program or the power fails half-way.

    Raises:
        CalibrationError: the file cannot be written, or another run is writing it.
    """
    try:
        write_whole(path, data)
    except ConfigError as error:
        raise CalibrationError(str(error)) from None


# --- heldsignals ---

# Signals that would end the process on the spot: a polite request, a terminal or connection that has gone, Ctrl-\.
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name))
HELD = (signal.SIGINT, *ENDING)
# So many signals end even that, once they are let: a wait for devices or disks that do not answer.
IMPATIENCE = 3


class HeldSignals:
    """Keeps Ctrl-C and SIGTERM back; they are delivered afterwards.

    Only the main thread gets signals, so elsewhere there is nothing to hold.
    """

    def __init__(self) -> None:
        self.pending: list[int] = []
        self._previous: dict[int, Any] = {}
        self._may_hurry = False

    def hold(self) -> None:
        """From now on note signals; may be called again where a signal cut it short."""
        if threading.current_thread() is not threading.main_thread():
            return
        for number in HELD:
            previous = signal.getsignal(number)
            if number not in self._previous and previous not in (None, signal.SIG_IGN, self._note):
                self._previous[number] = previous
                signal.signal(number, self._note)

    def let_hurry(self) -> None:
        """From now on enough signals end the wait, as after the head's halt."""
        self._may_hurry = True

    def restore(self) -> None:
        """Put the former handlers back."""
        while self._previous:
            number, previous = self._previous.popitem()
            if signal.getsignal(number) == self._note:
                signal.signal(number, previous)

    def deliver(self) -> None:
        """Let the signal act that was held back, if there was one."""
        if self.pending:
            signal.raise_signal(self.pending[0])

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.pending.append(number)
        if self._may_hurry and len(self.pending) >= IMPATIENCE:
            raise KeyboardInterrupt


# A small file is written in less, so that who finds it being written waits for it, for so long at most [s].
PATIENCE_S = 5.0
LOOK_S = 0.01  # between looks whether it is [s]


def behind_link(path: Path) -> Path:
    """The file that a name stands for: a link's goal, which may not exist yet, or else the name itself."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


class PartFile:
    """The file beside a result in which it is written, and which gets the result's name in one step.

    It has the same name in every run and is locked as long as its run lives: a second run on the same result is
    refused, where it does not wait, and what a killed one has left is taken over.

    Attributes:
        path: what to write to.
    """

    def __init__(self, path: Path, patience_s: float = 0.0) -> None:
        """Take the file; what is in it may be of a killed run.

        Args:
            path: the result; where it is a link, its goal is what is replaced in the end.
            patience_s: how long to wait for another run that is writing it [s].

        Raises:
            ConfigError: another run is writing it, and still is by then, or it cannot be written.
        """
        self._name, self._final = path, behind_link(path)
        self.path = self._final.with_name(f".{self._final.stem}.part{self._final.suffix}")
        try:
            self._lock = self._take(time.monotonic() + patience_s)
        except BlockingIOError:
            raise ConfigError(f"{path}: is being written by another run; give another name, or wait for it") from None
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None

    def _take(self, until: float) -> int:
        """A locked descriptor of the file; never of one that has just got its final name, or was removed."""
        while True:
            lock = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            try:
                with contextlib.suppress(FileNotFoundError):
                    _lock(lock)
                    if os.path.samestat(os.fstat(lock), self.path.stat()):
                        return lock
            except BlockingIOError:
                os.close(lock)
                if time.monotonic() >= until:
                    raise
                time.sleep(LOOK_S)
                continue
            except BaseException:
                os.close(lock)
                raise
            os.close(lock)

    @contextlib.contextmanager
    def ending(self, *, keep: bool, error: BaseException | None = None) -> Iterator[None]:
        """Stands around what completes and closes the file; after it the file has its name, or is gone.

        Signals are held back meanwhile, so that a second Ctrl-C loses nothing. Where the run has ended in an error
        already, one says no more than that; else it acts afterwards.

        Args:
            keep: whether it is to have its name.
            error: what the run ended in, if it did; it is told what becomes of the file.

        Raises:
            CotargetError: the file could not be completed, as on a full disk; after an error it only gets a note.
        """
        kept, held = False, HeldSignals()
        held.let_hurry()
        try:
            held.hold()
            yield
            if keep:
                self.path.replace(self._final)
                kept = True
                if error is not None:
                    error.add_note(f"{self._name} holds what there was until then")
        except (OSError, CotargetError) as failure:
            if error is None:
                raise said(self._name, failure) from None
            if keep:
                error.add_note(f"{self._name} could not be completed")
        finally:
            if not kept:
                self.path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                fcntl.flock(self._lock, fcntl.LOCK_UN)  # a child process may hold the descriptor too
            os.close(self._lock)
            held.restore()
        if error is None:
            held.deliver()


def check_writable(path: Path) -> None:
    """Refuse a result that could not be written, before the work and not after it.

    Raises:
        ConfigError: another run is writing it, or its folder may not be written to.
    """
    with PartFile(path).ending(keep=False):
        pass


def _lock(descriptor: int) -> None:
    """Lock a file, where its file system knows locks.

    Raises:
        BlockingIOError: somebody else has locked it.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        pass


def said(path: Path, failure: OSError | CotargetError) -> CotargetError:
    """An error that names the file; a full disk's does not."""
    return (
        failure if isinstance(failure, CotargetError) else ConfigError(f"{path}: cannot be written: {failure.strerror}")
    )


def write_whole(path: Path, data: bytes) -> None:
    """Replace a file's content in one step, also when the program or the power fails half-way.

    Raises:
        ConfigError: the file cannot be written, or another run is writing it for longer than a file takes.
    """
    part = PartFile(path, PATIENCE_S)
    with part.ending(keep=True), part.path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


class CsvFile:
    """A table as csv; appears under its name only when complete. A context manager."""

    def __init__(self, path: Path, columns: Sequence[str], *, keep: bool = False, line_end: str = "\r\n") -> None:
        """Prepare to write.

        Args:
            path: the file.
            columns: its first line.
            keep: whether the rows so far are kept where the block ends in an error.
            line_end: behind each line.

        Raises:
            ConfigError: the file cannot be written.
        """
        self._path, self._keep, self._rows, self._broken = path, keep, 0, False
        self._part = PartFile(path)
        self._file = self._part.path.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file, lineterminator=line_end)
        self._writer.writerow(columns)

    def write(self, row: Iterable[object]) -> None:
        """Append a line.

        Raises:
            ConfigError: the disk is full.
        """
        try:
            self._writer.writerow(row)
        except OSError as error:
            self._broken = True
            raise said(self._path, error) from None
        self._rows += 1

    def __enter__(self) -> "CsvFile":
        """Give the table itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete the file and give it its name; after an error, remove it or keep the rows that it has.

        Raises:
            ConfigError: the file could not be completed, as on a full disk.
        """
        keep = not self._broken and (error is None or (self._keep and self._rows > 0))
        with self._part.ending(keep=keep, error=error):
            self._file.close()  # which writes what is left, and may find the disk full
