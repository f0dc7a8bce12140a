"""Which of several targets a command follows: by a policy, by a click into the wide view, or by a track's number."""

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cotarget.cli.arguments import count, number
from cotarget.errors import ConfigError, choices
from cotarget.whom import ANYBODY, Whom

if TYPE_CHECKING:
    from cotarget.config import RigConfig
    from cotarget.loop import Step
    from cotarget.policies import Policy

# Those of `cotarget.policies`, which --help does not import; the paper's first.
POLICIES = ("first-come", "nearest-deadline", "most-served")


def add_choice(parser: argparse.ArgumentParser, default: str = POLICIES[0]) -> None:
    """Give a command its options for whom to follow, and say what it does without."""
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--policy",
        choices=POLICIES,
        help="of several targets: the first until it disappears, each in turn and who leaves first before others, "
        f"or in the order in which most get a good close-up ({default})",
    )
    which.add_argument(
        "--click",
        type=number,
        nargs=2,
        metavar=("U", "V"),
        help="only the target at this pixel of the wide view, from (0, 0) at the top left [px]: the first confirmed "
        "track there or near",
    )
    which.add_argument(
        "--track", type=count, metavar="N", help="only the track of this number, as film and table have it"
    )


def check_shown(config: "RigConfig", name: str, rig: Path) -> None:
    """Refuse to follow what a simulated scene does not show.

    Args:
        config: of the rig.
        name: of the target, one of the configuration's.
        rig: the configuration's file.

    Raises:
        ConfigError: it is not there, with what would be right.
    """
    from cotarget.simchecks import told_targets
    from cotarget.simconfig import TARGETS, split_name

    if config.backend != "sim" or name in config.sim.targets:
        return
    own = config.sim.models
    if split_name(name)[0] not in (*TARGETS, *own):
        raise ConfigError(
            f"--target: a simulated {name} cannot be, whatever [targets.{name}] says; {told_targets(own)}"
        )
    raise ConfigError(
        f"{rig}: the simulated scene has no {name}; add it: [sim] targets = {json.dumps([*config.sim.targets, name])}"
    )


class Choice:
    """Whom the options ask for, and whether it was ever there.

    Attributes:
        whom: in words that a recording keeps.
        policy: makes what decides.
    """

    def __init__(self, options: argparse.Namespace, size: tuple[int, int], recorded: Whom = ANYBODY) -> None:
        """Read the options.

        Args:
            options: with those of `add_choice`.
            size: (width, height) of the wide view [px].
            recorded: whom a recorded run followed, for where no option says anything else.

        Raises:
            ConfigError: the click is not in the wide view, or a recording's policy is unknown.
        """
        from cotarget.policies import POLICIES as MAKERS
        from cotarget.policies import Chosen

        self._wish = ""
        self._seen: set[int] = set()
        self._followed = False
        self.policy: Callable[[], Policy]
        self.whom = _whom(options, recorded)
        if self.whom.click is not None:
            u, v = self.whom.click
            said = "the recorded click" if options.click is None else "--click"
            if not (-0.5 <= u <= size[0] - 0.5 and -0.5 <= v <= size[1] - 0.5):
                raise ConfigError(f"{said}: ({u:g}, {v:g}) is not in the wide view's {size[0]}x{size[1]} image")
            self.policy = partial(Chosen, pixel=(u, v), width_px=size[0])
            self._wish = f"{said}: no track came near ({u:g}, {v:g})"
        elif self.whom.track is not None:
            self.policy = partial(Chosen, number=self.whom.track)
            said = "the recorded track" if options.track is None else "--track"
            self._wish = f"{said}: there was no track {self.whom.track}"
        elif self.whom.policy is not None and self.whom.policy in MAKERS:
            self.policy = MAKERS[self.whom.policy]
        else:
            raise ConfigError(
                f"the recorded policy '{self.whom.policy}' is unknown; give --policy, one of: {choices(MAKERS)}"
            )

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


def _whom(options: argparse.Namespace, recorded: Whom) -> Whom:
    """What the options say; else what was recorded; else the first policy, by its name, in case that changes."""
    if options.click is not None:
        return Whom(click=(options.click[0], options.click[1]))
    if options.track is not None or options.policy is not None:
        return Whom(options.policy, None, options.track)
    return Whom(POLICIES[0]) if recorded == ANYBODY else recorded
