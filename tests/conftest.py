"""How many processes the tests run in."""

import os

# Tests of the wire wait in real time more than they work, so that two cores have room for a third process.
FEWEST = 3


def pytest_xdist_auto_num_workers(config):
    return max(FEWEST, os.cpu_count() or FEWEST)
