"""Does the jobs of many experiments, each job at most once: what is on disk is not done again, what is done is on disk.

A job is one seed of one case. What the seeds of a case share is prepared first, by a worker as well; jobs that measure
times come last, one after the other, in this process, with nothing beside them. Elsewhere the longest are begun first,
so that at the end nobody waits long for the last.
"""

import contextlib
import datetime
import functools
import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cotarget.errors import ConfigError
from cotarget.outputs import write_whole
from experiments.cases import Case
from experiments.harness import versions
from experiments.results import JOB_FILES, JOBS, Jobs, Record, code_version, is_same_version
from experiments.tasks import Done, Task, perform
from experiments.workers import Engine, here

DIED = "its process died; is there memory enough?"
SESSIONS = "sessions.json"

Show = Callable[[str, float, float], None]  # what, how much is done, of how much


@dataclass
class Sweep:
    """The jobs of some cases, and what came of them so far.

    Args:
        cases: what is to be run.
        folder: for the results.
        processes: how many jobs at a time.
        any_code: whether results of other code of the same version are kept.

    Attributes:
        records: of each case, what came of its jobs, by number.

    Raises:
        ConfigError: there are results of another version or of other settings in the folder.
    """

    cases: Sequence[Case]
    folder: Path
    processes: int = 1
    any_code: bool = False
    records: list[dict[int, Record]] = field(init=False)
    _now: list[tuple[bool, Done]] = field(init=False, default_factory=list)  # of this session: whether a job, what came

    def __post_init__(self) -> None:
        self._files = [Jobs(self.folder / case.folder, case.title, case.settings) for case in self.cases]
        self.records = []
        for case, files in zip(self.cases, self._files, strict=True):
            wanted = set(case.numbers)
            there = files.read(any_code=self.any_code)
            self.records.append({number: record for number, record in there.items() if number in wanted})
        self._missing = [
            {number for number in case.numbers if number not in records or records[number].failed}
            for case, records in zip(self.cases, self.records, strict=True)
        ]

    @property
    def total(self) -> int:
        """How many jobs there are."""
        return sum(len(case.numbers) for case in self.cases)

    @property
    def done(self) -> int:
        """How many have their rows."""
        return sum(not record.failed for records in self.records for record in records.values())

    @property
    def failed(self) -> int:
        """How many have failed."""
        return sum(bool(record.failed) for records in self.records for record in records.values())

    def run(self, engine: Engine, show: Show, what: str) -> None:
        """Do what is missing, and once more what failed.

        Args:
            engine: does all but the timings.
            show: is told how much is done.
            what: the engine in words, for the report.

        Raises:
            CotargetError: a result cannot be written, the engine fails, or workers have other code.
        """
        began, since = datetime.datetime.now(datetime.UTC), time.perf_counter()
        self._now = []
        try:
            self._run(engine, show)
        finally:
            if self._now:
                session = {
                    "began": began.isoformat(timespec="seconds"),
                    "wall_s": time.perf_counter() - since,
                    "jobs": sum(is_job for is_job, _ in self._now),
                    "job_s": sum(done.seconds for is_job, done in self._now if is_job),
                    "shared_s": sum(done.seconds for is_job, done in self._now if not is_job),
                    "renders": sum(done.renders for _, done in self._now),
                    "workers": what,
                    "cotarget": code_version(),
                    "python": platform.python_version(),
                    "machine": f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}",
                    "versions": versions(),
                }
                told = json.dumps([*sessions(self.folder), session], indent=2) + "\n"
                write_whole(self.folder / SESSIONS, told.encode())

    def _run(self, engine: Engine, show: Show) -> None:
        self._tell(show)
        for alone in (False, True):
            mine = [i for i, case in enumerate(self.cases) if case.experiment.alone == alone and self._missing[i]]
            using = here if alone else engine
            jobs = self._do([task for i in mine for task in self._first(i)], using, show)
            self._do(jobs, using, show)

    def _first(self, i: int) -> list[Task]:
        """What must be prepared for a case's jobs; where there is nothing to prepare, the jobs."""
        case = self.cases[i]
        if case.experiment.prepare is None:
            return self._jobs(i)
        return [Task(i, None, functools.partial(case.experiment.prepare, case.settings))]

    def _jobs(self, i: int, shared: Any = None) -> list[Task]:
        """The jobs of a case that are missing."""
        case = self.cases[i]
        one = functools.partial(case.experiment.one, shared, case.settings)
        return [Task(i, number, functools.partial(one, number)) for number in sorted(self._missing[i])]

    def _do(self, tasks: Sequence[Task], using: Engine, show: Show) -> list[Task]:
        """Do tasks, the longest first; the jobs for which something was prepared."""
        jobs: list[Task] = []
        if not tasks:
            return jobs
        tasks = sorted(tasks, key=self._order)
        with contextlib.closing(using(perform, tasks, self.processes)) as outcomes:
            for index, outcome in outcomes:
                i, number = tasks[index].case, tasks[index].number
                done = outcome if isinstance(outcome, Done) else Done(0.0, 0.0, code_version(), failed=DIED)
                self._check_version(done)
                self._now.append((number is not None, done))
                if number is not None:
                    self._keep(i, number, done)
                elif not done.failed:
                    jobs += self._jobs(i, done.result)
                else:  # none of them can be done
                    for each in tuple(self._missing[i]):
                        self._keep(i, each, replace(done, seconds=0.0, cpu_s=0.0, renders=0))
                self._tell(show, self.cases[i].title if number is None else f"{self.cases[i].title} {number}")
        return jobs

    def _order(self, task: Task) -> tuple[bool, float]:
        """What others wait for comes first, then what takes long."""
        return task.number is not None, -self.cases[task.case].experiment.cost_s

    def _check_version(self, done: Done) -> None:
        """Refuse what other code has done: a program that was changed meanwhile, or a worker that is no copy of this.

        Raises:
            ConfigError: it has.
        """
        if not is_same_version(done.version, code_version(), any_code=self.any_code):
            raise ConfigError(f"a worker has cotarget {done.version}, this is {code_version()}; was the code changed?")

    def _keep(self, i: int, number: int, done: Done) -> None:
        """Put what came of a job on disk."""
        rows, told = None if done.failed else done.result, (done.failed, done.traceback, done.pictures)
        record = Record(number, done.seconds, done.cpu_s, done.version, done.renders, rows, *told)
        self._files[i].write(record)
        self.records[i][number] = record
        self._missing[i].discard(number)

    def _tell(self, show: Show, last: str = "") -> None:
        """Say how much is done, a long job counting for more than a short one."""
        costs = [case.experiment.cost_s for case in self.cases]
        total = sum(cost * len(case.numbers) for cost, case in zip(costs, self.cases, strict=True))
        left = sum(cost * len(missing) for cost, missing in zip(costs, self._missing, strict=True))
        failed = f", {self.failed} failed" if self.failed else ""
        text = f"{self.done} of {self.total} jobs{failed}"
        show(f"{text}; last {last}" if last else text, total - left, total)


def sessions(folder: Path) -> list[dict[str, Any]]:
    """When jobs were done in a folder, by whom and for how long; sessions that were killed have left no word."""
    try:
        found = json.loads((folder / SESSIONS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    return found if isinstance(found, list) else []


def forget(cases: Sequence[Case], folder: Path) -> None:
    """Delete what some cases' jobs have left in a folder, whatever it is of; with the last of them the sessions."""
    for case in cases:
        Jobs(folder / case.folder, case.title, case.settings).forget()
    if next(folder.glob(f"*/{JOBS}/{JOB_FILES}"), None) is None:
        (folder / SESSIONS).unlink(missing_ok=True)
