"""When jobs were done in a folder, by whom and for how long."""

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

from cotarget.config import build
from cotarget.errors import ConfigError
from cotarget.files import write_whole
from experiments.engine.results import code_version
from experiments.engine.versions import versions

SESSIONS = "sessions.json"
OFTEN_S = 20.0  # a session that is killed has left word of what it did until so long before [s]


@dataclass(frozen=True)
class Share:
    """What was done of one case in a session: how many jobs, how long they took and what they share [s], renders."""

    jobs: int = 0
    job_s: float = 0.0
    shared_s: float = 0.0
    renders: int = 0

    def __add__(self, other: "Share") -> "Share":
        return Share(*(a + b for a, b in zip(dataclasses.astuple(self), dataclasses.astuple(other), strict=True)))


@dataclass(frozen=True)
class Session:
    """From a run's first job to its last.

    Attributes:
        began: when, as ISO 8601 has it.
        wall_s: how long it lasted [s].
        workers: who did the jobs, in words.
        cotarget: version and fingerprints of the code.
        machine: kind, cores and system.
        versions: of the libraries.
        cases: what was done of each case, by its folder.
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
        """What was done of all cases."""
        return sum(self.cases.values(), Share())

    def of(self, folders: Collection[str]) -> "Session":
        """The part of it that went to some cases; of its time as large a part as theirs is of the work."""
        cases = {folder: share for folder, share in self.cases.items() if folder in folders}
        kept, whole = (sum(each.job_s + each.shared_s for each in some.values()) for some in (cases, self.cases))
        return dataclasses.replace(self, cases=cases, wall_s=self.wall_s * kept / whole if whole else 0.0)


class Log:
    """Writes down the session that begins with it.

    Args:
        folder: of the results.
        workers: who does the jobs, in words.
    """

    def __init__(self, folder: Path, workers: str) -> None:
        self._folder, self._workers, self._cases = folder, workers, dict[str, Share]()
        self._before, self._began = sessions(folder), datetime.datetime.now(datetime.UTC)
        self._since = self._written = time.perf_counter()

    def add(self, case: str, share: Share) -> None:
        """Something of a case was done.

        Raises:
            ConfigError: it cannot be written down.
        """
        self._cases[case] = self._cases.get(case, Share()) + share
        if time.perf_counter() - self._written > OFTEN_S:
            self.write()

    def write(self) -> None:
        """Write down what was done so far; nothing where nothing was.

        Raises:
            ConfigError: it cannot be written.
        """
        if self._cases:
            self._written = time.perf_counter()
            machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}"
            began, took = self._began.isoformat(timespec="seconds"), self._written - self._since
            now = Session(began, took, self._workers, code_version(), machine, versions(), self._cases)
            _write(self._folder, [*self._before, now])


def sessions(folder: Path) -> list[Session]:
    """Those of a folder; what cannot be read is left out, as it changes no result."""
    try:
        found = json.loads((folder / SESSIONS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    return [each for told in (found if isinstance(found, list) else []) if (each := _read(told)) is not None]


def _read(told: Any) -> Session | None:
    try:
        session: Session = build(Session, told, SESSIONS)
    except ConfigError:
        return None
    return session


def forget(folder: Path, cases: Collection[str]) -> None:
    """Leave some cases out of the sessions of a folder."""
    found = sessions(folder)
    kept = [each.of(each.cases.keys() - set(cases)) for each in found]
    if found:
        _write(folder, [each for each in kept if each.cases])


def _write(folder: Path, found: list[Session]) -> None:
    told = json.dumps([dataclasses.asdict(each) for each in found], indent=2) + "\n"
    write_whole(folder / SESSIONS, told.encode())
