"""How many processes and threads the tests run in, and what the programs that they start inherit."""

import os
import shutil
import signal
import sys
import tempfile

import pytest

# Tests run side by side: threads of their own in each would only get into each other's way.
for _threads in ("OPENBLAS_NUM_THREADS", "LP_NUM_THREADS"):  # of linear algebra, of rendering
    os.environ.setdefault(_threads, "1")
# Tests of the wire wait in real time more than they work, so that two cores have room for a third process.
FEWEST = 3


def pytest_xdist_auto_num_workers(config):
    return max(FEWEST, os.cpu_count() or FEWEST)


# Where nobody wants bytecode it is kept for as long as the tests run, elsewhere: every program that they start would
# compile everything anew.
_bytecode = tempfile.mkdtemp(prefix="cotarget-tests-") if sys.dont_write_bytecode else None
if _bytecode:
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = _bytecode


@pytest.fixture(autouse=True)
def _state_home(tmp_path_factory, monkeypatch):
    """A state folder for each test: a unit whose position one test loses is no unit of the next, nor of the user."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.getbasetemp() / f"state-{os.urandom(8).hex()}"))


def pytest_unconfigure(config):
    if _bytecode:
        shutil.rmtree(_bytecode, ignore_errors=True)


def pytest_configure(config):
    """Let programs that tests start hear signals that whoever started the tests had ignored, as nohup does.

    Ignored signals are inherited by every program started from here, signals with a handler are not.
    """
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)
