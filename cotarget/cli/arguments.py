"""What the commands share: arguments and outputs that are checked before the work, and the progress bar."""

import argparse
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cotarget.errors import ConfigError


@contextmanager
def progress_bar() -> Iterator[Any]:
    """A progress bar on stderr when that is a terminal: call it with (what, done, of how much)."""
    from tqdm import tqdm

    with tqdm(
        total=None, disable=None, leave=False, bar_format="{desc} |{bar:30}| {percentage:3.0f}% {elapsed}"
    ) as bar:

        def show(text: str, done: int, total: int) -> None:
            if bar.disable:
                return
            bar.total, bar.n = total, done
            bar.set_description_str(text)

        yield show


@contextmanager
def nothing() -> Iterator[None]:
    """Stands where another command would have something to close."""
    yield None


def check_outputs(outputs: Sequence[Path | None], inputs: Sequence[Path | None]) -> None:
    """Refuse a result file that cannot be written, or that is an input too, before the long work and not after it."""
    taken = {path.resolve() for path in inputs if path is not None}
    for path in outputs:
        if path is None:
            continue
        if path.is_dir():
            raise ConfigError(f"{path}: is a folder; name the file to write")
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path}: is a device, not a file; name the file to write")
        if not path.absolute().parent.is_dir():
            raise ConfigError(f"{path}: its folder does not exist; create it first")
        if path.resolve() in taken:
            raise ConfigError(f"{path}: is read or written for something else too; give another name for the result")
        taken.add(path.resolve())


def number(text: str) -> float:
    """Read an argument that is a finite number."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value


def positive(text: str) -> float:
    """Read an argument greater than zero."""
    value = number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text} is not greater than zero")
    return value


def not_negative(text: str) -> int:
    """Read a whole number from 0."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0")
    return int(text)


def count(text: str) -> int:
    """Read a whole number from 1."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 1")
    return int(text)


def port(text: str) -> int:
    """Read a TCP port; 0 is any."""
    if not (text.isdecimal() and int(text) < 65536):
        raise argparse.ArgumentTypeError(f"'{text}' is not a port, 0 to 65535")
    return int(text)


def corners(text: str) -> tuple[int, int]:
    """Read a board's inner corners, such as 9x6."""
    columns, _, rows = text.partition("x")
    if not (columns.isdecimal() and rows.isdecimal() and int(columns) >= 3 and int(rows) >= 3):
        raise argparse.ArgumentTypeError(f"'{text}' is not like 9x6 (inner corners: columns x rows, 3 at least)")
    return int(columns), int(rows)
