"""Command-line parser and entry point of all commands.

Machine-readable output goes to stdout or to the named file. An error ends in one line on stderr and a non-zero exit
status.
"""

import argparse
import contextlib
import io
import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.metadata import version
from typing import IO, Any, NoReturn

from cotarget.errors import CotargetError
from cotarget.safety.signals import leave

USAGE = 2  # argparse's own exit status


class Parser(argparse.ArgumentParser):
    """Argument parser whose errors end in one line.

    Attributes:
        make_epilog: gives a last paragraph of --help; called only when help is printed.
        example: a command line, which ends --help.
    """

    make_epilog: Callable[[], str] | None = None
    example = ""

    def format_help(self) -> str:
        """Format the help, with the paragraph of ``make_epilog`` and the example at its end."""
        if self.make_epilog is not None:
            self.epilog = self.make_epilog()
        return super().format_help() + (f"\nexample: {self.example}\n" if self.example else "")

    def error(self, message: str) -> NoReturn:
        """Exit with one line on stderr, without the usage."""
        self.exit(USAGE, f"{self.prog}: {message}; see {self.prog} --help\n")


class CommandParser(Parser):
    """Parser of one command, which rejects unknown options itself, so that the error names that command's --help."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the arguments as argparse does, and reject unknown ones."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown


# Each command imports the heavy modules (MuJoCo, OpenCV, matplotlib) that it needs, so that --help and wrong arguments
# answer at once, and `doctor` runs where one of them is broken.
INTERRUPTED = 130  # a shell's exit status for Ctrl-C
# The matrices here are small: where other programs use the cores, a second thread of linear algebra makes the work up
# to 100 times slower. numpy reads the variable when it is imported; a user's OPENBLAS_NUM_THREADS takes precedence.
ONE_THREAD = ("OMP_NUM_THREADS", "1")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status."""
    os.environ.setdefault(*ONE_THREAD)
    for name in ("stdout", "stderr"):
        _prepare(name)
    try:
        return _run(make_parser().parse_args(arguments))
    finally:
        for stream in (sys.stdout, sys.stderr):
            _drop_unwritten(stream)


def _run(options: argparse.Namespace) -> int:
    """Run the command of parsed options, and print in one line how it ended."""
    # SIGTERM and SIGHUP raise SystemExit, so that the rig halts and files are completed, as on Ctrl-C.
    for ending in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(ending) is signal.SIG_DFL:  # nohup ignores SIGHUP; keep that
            signal.signal(ending, leave)
    level = logging.INFO if options.verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(message)s", handlers=[StderrHandler()])
    logging.getLogger("httpx").setLevel(logging.WARNING)  # httpx logs every request at INFO
    try:
        status = int(options.run(options) or 0)
        sys.stdout.flush()
        return status
    except CotargetError as error:
        text = str(error).replace("insist=True", "--insist")
        if getattr(options, "rig", None) is not None:  # the safety layer does not know the file's name
            text = text.replace("--rig FILE", f"--rig {options.rig}")
        _print_end(options.command, text, error)
        return 1
    except BrokenPipeError:
        return 1
    except OSError as error:  # not caught by the commands' own checks, such as a full disk
        where = "" if error.filename is None else f"{error.filename}: "
        _print_end(options.command, f"{where}{error.strerror or error}", error)
        return 1
    except KeyboardInterrupt as end:
        _print_end(options.command, "interrupted", end)
        return INTERRUPTED
    except SystemExit as end:
        if _notes(end):
            _print_end(options.command, "terminated", end)
        raise


# Standard streams


def _prepare(name: str) -> None:
    """Let a standard stream write any name; replace a closed one, whose descriptor the next file would get."""
    stream = getattr(sys, name)
    if stream is None:
        descriptor = {"stdout": 1, "stderr": 2}[name]
        if (opened := os.open(os.devnull, os.O_WRONLY)) != descriptor:  # a closed stdin's came first
            os.dup2(opened, descriptor)
        setattr(sys, name, open(descriptor, "w"))  # noqa: PTH123, SIM115  open until the program ends
    elif isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors="backslashreplace")


def _drop_unwritten(stream: IO[str]) -> None:
    """Drop what a stream did not take, which would change the exit status when Python flushes it."""
    try:
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class StderrHandler(logging.Handler):
    """Print records on what is stderr at the moment, so that a progress bar moves below them."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record."""
        with contextlib.suppress(OSError):  # the terminal may be closed
            print(self.format(record), file=sys.stderr)


def _print_end(command: str, text: str, end: BaseException) -> None:
    """Print in one line how a command ended, with the notes on the files that it was writing."""
    with contextlib.suppress(OSError):  # the terminal may be closed
        print("; ".join([f"cotarget {command}: {text}", *_notes(end)]), file=sys.stderr)


def _notes(end: BaseException) -> list[str]:
    return getattr(end, "__notes__", [])


DESCRIPTION = "A fixed camera finds a small target; a zoom camera on a pan-tilt head shows it large."
# In an order of use. Each has a module, whose docstring is the help; `add` adds the options, and `run` runs it.
COMMANDS = (
    "demo", "config", "doctor", "view", "board", "where", "point", "home", "characterize", "latency", "calibrate",
    "report", "aim", "follow", "replay", "detect", "stop", "clear", "reset-head", "emulate",
)  # fmt: skip
EARLIER = {"learn": "characterize"}  # names that commands had


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line, with a parser for each command."""
    parser = Parser(prog="cotarget", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"cotarget {version('cotarget')}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=CommandParser)
    for name in COMMANDS:
        command = import_module(f"cotarget.cli.{name.replace('-', '_')}")
        summary, _, example = (command.__doc__ or "").partition(": `")
        summary = summary[:1].lower() + summary[1:]
        made = commands.add_parser(name, help=summary, description=summary)
        made.example, made.make_epilog = example.removesuffix("`."), getattr(command, "epilog", None)
        made.add_argument("-v", "--verbose", action="store_true", help="report more of what is done")
        made.set_defaults(run=command.run)
        command.add(made)
    for earlier, name in EARLIER.items():
        commands.choices[earlier] = commands.choices[name]  # understood, and not listed
    parser.example = "\n         ".join(commands.choices[name].example for name in COMMANDS)
    return parser
