"""Peak memory of `cotarget demo`, summed over its processes, on Linux.

The memory of the command and of all its descendants is read every 0.1 s: the resident memory, which counts a page that
several processes share in each, and the proportional one, which counts it once. Given are the peaks of both sums, and
the processes at the peak of the second.

    python -m benchmarks.demo_memory [--seed 0] [--out DIR]
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from experiments.tables import columns

EVERY_S = 0.1
WANTED_MB = 600.0
COLUMNS = ("process", "resident MB", "proportional MB")


def descendants(root: int) -> list[int]:
    """List a process and all that descend from it."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            after_name = stat.read_text().rpartition(")")[2].split()
        except OSError:  # the process has ended
            continue
        children.setdefault(int(after_name[1]), []).append(int(stat.parent.name))
    found, waiting = [], [root]
    while waiting:
        found.append(waiting.pop())
        waiting += children.get(found[-1], [])
    return found


def memory_mb(process: int) -> tuple[float, float]:
    """Read a process's resident and proportional memory [MB]; 0 for one that has ended."""
    try:
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()[1:]
    except OSError:
        return 0.0, 0.0
    kib = {name: int(value.split()[0]) for name, value in (line.split(":") for line in lines)}
    return kib["Rss"] / 1024, kib["Pss"] / 1024


def watch(process: "subprocess.Popen[bytes]") -> tuple[float, list[tuple[float, float, float]], float]:
    """Read the memory until a process ends.

    Returns:
        Largest sum of resident memory [MB]; the processes at the largest sum of proportional memory, each with its id,
        resident and proportional memory [MB]; and the time of that after the start [s].
    """
    resident, at_peak, when, began = 0.0, [(0.0, 0.0, 0.0)], 0.0, time.monotonic()
    while process.poll() is None:
        now = [(float(each), *memory_mb(each)) for each in descendants(process.pid)]
        resident = max(resident, sum(rss for _, rss, _ in now))
        if sum(pss for *_, pss in now) > sum(pss for *_, pss in at_peak):
            at_peak, when = now, time.monotonic() - began
        time.sleep(EVERY_S)
    return resident, at_peak, when


def main() -> int:
    """Run the demo and print its memory; return its exit status."""
    parser = argparse.ArgumentParser(description="Peak memory of the demo, summed over its processes.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder for the demo's files (default: none is kept)")
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        out = options.out or Path(folder)
        command = [sys.executable, "-m", "cotarget.cli", "demo", "--seed", str(options.seed), "--out", str(out)]
        began = time.monotonic()
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        resident, at_peak, when = watch(process)
        took = time.monotonic() - began
        print(columns(COLUMNS, [[round(a), b, c] for a, b, c in at_peak]))
        proportional = sum(pss for *_, pss in at_peak)
        print(
            f"peak {proportional:.0f} MB after {when:.0f} of {took:.0f} s; summed resident memory {resident:.0f} MB; "
            f"at most {WANTED_MB:g} MB is wanted"
        )
        if (metrics := out / "metrics.json").is_file():
            print(json.dumps(json.loads(metrics.read_text())["calibration"]))
    return process.returncode


if __name__ == "__main__":
    sys.exit(main())
