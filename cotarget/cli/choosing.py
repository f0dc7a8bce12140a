"""Which of several targets a command follows: by a policy, by a click into the wide view, or by a track's number."""

import argparse
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from cotarget.cli.arguments import count, number
from cotarget.errors import ConfigError, choices

if TYPE_CHECKING:
    from cotarget.loop import Step
    from cotarget.policies import Policy

# Those of `cotarget.policies`, which --help does not import; the paper's first.
POLICIES = ("first-come", "nearest-deadline", "most-served")


def add_choice(parser: argparse.ArgumentParser) -> None:
    """Give a command its options for whom to follow."""
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--policy",
        choices=POLICIES,
        help="of several targets: the first until it disappears, each in turn and who leaves first before others, "
        f"or in the order in which most get a good close-up ({POLICIES[0]})",
    )
    which.add_argument(
        "--click", type=number, nargs=2, metavar=("U", "V"), help="only the target at this pixel of the wide view [px]"
    )
    which.add_argument(
        "--track", type=count, metavar="N", help="only the track of this number, as film and table have it"
    )


class Choice:
    """Whom the options ask for, and whether it was ever there."""

    def __init__(self, options: argparse.Namespace, size: tuple[int, int]) -> None:
        """Read the options.

        Args:
            options: with those of `add_choice`.
            size: (width, height) of the wide view [px].

        Raises:
            ConfigError: the click is not in the wide view.
        """
        from cotarget.policies import POLICIES as MAKERS
        from cotarget.policies import Chosen

        self._wish = ""
        self._seen: set[int] = set()
        self._followed = False
        self.policy: Callable[[], Policy]
        if options.click is not None:
            u, v = options.click
            if not (-0.5 <= u <= size[0] - 0.5 and -0.5 <= v <= size[1] - 0.5):
                raise ConfigError(f"--click: ({u:g}, {v:g}) is not in the wide view's {size[0]}x{size[1]} image")
            self.policy = partial(Chosen, pixel=(u, v), width_px=size[0])
            self._wish = f"--click: no track came near ({u:g}, {v:g})"
        elif options.track is not None:
            self.policy = partial(Chosen, number=options.track)
            self._wish = f"--track: there was no track {options.track}"
        else:
            self.policy = MAKERS[options.policy or POLICIES[0]]

    def see(self, step: "Step") -> None:
        """Take note of a Step."""
        self._followed = self._followed or step.target is not None
        self._seen |= {track.id for track in step.tracks if track.confirmed}

    @property
    def unmet(self) -> str:
        """Says that a click or a number meant none of the tracks; empty where it did, and where there was no track."""
        if self._followed or not self._wish or not self._seen:
            return ""
        return f"{self._wish}; the tracks were: {choices(map(str, self._seen))}"
