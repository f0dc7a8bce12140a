"""Parsers of the command line whose mistakes end in one line."""

import argparse
from collections.abc import Callable
from typing import Any, NoReturn

USAGE = 2  # argparse's own exit status


class Parser(argparse.ArgumentParser):
    """A parser whose mistakes, too, end in one line.

    Attributes:
        more: what --help says last, found only then.
    """

    more: Callable[[], str] | None = None

    def format_help(self) -> str:
        """Say what there is to say."""
        if self.more is not None:
            self.epilog = self.more()
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, without the usage in front of it."""
        self.exit(USAGE, f"{self.prog}: {message}; see {self.prog} --help\n")


class CommandParser(Parser):
    """A command's own, which complains itself of what it does not know, where its --help tells what it does."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse has it; but all must be known."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown
