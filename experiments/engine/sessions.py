"""Sessions of a results folder: when jobs were run, by which workers, and how long they took."""

import dataclasses
import datetime
import json
import os
import platform
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cotarget.errors import ConfigError
from cotarget.files import write_atomically
from cotarget.schema import validate
from experiments.engine.results import code_version
from experiments.engine.versions import versions

SESSIONS = "sessions.json"
OFTEN_S = 20.0  # interval at which a session is saved; a killed one loses at most this [s]


@dataclass(frozen=True)
class Share:
    """Work on one case in a session: number of jobs, their time [s], time of their preparation [s], and renders."""

    jobs: int = 0
    job_s: float = 0.0
    shared_s: float = 0.0
    renders: int = 0

    def __add__(self, other: "Share") -> "Share":
        return Share(*(a + b for a, b in zip(dataclasses.astuple(self), dataclasses.astuple(other), strict=True)))


@dataclass(frozen=True)
class Session:
    """One run, from its first job to its last.

    Attributes:
        began: start time in ISO 8601.
        wall_s: wall time [s].
        workers: description of the workers.
        cotarget: version and hashes of the code.
        machine: architecture, number of cores and system.
        versions: versions of the libraries.
        cases: work on each case, by its folder.
    """

    began: str
    wall_s: float
    workers: str
    cotarget: str
    machine: str
    versions: Mapping[str, str]
    cases: Mapping[str, Share]

    @property
    def whole(self) -> Share:
        """Work on all cases."""
        return sum(self.cases.values(), Share())

    def of(self, folders: Collection[str]) -> "Session":
        """Give the part of the session for some cases; its wall time is shared in proportion to the work."""
        cases = {folder: share for folder, share in self.cases.items() if folder in folders}
        kept, whole = (sum(each.job_s + each.shared_s for each in some.values()) for some in (cases, self.cases))
        return dataclasses.replace(self, cases=cases, wall_s=self.wall_s * kept / whole if whole else 0.0)


class Log:
    """Record of the session that begins when this is made.

    Args:
        folder: folder of the results.
        workers: description of the workers.
    """

    def __init__(self, folder: Path, workers: str) -> None:
        self._folder, self._workers, self._cases = folder, workers, dict[str, Share]()
        self._before, self._began = sessions(folder), datetime.datetime.now(datetime.UTC)
        self._since = self._written = time.perf_counter()

    def add(self, case: str, share: Share) -> None:
        """Add work on a case.

        Raises:
            ConfigError: the file cannot be written.
        """
        self._cases[case] = self._cases.get(case, Share()) + share
        if time.perf_counter() - self._written > OFTEN_S:
            self.write()

    def write(self) -> None:
        """Save the session so far, if any work was done.

        Raises:
            ConfigError: the file cannot be written.
        """
        if self._cases:
            self._written = time.perf_counter()
            machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}"
            began, took = self._began.isoformat(timespec="seconds"), self._written - self._since
            now = Session(began, took, self._workers, code_version(), machine, versions(), self._cases)
            _write(self._folder, [*self._before, now])


def sessions(folder: Path) -> list[Session]:
    """Read the sessions of a folder; single ones of another format are left out, because they change no result.

    Raises:
        ConfigError: the file is damaged.
    """
    path = folder / SESSIONS
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, list):
            raise ValueError("it holds no list")
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path}: cannot be read ({error}); restore it, or remove it: the report then lacks earlier sessions' times"
        ) from None
    return [each for told in found if (each := _read(told)) is not None]


def _read(told: Any) -> Session | None:
    try:
        session: Session = validate(Session, told, SESSIONS)
    except ConfigError:
        return None
    return session


def forget(folder: Path, cases: Collection[str]) -> None:
    """Remove some cases from the sessions of a folder."""
    found = sessions(folder)
    kept = [each.of(each.cases.keys() - set(cases)) for each in found]
    if found:
        _write(folder, [each for each in kept if each.cases])


def _write(folder: Path, found: list[Session]) -> None:
    told = json.dumps([dataclasses.asdict(each) for each in found], indent=2) + "\n"
    write_atomically(folder / SESSIONS, told.encode())
