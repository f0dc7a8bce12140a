"""Pictures that a job returns beside its rows, for the report only; no figure is computed from them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Pictured:
    """Rows of a job with pictures.

    Attributes:
        rows: rows of the job.
        pictures: PNGs by file name without extension; they depend on settings and seed alone.
    """

    rows: list[dict[str, Any]]
    pictures: Mapping[str, bytes]


def parted(given: list[dict[str, Any]] | Pictured) -> tuple[list[dict[str, Any]], Mapping[str, bytes]]:
    """Split a job's result into rows and pictures; no pictures if it gave rows only."""
    return (given.rows, given.pictures) if isinstance(given, Pictured) else (given, {})


def shown(pictures: Iterable[Mapping[str, bytes]]) -> Mapping[str, bytes]:
    """Select the pictures to show: those of the first job that has any."""
    return next(filter(None, pictures), {})
