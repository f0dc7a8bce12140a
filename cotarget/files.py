"""Write files atomically: a file gets its name only when it is complete.

`PartFile` replaces a file, `CsvFile` writes tables, and `read_table` reads them. `assets_dir` finds the files
that are installed with cotarget.
"""

import contextlib
import csv
import io
import os
import secrets
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cotarget.errors import ConfigError, CotargetError
from cotarget.safety.signals import deferred_signals


def assets_dir() -> Path:
    """Return the folder sim_assets: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).parent
    inside = package / "sim_assets"
    return inside if inside.is_dir() else package.parent / "sim_assets"


def behind_link(path: Path) -> Path:
    """Resolve a symbolic link to its target, which may not exist yet; return other paths unchanged."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


class PartFile:
    """Temporary file beside a result, which replaces the result in one step; a killed run leaves it.

    Attributes:
        path: path of the temporary file, which no other run has; if the result is a link, it is beside the link's
            target.
        file: the temporary file, open for writing.
    """

    def __init__(self, path: Path) -> None:
        """Open the temporary file of a result.

        Raises:
            ConfigError: it cannot be written.
        """
        self._name, self._final = path, behind_link(path)
        self.path = self._final.with_name(f".{self._final.stem}.{secrets.token_hex(3)}.part{self._final.suffix}")
        try:
            self.file = self.path.open("xb", buffering=0)
        except OSError as error:
            raise write_error(path, error) from None

    @contextlib.contextmanager
    def ending(self, *, keep: bool, error: BaseException | None = None) -> Iterator[None]:
        """Complete the file in this block; after it the file is closed, and has its name or is removed.

        Signals are deferred, because a second Ctrl-C while a film is completed would lose the film of a whole run.

        Args:
            keep: whether the file gets its name.
            error: error that ended the run, if there was one; it gets a note about the file.

        Raises:
            CotargetError: the file could not be completed, for example on a full disk; after an error it only gets a
                note.
        """
        try:
            with deferred_signals(deliver=error is None):
                with self.file:
                    yield
                if keep:
                    self.path.replace(self._final)
                    if error is not None:
                        error.add_note(f"{self._name} holds what there was until then")
        except (OSError, CotargetError) as failure:
            if error is None:
                raise write_error(self._name, failure) from None
            if keep:
                error.add_note(f"{self._name} could not be completed")
        finally:
            self.path.unlink(missing_ok=True)


def write_error(path: Path, failure: OSError | CotargetError) -> CotargetError:
    """Make an error that names the file, which a full disk's error does not."""
    if isinstance(failure, CotargetError):
        return failure
    return ConfigError(f"{path}: cannot be written: {failure.strerror}")


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file's content in one step, even if the program or the power fails halfway.

    Raises:
        ConfigError: the file cannot be written.
    """
    part = PartFile(path)
    with part.ending(keep=True):
        write_all(part.file, data)
        os.fsync(part.file.fileno())


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
        if self._part is None:
            sys.stdout.write(line)
            sys.stdout.flush()
            return
        begin = self._part.file.tell()
        try:
            write_all(self._part.file, line.encode())
        except OSError as error:
            self._part.file.truncate(begin)
            raise write_error(self._path, error) from None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Complete the file and give it its name; after an error, remove it or keep the rows so far.

        Raises:
            ConfigError: the file could not be completed.
        """
        if self._part is not None:
            with self._part.ending(keep=error is None or (self._keep and self._rows > 0), error=error):
                pass


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
