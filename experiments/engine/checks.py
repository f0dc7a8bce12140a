"""What experiments' settings are held to before any work: whoever gives something else is told so in one line."""

from collections.abc import Iterator, Sequence

from cotarget.calibration.initialization import FEWEST_VIEWS
from cotarget.errors import ConfigError
from cotarget.sim.targets.random_paths import SECONDS
from experiments.engine.harness import Settings

FEWEST_LOOKS = 2  # at a board that stays where it is, that tell how the zoom camera sits on the head


def check_above(low: float, settings: Settings, *names: str) -> None:
    """Refuse settings that cannot be, before any work.

    Args:
        low: what every number is to be above of.
        settings: of an experiment.
        names: of those that are numbers, or several.

    Raises:
        ConfigError: a number is not above that, or there is none.
    """
    for name, each in _numbers(settings, names):
        if not each > low:
            raise ConfigError(f"{name}: {each:g} is not above {low:g}")


def check_least(least: float, settings: Settings, *names: str) -> None:
    """The same where the least number is one that can be."""
    for name, each in _numbers(settings, names):
        if not each >= least:
            raise ConfigError(f"{name}: {each:g} is below {least:g}")


def check_session(settings: Settings, boards: str, looks: str) -> None:
    """Refuse calibrations that cannot come to anything.

    Args:
        settings: of an experiment.
        boards: name of the one that says how many placements of the board there are.
        looks: of the one that says from how many head poses each is looked at.

    Raises:
        ConfigError: there are too few for a camera's intrinsics, or for T.
    """
    check_least(FEWEST_VIEWS, settings, boards)
    check_least(FEWEST_LOOKS, settings, looks)


def _numbers(settings: Settings, names: Sequence[str]) -> Iterator[tuple[str, float]]:
    for name in names:
        value = getattr(settings, name)
        values = value if isinstance(value, tuple) else (value,)
        if not values:
            raise ConfigError(f"{name}: at least one number is needed")
        yield from ((name, each) for each in values)


def check_ways(settings: Settings, *names: str, end_s: float = SECONDS) -> None:
    """Refuse runs in which targets stand still at the end of their ways, where they are easily held.

    Args:
        settings: of an experiment.
        names: of those that say how long a run is [s].
        end_s: how long there are ways to go [s].

    Raises:
        ConfigError: a run is longer.
    """
    for name in names:
        if not (value := getattr(settings, name)) <= end_s:
            raise ConfigError(f"{name}: {value:g} is above {end_s:g}, up to which there are ways to go")
