"""Write files atomically: a file gets its name only when it is complete, and one run at a time writes it.

`PartFile` locks and replaces a file, `CsvFile` writes tables, and `read_table` reads them. `assets_dir` finds the files
that are installed with cotarget.
"""

import contextlib
import csv
import fcntl
import io
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cotarget.errors import ConfigError, CotargetError
from cotarget.safety.signals import DeferredSignals


def assets_dir() -> Path:
    """Return the folder sim_assets: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).parent
    inside = package / "sim_assets"
    return inside if inside.is_dir() else package.parent / "sim_assets"


PATIENCE_S = 5.0  # longest wait for another run that is writing a small file [s]
RETRY_S = 0.01  # interval of the attempts to lock it [s]


def behind_link(path: Path) -> Path:
    """Resolve a symbolic link to its target, which may not exist yet; return other paths unchanged."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


class PartFile:
    """Temporary file beside a result, which gets the result's name in one step.

    It has the same name in every run and is locked until its run ends: a second run on the same result waits or is
    refused, and the file of a killed run is reused.

    Attributes:
        path: the temporary file to write to.
    """

    def __init__(self, path: Path, patience_s: float = 0.0) -> None:
        """Lock the file, which may be that of a killed run.

        Args:
            path: the result; if it is a link, the link's target is replaced in the end.
            patience_s: how long to wait for another run that is writing it [s].

        Raises:
            ConfigError: another run is still writing it, or it cannot be written.
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
        """Open and lock the file, but never one that was just renamed or removed by another run."""
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
                time.sleep(RETRY_S)
                continue
            except BaseException:
                os.close(lock)
                raise
            os.close(lock)

    @contextlib.contextmanager
    def ending(self, *, keep: bool, error: BaseException | None = None) -> Iterator[None]:
        """Complete and close the file in this block; after it the file has its name, or is removed.

        Signals are deferred meanwhile, so that a second Ctrl-C loses nothing. They are delivered afterwards, unless the
        run has ended in an error already.

        Args:
            keep: whether the file gets its name.
            error: error that ended the run, if there was one; it gets a note about the file.

        Raises:
            CotargetError: the file could not be completed, for example on a full disk; after an error it only gets a
                note.
        """
        kept, deferred = False, DeferredSignals()
        deferred.let_hurry()
        try:
            deferred.defer()
            yield
            if keep:
                self.path.replace(self._final)
                kept = True
                if error is not None:
                    error.add_note(f"{self._name} holds what there was until then")
        except (OSError, CotargetError) as failure:
            if error is None:
                raise write_error(self._name, failure) from None
            if keep:
                error.add_note(f"{self._name} could not be completed")
        finally:
            if not kept:
                self.path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                fcntl.flock(self._lock, fcntl.LOCK_UN)  # a child process may hold the descriptor too
            os.close(self._lock)
            deferred.restore()
        if error is None:
            deferred.deliver()


def check_writable(path: Path) -> None:
    """Refuse a result that cannot be written, before the work starts.

    Raises:
        ConfigError: another run is writing it, or its folder is not writable.
    """
    with PartFile(path).ending(keep=False):
        pass


def _lock(descriptor: int) -> None:
    """Lock a file, if its file system supports locks.

    Raises:
        BlockingIOError: another process has locked it.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        pass


def write_error(path: Path, failure: OSError | CotargetError) -> CotargetError:
    """Make an error that names the file, which a full disk's error does not."""
    if isinstance(failure, CotargetError):
        return failure
    return ConfigError(f"{path}: cannot be written: {failure.strerror}")


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file's content in one step, even if the program or the power fails halfway.

    Raises:
        ConfigError: the file cannot be written, or another run keeps writing it.
    """
    part = PartFile(path, PATIENCE_S)
    with part.ending(keep=True), part.path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


STDOUT = Path("-")  # name of stdout as the file of a table


class CsvFile(contextlib.AbstractContextManager["CsvFile", None]):
    """Write a table as csv, under its name only when it is complete; `STDOUT` gets each row at once. A context manager.

    Each row is on the disk before the next one, so that the temporary file of a killed run holds all rows.
    """

    def __init__(self, path: Path, columns: Sequence[str], *, keep: bool = False, line_end: str = "\r\n") -> None:
        """Open the table for writing.

        Args:
            path: the file.
            columns: names of the columns.
            keep: whether to keep the rows so far if the block ends in an error.
            line_end: end of each line.

        Raises:
            ConfigError: the file cannot be written.
        """
        self._path, self._keep, self._rows = path, keep, 0
        self._part = None if path == STDOUT else PartFile(path)
        self._file = None if self._part is None else self._part.path.open("wb", buffering=0)
        self._line = io.StringIO(newline="")
        self._writer = csv.writer(self._line, lineterminator=line_end)
        try:
            self._append(columns)
        except ConfigError as error:
            self.__exit__(type(error), error, None)
            raise

    def write(self, row: Iterable[object]) -> None:
        """Append a line.

        Raises:
            ConfigError: the disk is full; the lines before this one stay whole.
        """
        self._append(row)
        self._rows += 1

    def _append(self, cells: Iterable[object]) -> None:
        self._writer.writerow(cells)
        line = self._line.getvalue()
        self._line.seek(0)
        self._line.truncate()
        if self._file is None:
            sys.stdout.write(line)
            sys.stdout.flush()
            return
        begin = self._file.tell()
        try:
            write_all(self._file, line.encode())
        except OSError as error:
            self._file.truncate(begin)
            raise write_error(self._path, error) from None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Complete the file and give it its name; after an error, remove it or keep the rows so far.

        Raises:
            ConfigError: the file could not be completed.
        """
        if self._part is None or self._file is None:
            return
        with self._part.ending(keep=error is None or (self._keep and self._rows > 0), error=error):
            self._file.close()


def write_all(file: io.RawIOBase, data: bytes) -> None:
    """Write all bytes to an unbuffered file, which may take them in parts.

    Raises:
        OSError: the disk is full.
    """
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) or 0 :]


def read_table(
    path: Path,
    columns: Mapping[str, Callable[[str], Any]],
    what: str,
    *,
    names: Sequence[str] | None = None,
    optional: Mapping[str, Callable[[str], Any]] | None = None,
) -> list[dict[str, Any]]:
    """Read columns of a csv.

    Args:
        path: the file.
        columns: what reads a column's texts, by the column's name.
        what: what the file is to be, for messages.
        names: names of the first columns of a file without a header.
        optional: columns that may be missing.

    Returns:
        Values by the column's name, for each row.

    Raises:
        ConfigError: the file is missing, lacks a column, or holds something else.
    """
    rows = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets write a byte order mark
            reader = csv.DictReader(file, names)
            there = reader.fieldnames or ()
            if missing := [name for name in columns if name not in there]:
                raise ValueError(f"it has no column '{missing[0]}'; it wants {', '.join(columns)}, separated by commas")
            parsers = {**columns, **{name: read for name, read in (optional or {}).items() if name in there}}
            for row in reader:
                line = reader.line_num
                if None in row.values():
                    raise ValueError(f"line {line} is cut off; it wants {', '.join(parsers)}")
                for name, read in parsers.items():
                    try:
                        row[name] = read(row[name])
                    except (KeyError, TypeError, ValueError):
                        raise ValueError(f"line {line} has {row[name]!r} for {name}") from None
                rows.append({name: row[name] for name in parsers})
        return rows
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}; give a csv with {', '.join(columns)}") from None
    except (csv.Error, ValueError) as error:
        raise ConfigError(f"{path}: is no {what}: {error}") from None
