"""`python -m experiments`: see `experiments.engine.command`."""

import sys

INTERRUPTED = 130  # exit status of Ctrl-C; `experiments.engine.harness` has it too, but takes a second to load


def main() -> int:
    """The command; Ctrl-C is told in one line while its modules are loaded too, which takes a second or two."""
    try:
        from experiments.engine.command import main as run
    except KeyboardInterrupt:
        print("python -m experiments: interrupted", file=sys.stderr)
        return INTERRUPTED
    return run()


if __name__ == "__main__":
    sys.exit(main())
