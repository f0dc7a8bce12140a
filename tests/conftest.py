"""How many processes and threads the tests run in, and which signals reach the programs that they start."""

import os
import signal

# Tests run side by side: threads of their own in each would only get into each other's way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Tests of the wire wait in real time more than they work, so that two cores have room for a third process.
FEWEST = 3


def pytest_xdist_auto_num_workers(config):
    return max(FEWEST, os.cpu_count() or FEWEST)


def pytest_configure(config):
    """Let programs that tests start hear signals that whoever started the tests had ignored, as nohup does.

    Ignored signals are inherited by every program started from here, signals with a handler are not.
    """
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)
