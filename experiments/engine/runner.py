"""Run the jobs of many experiments, each job at most once; a run resumes from the results on disk.

A job is one seed of one case. What seeds share is prepared first, by a worker, once for all cases that share it. Then
come all jobs, the longest first, so that the end of the run is not one long job. Jobs that measure times come last, one
after the other, in a process that nothing runs beside.
"""

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cotarget.errors import ConfigError
from cotarget.parallel import Progress
from experiments.engine import sessions
from experiments.engine.cases import Case
from experiments.engine.results import Jobs, Record, Spent, code_version, differing
from experiments.engine.tasks import Done, Task, perform
from experiments.engine.workers import Engine, in_turn

DIED = "its process died; is there memory enough?"


@dataclass
class Sweep:
    """Jobs of some cases, and their results so far.

    Args:
        cases: cases to run.
        folder: folder of the results.
        processes: number of jobs at a time.
        any_code: whether results of other code of the same version are kept, and workers may have other libraries.

    Attributes:
        records: results of each case's jobs, by number.

    Raises:
        ConfigError: the folder has results of another version or of other settings.
    """

    cases: Sequence[Case]
    folder: Path
    processes: int = 1
    any_code: bool = False
    records: list[dict[int, Record]] = field(init=False)

    def __post_init__(self) -> None:
        code_version()  # fixes the version at the sweep's start
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
        """Number of jobs."""
        return sum(len(case.numbers) for case in self.cases)

    @property
    def done(self) -> int:
        """Number of jobs that have their rows."""
        return sum(not record.failed for records in self.records for record in records.values())

    @property
    def failed(self) -> int:
        """Number of failed jobs."""
        return sum(bool(record.failed) for records in self.records for record in records.values())

    @property
    def shared(self) -> list[Spent]:
        """Cost of preparing what each case's jobs share; zero where it is counted with another case."""
        return [files.read_shared() for files in self._files]

    def run(self, engine: Engine, show: Progress, what: str) -> None:
        """Run the missing jobs, and the failed ones again.

        Args:
            engine: runs all jobs that do not measure times.
            show: called with the progress.
            what: description of the engine, for the report.

        Raises:
            CotargetError: a result cannot be written, the engine fails, or workers have other code.
        """
        self._log = sessions.Log(self.folder, what)
        try:
            self._tell(show)
            shared = self._prepare(engine, show)
            for alone, using in ((False, engine), (True, in_turn)):
                mine = [i for i, case in enumerate(self.cases) if case.experiment.alone == alone]
                tasks = [task for i in mine for task in self._jobs(i, shared.get(i))]
                self._do(tasks, using, show, self._keep_rows)
        finally:
            self._log.write()

    def _prepare(self, engine: Engine, show: Progress) -> dict[int, Any]:
        """Prepare what the jobs of each case share, by case number; where that fails, the jobs count as failed."""
        wanted: dict[Any, list[int]] = {}
        for i, case in enumerate(self.cases):
            if self._missing[i] and (key := case.experiment.shares(case.settings)) is not None:
                wanted.setdefault(key, []).append(i)
        shared: dict[int, Any] = {}

        def keep(task: Task, done: Done) -> None:
            self._files[task.case].write_shared(Spent(done.seconds, done.cpu_s, done.renders))
            for i in sharing[task.case]:
                shared[i] = done.result
                for number in tuple(self._missing[i]) if done.failed else ():
                    self._keep(i, number, replace(done, seconds=0.0, cpu_s=0.0, renders=0))

        sharing = {cases[0]: cases for cases in wanted.values()}  # counted with the first case that shares it
        tasks = [Task(cases[0], None, functools.partial(make, *given)) for (make, given), cases in wanted.items()]
        self._do(tasks, engine, show, keep)
        return shared

    def _jobs(self, i: int, shared: Any) -> list[Task]:
        """List the missing jobs of a case."""
        case = self.cases[i]
        one = functools.partial(case.experiment.one, shared, case.settings)
        return [Task(i, number, functools.partial(one, number)) for number in sorted(self._missing[i])]

    def _do(self, tasks: Sequence[Task], using: Engine, show: Progress, keep: Callable[[Task, Done], None]) -> None:
        """Run tasks, the longest first, and keep each result at once."""
        if not tasks:
            return
        tasks = sorted(tasks, key=lambda task: -self.cases[task.case].experiment.cost_s)
        with contextlib.closing(using(perform, tasks, self.processes)) as outcomes:
            for index, outcome in outcomes:
                task, case = tasks[index], self.cases[tasks[index].case]
                done = outcome if isinstance(outcome, Done) else Done(0.0, 0.0, code_version(), failed=DIED)
                self._check_version(done)
                keep(task, done)
                took = (0, 0.0, done.seconds) if task.number is None else (1, done.seconds, 0.0)
                self._log.add(case.folder, sessions.Share(*took, done.renders))
                self._tell(show, case.title if task.number is None else f"{case.title} {task.number}")

    def _check_version(self, done: Done) -> None:
        """Refuse results of other code: the program was changed during the run, or a worker has another copy.

        Raises:
            ConfigError: the code differs.
        """
        other = differing(done.version, code_version())
        if other and not (self.any_code and other == "libraries"):
            raise ConfigError(f"a worker has cotarget {done.version}, this is {code_version()}; was the code changed?")

    def _keep_rows(self, task: Task, done: Done) -> None:
        """Store the result of a task of one seed."""
        assert task.number is not None, "what jobs share is no seed's"
        self._keep(task.case, task.number, done)

    def _keep(self, i: int, number: int, done: Done) -> None:
        """Store the result of a job."""
        rows, told = None if done.failed else done.result, (done.failed, done.traceback, done.pictures)
        record = Record(number, done.seconds, done.cpu_s, done.version, done.renders, rows, *told)
        self._files[i].write(record)
        self.records[i][number] = record
        self._missing[i].discard(number)

    def _tell(self, show: Progress, last: str = "") -> None:
        """Progress the progress, in which jobs count by their expected time."""
        costs = [case.experiment.cost_s for case in self.cases]
        total = sum(cost * len(case.numbers) for cost, case in zip(costs, self.cases, strict=True))
        left = sum(cost * len(missing) for cost, missing in zip(costs, self._missing, strict=True))
        failed = f", {self.failed} failed" if self.failed else ""
        text = f"{self.done} of {self.total} jobs{failed}"
        show(total - left, total, f"{text}; last {last}" if last else text)


def forget(cases: Sequence[Case], folder: Path) -> None:
    """Delete the results of some cases in a folder, of whatever version and settings they are."""
    for case in cases:
        Jobs(folder / case.folder, case.title, case.settings).forget()
    sessions.forget(folder, {case.folder for case in cases})
