"""Jobs in separate processes: results, progress, errors, signals, and orphans."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cotarget.errors import ConfigError, CotargetError
from cotarget.parallel import run_apart

DEADLINE_S = 60.0  # far more than it takes


def square(x, report):
    report("squaring", 1, 1)
    return x * x


def refuse(x, report):
    raise ConfigError(f"{x} is wrong")


def die(x, report):
    os._exit(3)


def wait_for_ever(pipe_end, report):
    report(0, 1)
    os.read(pipe_end, 1)


def test_result_comes_after_the_reports():
    reports = []
    assert run_apart(square, (3,), lambda *given: reports.append(given)) == 9
    assert reports == [("squaring", 1, 1)]


def test_error_of_a_job_is_raised():
    with pytest.raises(ConfigError, match="7 is wrong"):
        run_apart(refuse, (7,), lambda *_: None)


def test_dead_job_is_an_error():
    with pytest.raises(CotargetError, match=r"ended before it was done \(exit status 3\)"):
        run_apart(die, (1,), lambda *_: None)


def test_interrupt_ends_the_jobs():
    def interrupt(*_):
        raise KeyboardInterrupt

    reading, writing = os.pipe()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_apart(wait_for_ever, (0,), interrupt)
    finally:
        os.close(reading)
        os.close(writing)


WAITER = """
import time
from cotarget.parallel import run_apart

def work(name, report):
    report(0, 1)
    time.sleep(600)

def tell(done, total):
    print("begun", flush=True)

if __name__ == "__main__":
    run_apart(work, ("a",), tell)
"""


class HandlerOfCtrlC:
    """Unpickled in another process, its handler of Ctrl-C."""

    def __reduce__(self):
        return signal.getsignal, (signal.SIGINT,)


def is_ignored(handler, report):
    return handler == signal.SIG_IGN


def test_starting_jobs_ignore_an_interrupt():
    before = signal.getsignal(signal.SIGINT)
    assert run_apart(is_ignored, (HandlerOfCtrlC(),), lambda *_: None) is True
    assert signal.getsignal(signal.SIGINT) == before


def test_jobs_end_with_their_parent_however_it_ends(tmp_path):
    """The pipes close only when no process holds them any more."""
    (tmp_path / "waiter.py").write_text(WAITER)
    with subprocess.Popen(
        [sys.executable, "waiter.py"], cwd=tmp_path, stdout=subprocess.PIPE, start_new_session=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
    ) as process:  # fmt: skip
        try:
            assert process.stdout.readline() == b"begun\n"
            process.kill()
            process.communicate(timeout=DEADLINE_S)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # whatever is left of it
    assert process.returncode == -signal.SIGKILL
