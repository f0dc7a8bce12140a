"""Pictures that a job makes on its way to its rows, for the report alone: no figure is made of them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Pictured:
    """What `one` gives where there is something to be seen.

    Attributes:
        rows: as without pictures.
        pictures: PNGs by the names of their files, without ending; like the rows of settings and seed alone.
    """

    rows: list[dict[str, Any]]
    pictures: Mapping[str, bytes]


def parted(given: list[dict[str, Any]] | Pictured) -> tuple[list[dict[str, Any]], Mapping[str, bytes]]:
    """The rows of a job, and its pictures; none where it gave rows only."""
    return (given.rows, given.pictures) if isinstance(given, Pictured) else (given, {})


def shown(pictures: Iterable[Mapping[str, bytes]]) -> Mapping[str, bytes]:
    """Of the pictures of many jobs those to be shown: of the first that has any."""
    return next(filter(None, pictures), {})
