"""Why the loop did what it did: how often each reason was, and which of them a user should hear of."""

import re
from collections import Counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cotarget.loop import Step

NUMBER = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?")
ANY = "#"  # stands for a number
EITHER = re.compile(rf"(\w[^;]*{ANY}) or \1")  # one solution or two make one reason
# How the reasons begin that every good run has for a moment: a lens that waits, a target that is hidden or not yet
# there. Only where they are for most of the frames after the first sighting is something wrong.
USUAL = (
    "zoom: ",
    "nothing is detected",
    "what is detected is not believed yet",
    "out of sight",
    "looked for",
    "the head waits: where it is by now",
    "no track ",  # told by the option that asks for it
    "track ",
)
MOST, MANY = 0.5, 25  # share of those frames, and the fewest frames, from which these are told
SOME, FEW = 0.05, 5  # and of all frames, from which every other reason is
IN_WORDS = {
    "zoom: unsure": "zoom: unsure, so the lens stays wider than wanted: where the target is, is not known well enough, "
    "or the head is too slow for it"
}


class Reasons:
    """Counts the reasons of a run's Steps, whose numbers do not matter: 0.5 s and 0.6 s are one reason."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._later: Counter[str] = Counter()  # those after the first sighting
        self._latest: dict[str, str] = {}
        self._steps = self._later_steps = 0

    def see(self, step: "Step") -> None:
        """Count a Step's reasons."""
        parts = {folded(part): part for part in step.reason.split("; ") if part}
        self._steps += 1
        self._counts.update(parts.keys())
        if self._later_steps or step.target is not None:
            self._later_steps += 1
            self._later.update(parts.keys())
        self._latest |= parts

    @property
    def table(self) -> dict[str, int]:
        """In how many frames each reason was, the most frequent first."""
        return dict(self._counts.most_common())

    @property
    def warning(self) -> str:
        """What went wrong for how many frames, the most frequent first, with the latest numbers; empty if nothing."""
        wrong = [(count, name) for name, count in self._counts.most_common() if self._is_wrong(name, count)]
        told = [f"{count} of {self._steps} frames: {IN_WORDS.get(name, self._latest[name])}" for count, name in wrong]
        return " ".join("; ".join(told).split())  # one line, whatever a device says

    def _is_wrong(self, name: str, count: int) -> bool:
        """Whether a reason was there for too many frames."""
        if name.startswith(USUAL):
            return self._later[name] >= max(MANY, MOST * self._later_steps)
        return count >= max(FEW, SOME * self._steps)


def folded(reason: str) -> str:
    """A reason with its numbers taken out."""
    return EITHER.sub(r"\1", NUMBER.sub(ANY, reason))
