"""Cases to run: experiments by name with their settings, or with several settings to compare."""

import dataclasses
import difflib
import hashlib
import importlib
import itertools
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cotarget.errors import ConfigError, choices
from cotarget.plugins import is_own
from cotarget.schema import validate
from experiments.engine.harness import Experiment, Settings
from experiments.engine.results import identity

MODULES = (  # in the order of the report
    "experiments.calibration.hand_eye",
    "experiments.calibration.chain",
    "experiments.calibration.random_rigs",
    "experiments.calibration.mismatch",
    "experiments.calibration.honesty",
    "benchmarks.speed",
    "experiments.calibration.photos",
    "experiments.calibration.pointing",
    "experiments.calibration.zoom_range",
    "experiments.wire.wire",
    "experiments.following.hold",
    "experiments.following.first_shot",
    "experiments.following.delay",
    "experiments.following.five_targets",
    "experiments.following.dead_zone",
    "benchmarks.sim_speed",
    "benchmarks.pipeline_speed",
    "benchmarks.sweep_speed",
    "experiments.following.detectors",
    "experiments.following.env_score",
    "benchmarks.env_speed",
    "experiments.following.shortcut",
    "experiments.following.models",
    "experiments.following.depth_error",
    "experiments.calibration.calibration_budget",
    "experiments.following.single_ptz",
    "experiments.paper.table2_table3",
    "experiments.paper.worked_example",
    "experiments.paper.fig4_book",
    "experiments.paper.fig5_person",
    "experiments.paper.fig6_outdoors",
)
EXPERIMENTS = {module.rpartition(".")[2]: module for module in MODULES}
PROCESSES = "processes"
SIGNED = ("depth_error.wrong",)  # settings that may be negative
SHORT = 6  # digits of the hash in a folder's name, where a title is not a valid name
Known = Mapping[str, Callable[[], Experiment[Any]]]


def _load(module: str) -> Experiment[Any]:
    experiment: Experiment[Any] = importlib.import_module(module).EXPERIMENT
    return experiment


def known_experiments() -> Known:
    """Give all experiments by name; each is loaded when its function is called."""
    return {name: lambda module=module: _load(module) for name, module in EXPERIMENTS.items()}  # type: ignore[misc]


@dataclass(frozen=True)
class Case:
    """Experiment with given settings.

    Attributes:
        experiment: the experiment.
        settings: its settings.
        changes: changed settings, as typed.
        quick: whether it is a quick run, which is too short for the experiment's goals.
    """

    experiment: Experiment[Any]
    settings: Settings
    changes: tuple[str, ...] = ()
    quick: bool = False

    @property
    def title(self) -> str:
        """Name of the case: the experiment and its changed settings."""
        return ", ".join([self.experiment.name, *self.changes])

    @property
    def folder(self) -> str:
        """Name of the case's folder: the title with other characters replaced, and a hash where some were."""
        plain = re.sub(r"[^\w.=,-]+", "_", self.title.replace(", ", ","))
        if plain == self.title.replace(", ", ","):
            return plain
        return f"{plain}-{hashlib.sha256(self.title.encode()).hexdigest()[:SHORT]}"

    @property
    def numbers(self) -> Sequence[int]:
        """Numbers of the jobs."""
        return self.experiment.jobs(self.settings)

    @property
    def has_bounds(self) -> bool:
        """Whether this is the unchanged quick run, whose figures have bounds."""
        quick = self.experiment.quick
        return identity(self.settings) == identity(quick) and self.settings.seeds == quick.seeds


def choose(
    known: Known,
    names: Sequence[str],
    *,
    quick: bool = False,
    seeds: int | None = None,
    seed_base: int | None = None,
    changes: Sequence[str] = (),
) -> list[Case]:
    """Make the cases of a run.

    Args:
        known: known experiments.
        names: experiments to run; all if empty.
        quick: whether to use the quick settings.
        seeds: number of seeds; by default each experiment's own.
        seed_base: first seed; by default each experiment's own.
        changes: settings as NAME.KEY=VALUE with a TOML value. A key that is given more than once makes a case of each
            distinct value, in combination with the values of other keys.

    Raises:
        ConfigError: an unknown experiment or setting, or an invalid value.
    """
    chosen = list(dict.fromkeys(_checked(name, known) for name in names)) or list(known)
    values = _parsed(changes, known, chosen)
    cases = []
    for name in chosen:
        experiment = known[name]()
        base = experiment.quick if quick else experiment.settings
        told = {"seeds": seeds, "seed_base": seed_base}
        base = dataclasses.replace(base, **{key: value for key, value in told.items() if value is not None})
        mine, already = values.get(name, {}), list[Settings]()
        for picked in itertools.product(*([(key, text) for text in texts] for key, texts in mine.items())):
            tables = {key: _value(text) for key, text in picked}
            settings = validate(type(base), tables, name, base=base)
            for key in tables:
                _check(settings, key, f"{name}.{key}")
            if settings in already:  # the same values in another spelling
                continue
            already.append(settings)
            cases.append(Case(experiment, settings, tuple(f"{key}={text}" for key, text in picked), quick))
    return cases


def _check(settings: Settings, key: str, where: str) -> None:
    """Refuse a value with which every seed would fail.

    Integers are counts, other numbers are measures, and durations must be above zero. A text must be one of the
    default's.

    Raises:
        ConfigError: the value is invalid.
    """
    usual = next(field.default for field in dataclasses.fields(settings) if field.name == key)
    value = getattr(settings, key)
    if value == () and usual:
        raise ConfigError(f"{where}: is empty; at least one is needed")
    for each in value if isinstance(value, tuple) else (value,):
        if isinstance(each, str):
            if isinstance(usual, tuple) and usual and each not in usual and not is_own(each):
                raise ConfigError(f"{where}: {each!r} is not one of: {choices(usual)}")
        elif not isinstance(each, bool):
            least = 1 if isinstance(each, int) and usual else 0
            if each < least and where not in SIGNED:
                raise ConfigError(f"{where}: {each:g} is below {least}")
            if each == 0 and (key.startswith("seconds") or key.endswith("_s")):
                raise ConfigError(f"{where}: lasts no time")


def _checked(name: str, known: Known) -> str:
    if name in known:
        return name
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
    raise ConfigError(f"unknown experiment '{name}', the nearest is '{near[0]}'; there are: {choices(known)}")


def _parsed(changes: Sequence[str], known: Known, chosen: Sequence[str]) -> dict[str, dict[str, list[str]]]:
    """Collect the values' texts by experiment and key."""
    values: dict[str, dict[str, list[str]]] = {}
    for change in changes:
        path, equals, text = change.partition("=")
        name, dot, key = path.partition(".")
        if not (equals and dot and key):
            raise ConfigError(f"'{change}' is not like NAME.KEY=VALUE, such as chain.noise_px=0.1")
        if _checked(name, known) not in chosen:
            raise ConfigError(f"'{change}': {name} is not among those to run: {choices(chosen)}")
        if key == PROCESSES:
            raise ConfigError(f"'{change}': how many processes there are changes no row; say --processes")
        texts = values.setdefault(name, {}).setdefault(key, [])
        if text not in texts:
            texts.append(text)
    return values


def _value(text: str) -> Any:
    """Parse a TOML value; anything else is a text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
