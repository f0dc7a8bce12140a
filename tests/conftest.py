"""How many processes and threads the tests run in, and what the programs that they start inherit."""

import os
import signal
import socket
import sys

import pytest

# Tests run side by side: threads of their own in each would only get into each other's way.
for _threads in ("OPENBLAS_NUM_THREADS", "LP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):  # algebra, rendering, images
    os.environ.setdefault(_threads, "1")
# Tests of the wire wait in real time more than they work, so that two cores have room for five processes.
FEWEST = 5
LONGEST = "test_onvif.py"  # a minute or more than any other; what begins last must not be this


def pytest_xdist_auto_num_workers(config):
    return max(FEWEST, os.cpu_count() or FEWEST)


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.name != LONGEST)


@pytest.fixture(autouse=True, scope="session")
def _bytecode(tmp_path_factory):
    """With PYTHONDONTWRITEBYTECODE, programs that tests start share bytecode in a temporary folder, to start fast."""
    if sys.dont_write_bytecode:
        folder = tmp_path_factory.getbasetemp()  # of this process; that above it is of all that run tests
        folder = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = str(folder / "bytecode")


@pytest.fixture(autouse=True)
def _state_home(tmp_path_factory, monkeypatch):
    """A state folder for each test: a unit whose position one test loses is no unit of the next, nor of the user."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.getbasetemp() / f"state-{os.urandom(8).hex()}"))


@pytest.fixture(autouse=True)
def _no_name_server(monkeypatch):
    """Names of hosts are not asked for on a network; a machine without one waits five seconds for each."""
    find = socket.getaddrinfo

    def find_here(host, *args, **kwargs):
        if host and not set(host.strip("[]")) <= set("0123456789abcdefABCDEF.:") and host != "localhost":
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return find(host, *args, **kwargs)

    monkeypatch.setattr(socket, "getaddrinfo", find_here)


def pytest_configure(config):
    """Let programs that tests start hear signals that whoever started the tests had ignored, as nohup does.

    Ignored signals are inherited by every program started from here, signals with a handler are not.
    """
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else lambda *_: None)
