"""Does the jobs of many experiments, each job at most once: what is on disk is not done again, what is done is on disk.

A job is one seed of one case. What seeds share is prepared first, by a worker as well, and once where several cases
share it; then come all jobs, the longest first, so that at the end nobody waits long for the last; those that measure
times come last, one after the other, in a process that nothing is beside.
"""

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cotarget.errors import ConfigError
from experiments.engine import sessions
from experiments.engine.cases import Case
from experiments.engine.results import Jobs, Record, Spent, code_version, differing
from experiments.engine.tasks import Done, Task, perform
from experiments.engine.workers import Engine, in_turn

DIED = "its process died; is there memory enough?"
Show = Callable[[str, float, float], None]  # what, how much is done, of how much


@dataclass
class Sweep:
    """The jobs of some cases, and what came of them so far.

    Args:
        cases: what is to be run.
        folder: for the results.
        processes: how many jobs at a time.
        any_code: whether results of other code of the same version are kept, and workers may have other libraries.

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

    def __post_init__(self) -> None:
        code_version()  # as it is when the sweep begins
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

    @property
    def shared(self) -> list[Spent]:
        """What it took to prepare what each case's jobs share; nothing where another case's share it too."""
        return [files.read_shared() for files in self._files]

    def run(self, engine: Engine, show: Show, what: str) -> None:
        """Do what is missing, and once more what failed.

        Args:
            engine: does all but the timings.
            show: is told how much is done.
            what: the engine in words, for the report.

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

    def _prepare(self, engine: Engine, show: Show) -> dict[int, Any]:
        """What the jobs of each case share, by its number; where that cannot be had, the jobs have failed."""
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

        sharing = {cases[0]: cases for cases in wanted.values()}  # counted as the first one's
        tasks = [Task(cases[0], None, functools.partial(make, *given)) for (make, given), cases in wanted.items()]
        self._do(tasks, engine, show, keep)
        return shared

    def _jobs(self, i: int, shared: Any) -> list[Task]:
        """The jobs of a case that are missing."""
        case = self.cases[i]
        one = functools.partial(case.experiment.one, shared, case.settings)
        return [Task(i, number, functools.partial(one, number)) for number in sorted(self._missing[i])]

    def _do(self, tasks: Sequence[Task], using: Engine, show: Show, keep: Callable[[Task, Done], None]) -> None:
        """Do tasks, the longest first; what comes of each is kept at once."""
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
        """Refuse what other code has done: a program that was changed meanwhile, or a worker that is no copy of this.

        Raises:
            ConfigError: it has.
        """
        other = differing(done.version, code_version())
        if other and not (self.any_code and other == "libraries"):
            raise ConfigError(f"a worker has cotarget {done.version}, this is {code_version()}; was the code changed?")

    def _keep_rows(self, task: Task, done: Done) -> None:
        """Put what came of a task of one seed on disk."""
        assert task.number is not None, "what jobs share is no seed's"
        self._keep(task.case, task.number, done)

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


def forget(cases: Sequence[Case], folder: Path) -> None:
    """Delete what some cases' jobs have left in a folder, whatever it is of."""
    for case in cases:
        Jobs(folder / case.folder, case.title, case.settings).forget()
    sessions.forget(folder, {case.folder for case in cases})
