"""A command's linear algebra uses one thread, unless a user asks for more."""

import os
import subprocess
import sys

import pytest

from experiments.engine import LINEAR_ALGEBRA

COMMAND = """
import sys
from cotarget.cli import main
assert main(["board", "--out", sys.argv[1]]) == 0
from threadpoolctl import threadpool_info
print(*{pool["num_threads"] for pool in threadpool_info()})
"""


@pytest.mark.parametrize(("environment", "threads"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_command_uses_one_thread_of_linear_algebra(environment, threads, tmp_path):
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("with one core there is never a second thread")
    clean = {name: value for name, value in os.environ.items() if name not in LINEAR_ALGEBRA}
    command = [sys.executable, "-c", COMMAND, str(tmp_path / "board.svg")]
    made = subprocess.run(command, env=clean | environment, capture_output=True, text=True, check=True)
    assert made.stdout.splitlines()[-1] == threads
