"""Run experiments with `python -m experiments`; see `experiments.engine.command`."""

import sys

INTERRUPTED = 130  # exit status of Ctrl-C; a copy, because `experiments.engine.harness` takes a second to load


def main() -> int:
    """Run the command; Ctrl-C while its modules load, which takes a second or two, ends in one line too."""
    try:
        from experiments.engine.command import main as run
    except KeyboardInterrupt:
        print("python -m experiments: interrupted", file=sys.stderr)
        return INTERRUPTED
    return run()


if __name__ == "__main__":
    sys.exit(main())
