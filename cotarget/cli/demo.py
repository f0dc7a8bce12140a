"""Calibrate a simulated rig and follow a book, a person and a bird: `cotarget demo --out demo-out`."""

import argparse
from pathlib import Path

from cotarget.cli.common import add_file, previous_kept, whole
from cotarget.parallel import progress_bar


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "--out", "where to write (demo-out)", "DIR", default=Path("demo-out"))
    parser.add_argument("--seed", type=whole(0), default=0, help="seed of everything random (0)")


def run(options: argparse.Namespace) -> None:
    """Run the demo, and print its figures."""
    from cotarget.demo import run_demo, summary

    with progress_bar() as progress, previous_kept(options.out / "calibration.json"):
        metrics = run_demo(options.out, options.seed, progress)
    print(summary(metrics))
    print(f"pictures, video and metrics.json are in {options.out} ({metrics['wall_s']:.0f} s)")
