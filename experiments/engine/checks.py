"""Checks of experiments' settings before any work; a wrong setting raises an error of one line."""

from collections.abc import Iterator, Sequence

from cotarget.calibration.initialization import FEWEST_VIEWS
from cotarget.errors import ConfigError
from cotarget.sim.targets.random_paths import SECONDS
from experiments.engine.harness import Settings

FEWEST_LOOKS = 2  # least number of views of a static board that determine the zoom camera's pose on the head


def check_above(low: float, settings: Settings, *names: str) -> None:
    """Refuse settings that are not above a limit.

    Args:
        low: the limit.
        settings: settings of an experiment.
        names: names of the settings to check, which are numbers or tuples of numbers.

    Raises:
        ConfigError: a number is not above the limit, or a tuple is empty.
    """
    for name, each in _numbers(settings, names):
        if not each > low:
            raise ConfigError(f"{name}: {each:g} is not above {low:g}")


def check_least(least: float, settings: Settings, *names: str) -> None:
    """Refuse settings that are below a limit; arguments and errors as for `check_above`."""
    for name, each in _numbers(settings, names):
        if not each >= least:
            raise ConfigError(f"{name}: {each:g} is below {least:g}")


def check_session(settings: Settings, boards: str, looks: str) -> None:
    """Refuse capture sessions that cannot give a calibration.

    Args:
        settings: settings of an experiment.
        boards: name of the setting with the number of board placements.
        looks: name of the setting with the number of head poses per placement.

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
    """Refuse runs longer than the targets' paths: targets that stand still at the end are easily followed.

    Args:
        settings: settings of an experiment.
        names: names of the settings with a run's length [s].
        end_s: length of the paths [s].

    Raises:
        ConfigError: a run is longer than the paths.
    """
    for name in names:
        if not (value := getattr(settings, name)) <= end_s:
            raise ConfigError(f"{name}: {value:g} is above {end_s:g}, up to which there are ways to go")
