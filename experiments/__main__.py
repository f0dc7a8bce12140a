"""Run experiments with `python -m experiments`; see `experiments.command`."""

import signal
import sys


def main() -> int:
    """Run the command; Ctrl-C while its modules load, which takes a second, ends in one line too."""
    try:
        from experiments.command import TERMINATED
        from experiments.command import main as run
    except KeyboardInterrupt:
        print("python -m experiments: interrupted", file=sys.stderr)
        return 130
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))  # an exit ends the workers too
    return run()


if __name__ == "__main__":
    sys.exit(main())
