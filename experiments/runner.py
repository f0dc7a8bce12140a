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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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

    def traceback(self, case: int, number: int) -> Path:
        """Where a failed job's traceback is."""
        return self._files[case].traceback(number)

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
            CotargetError: a result cannot be written, or the engine fails.
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
        missing = [
            [number for number in case.numbers if number not in records or records[number].failed]
            for case, records in zip(self.cases, self.records, strict=True)
        ]
        total = sum(case.experiment.cost_s * len(case.numbers) for case in self.cases)
        left = sum(case.experiment.cost_s * len(todo) for case, todo in zip(self.cases, missing, strict=True))

        def keep(i: int, number: int, done: Done) -> None:
            nonlocal left
            self._keep(i, number, done)
            left -= self.cases[i].experiment.cost_s
            failures = f", {self.failed} failed" if self.failed else ""
            last = f"{self.cases[i].title} {number}"
            show(
                f"{self.done} of {self.total} jobs{failures}; last {last}", min(total - left, total), total
            )  # rounding

        def do(tasks: Sequence[Task], using: Engine) -> list[Task]:
            """Do tasks, the longest first; the jobs for which something was prepared."""
            jobs: list[Task] = []
            if not tasks:
                return jobs
            tasks = sorted(tasks, key=self._order)
            with contextlib.closing(using(perform, tasks, self.processes)) as outcomes:
                for index, outcome in outcomes:
                    i, number = tasks[index].case, tasks[index].number
                    done = outcome if isinstance(outcome, Done) else Done(0.0, code_version(), failed=DIED)
                    self._now.append((number is not None, done))
                    if number is not None:
                        keep(i, number, done)
                    elif not done.failed:
                        jobs += self._jobs(i, missing[i], done.result)
                    else:
                        for number in missing[i]:
                            keep(i, number, done)
            return jobs

        show(f"{self.done} of {self.total} jobs", total - left, total)
        for alone in (False, True):
            mine = [i for i, case in enumerate(self.cases) if case.experiment.alone == alone and missing[i]]
            using = here if alone else engine
            do(do([task for i in mine for task in self._first(i, missing[i])], using), using)

    def _first(self, i: int, numbers: Sequence[int]) -> list[Task]:
        """What must be prepared for a case's jobs; where there is nothing to prepare, the jobs."""
        case = self.cases[i]
        if case.experiment.prepare is None:
            return self._jobs(i, numbers)
        return [Task(i, None, functools.partial(case.experiment.prepare, case.settings))]

    def _jobs(self, i: int, numbers: Sequence[int], shared: Any = None) -> list[Task]:
        case = self.cases[i]
        one = functools.partial(case.experiment.one, shared, case.settings)
        return [Task(i, number, functools.partial(one, number)) for number in numbers]

    def _order(self, task: Task) -> tuple[bool, float]:
        """What others wait for comes first, then what takes long."""
        return task.number is not None, -self.cases[task.case].experiment.cost_s

    def _keep(self, i: int, number: int, done: Done) -> None:
        failed = done.failed
        if not failed and not is_same_version(done.version, code_version(), any_code=self.any_code):
            failed = f"was done by cotarget {done.version}, this is {code_version()}; all must have the same code"
        if failed:
            record = Record(number, done.seconds, code_version(), done.renders, None, failed, done.traceback)
        else:
            record = Record(number, done.seconds, done.version, done.renders, done.result)
        self._files[i].write(record)
        self.records[i][number] = record


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
