"""Which numbers of detection and tracking matter: each is changed by 30 % either way, and six films are searched again.

A number is a constant of a module, a default of a dataclass, or an entry of a table, of `auto`'s parts and of the
tracker. Each is changed in the source as its module is loaded, in a process of its own, so that what is computed from
it changes too. Besides films of the half for development, drawn rain and foliage are searched, which have no targets.
A number that moves no figure is one to delete.
"""

import ast
import importlib.abc
import importlib.machinery
import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2

from experiments.engine import ROOT, Row
from experiments.following import empty, films
from experiments.following.films import FilmsSettings, LabelledFilm
from experiments.tables import grouped

PARTS = ("auto", "background", "base", "exposure", "small_target/*")
FILES = [f"cotarget/detection/{part}.py" for part in PARTS] + ["cotarget/tracking/track*.py"]
# Numbers of these files that `auto` and its tracks do not use, or that tune nothing.
OTHERS = ("FOREGROUND", "UNKNOWN_SCORE", "IMPOSSIBLE", "BY_MOTION['standing']", "BY_DETECTOR")
FIGURES = ("recall", "precision", "numbers", "false", "first_track_s")
LEAST = 0.005  # change of a figure that counts
FAILED = "fails"  # figure of a value with which nothing works


@dataclass(frozen=True)
class NumbersSettings(FilmsSettings):
    """Settings: films, and by how much a number is changed."""

    films: tuple[str, ...] = ("V_BIRD_021", "V_DRONE_114", "V_HELICOPTER_012", "V_AIRPLANE_047", "car", "vtest")
    drawn: tuple[str, ...] = ("rain", "foliage")
    frames: int = 100  # searched of each film, from the first on
    times: float = 1.3  # a number is multiplied and divided by this


@dataclass(frozen=True)
class Number:
    """A number in the source.

    Attributes:
        path: file, relative to the project.
        name: its name; with that of its class or table before it.
        node: its value in the source.
    """

    path: str
    name: str
    node: ast.expr

    @property
    def title(self) -> str:
        """File and name."""
        return f"{self.path.removeprefix('cotarget/').removesuffix('.py')}: {self.name}"


def numbers_of(path: str, tree: ast.Module) -> Iterator[Number]:
    """List the numbers of a module."""
    for statement in tree.body:
        inside = f"{statement.name}." if isinstance(statement, ast.ClassDef) else ""
        for each in statement.body if isinstance(statement, ast.ClassDef) else [statement]:
            for name, value in _assigned(each):
                if not name.startswith("_"):
                    yield from (Number(path, inside + where, node) for where, node in _parts(name, value))


def _assigned(statement: ast.stmt) -> Iterator[tuple[str, ast.expr]]:
    """List the names that a statement gives a value, with the values."""
    if isinstance(statement, ast.AnnAssign) and statement.value is not None:
        yield ast.unparse(statement.target), statement.value
    elif isinstance(statement, ast.Assign):
        target, value = statement.targets[0], statement.value
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            yield from zip(map(ast.unparse, target.elts), value.elts, strict=True)
        else:
            yield ast.unparse(target), value


def _parts(name: str, value: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    """List a number, or the numbers of a table."""
    if isinstance(value, ast.Dict):
        for key, entry in zip(value.keys, value.values, strict=True):
            if key is not None:
                yield from _parts(f"{name}[{ast.unparse(key)}]", entry)
    elif _value(value) is not None:
        yield name, value


def _value(node: ast.expr) -> Any:
    """Compute a number or a tuple of numbers; None if it is neither."""
    try:
        value = eval(compile(ast.Expression(node), "", "eval"), {"__builtins__": {}})
    except Exception:
        return None
    parts = value if isinstance(value, tuple) else (value,)
    good = all(isinstance(part, int | float) and not isinstance(part, bool) and part for part in parts)
    return value if good and parts else None


def changed(value: Any, times: float) -> Any:
    """Multiply a number, or each of a tuple; a whole number changes by 1 at least, and stays above 0."""
    if isinstance(value, tuple):
        return tuple(changed(part, times) for part in value)
    if isinstance(value, float):
        return value * times
    step = max(1, abs(round(value * times) - value))
    return max(1, value + step if times > 1 else value - step)


def all_numbers() -> list[Number]:
    """List the numbers of all parts."""
    paths = [str(path.relative_to(ROOT)) for file in FILES for path in sorted(ROOT.glob(file))]
    found = [each for path in paths for each in numbers_of(path, ast.parse(Path(ROOT, path).read_text()))]
    return [each for each in found if not each.name.startswith(OTHERS)]


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads a module with one number changed."""

    change: tuple[str, float]

    def get_code(self, fullname: str) -> Any:
        """Compile the changed source."""
        name, times = self.change
        tree = ast.parse(self.get_data(self.path))
        (number,) = (each for each in numbers_of(self.path, tree) if each.name == name)
        new = ast.parse(repr(changed(_value(number.node), times)), mode="eval").body
        for parent in ast.walk(tree):
            for field, old in ast.iter_fields(parent):
                if old is number.node:
                    setattr(parent, field, new)
                elif isinstance(old, list):
                    setattr(parent, field, [new if each is number.node else each for each in old])
        return compile(ast.fix_missing_locations(tree), self.path, "exec")


class _Finder(importlib.abc.MetaPathFinder):
    """Finds the module whose number is changed."""

    def __init__(self, path: str, name: str, times: float) -> None:
        self._module, self._change = path.removesuffix(".py").replace("/", "."), (name, times)

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> Any:
        """Find it with a loader that changes it."""
        if fullname != self._module:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path)
        assert spec is not None, fullname
        spec.loader = loader = _Loader(fullname, str(spec.origin))
        loader.change = self._change
        return spec


def jobs(settings: NumbersSettings) -> Sequence[int]:
    """Give 0 for the numbers as they are, and one for each number."""
    return range(min(settings.seeds, 1 + len(all_numbers())))


def needs(settings: NumbersSettings) -> str:
    """Describe what is missing to run; empty if nothing."""
    return films.needs(settings)


def one(settings: NumbersSettings, job: int) -> list[Row]:
    """Search with a number changed either way; give a row a film, in the order of `all_numbers`."""
    number = all_numbers()[job - 1] if job else None
    changes = [(number.path, number.name, times) for times in (settings.times, 1 / settings.times)] if number else []
    given = json.dumps([settings.data, settings.films, settings.drawn, settings.frames, changes])
    command = [sys.executable, "-c", f"from experiments.following.numbers import main; main({given!r})"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    ran = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=environment, check=True)
    rows: list[Row] = json.loads(ran.stdout.splitlines()[-1])
    return [row | {"number": number.title if number else ""} for row in rows]


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Say how many numbers move no figure, and for each other which figures it moves, in which films."""
    known = {(row["film"], key): row[key] for row in rows if not row["number"] for key in FIGURES}
    moved: dict[str, str] = {}
    for number, mine in grouped([row for row in rows if row["number"]], "number").items():
        found = {
            f"{row['film']} {key}" for row in mine for key in FIGURES if _differs(row[key], known[row["film"], key])
        }
        moved[number] = ", ".join(sorted(found))
    idle = [number for number, found in moved.items() if not found]
    return {"numbers": len(moved), "move nothing": len(idle), "idle": idle, "moved": moved}


def _differs(one: Any, other: Any) -> bool:
    if FAILED in (one, other) or None in (one, other):
        return bool(one != other)
    return abs(one - other) > LEAST


def describe(_: NumbersSettings, summary: Mapping[str, Any]) -> str:
    """List the numbers that move nothing, then what each other moves."""
    lines = [f"{summary['move nothing']} of {summary['numbers']} numbers move no figure:", *summary["idle"], ""]
    return "\n".join([*lines, *(f"{number}: {found}" for number, found in summary["moved"].items() if found)])


def change_when_loaded(path: str, name: str, times: float) -> None:
    """Load the project's modules again when they are next imported, with a number of one of them changed."""
    for module in [name for name in sys.modules if name.startswith(("cotarget", "experiments"))]:
        del sys.modules[module]
    sys.meta_path[:] = [each for each in sys.meta_path if not isinstance(each, _Finder)]
    sys.meta_path.insert(0, _Finder(path, name, times))


def main(text: str) -> None:
    """Search films with each of some changes, and print rows as JSON; the work of the process that `one` starts."""
    data, names, drawn, frames, changes = json.loads(text)
    cv2.setNumThreads(1)
    half = {path.stem: path for path in films.films_of_half(FilmsSettings(data=data))}
    searched = [films.film_to_score(half[name], frames) for name in names]
    searched += [_drawn(scene, frames) for scene in drawn]
    rows = []
    for change in changes or [None]:
        if change:
            change_when_loaded(*change)
        rows += [_row(film) | {"times": change[2] if change else 1.0} for film in searched]
    print(json.dumps(rows))


def _drawn(scene: str, frames: int) -> LabelledFilm:
    """Draw a film without targets."""
    images = list(itertools.islice(empty.film(scene, empty.SETTINGS, 0), frames))
    return LabelledFilm(scene, images, empty.SETTINGS.rate_hz, labels={}, flyers={})


def _row(film: LabelledFilm) -> Row:
    """Search a film with the modules that are loaded now, and score it with those of before."""
    try:
        from cotarget.detection import make_detector
        from cotarget.tracking.track import tracking_settings
        from experiments.following.films import tracks_of

        target = replace(film.target, detector="auto")
        least = tracking_settings(target).confirm_score
        tracks = tracks_of(make_detector(target, film.rate_hz), target, [least], film.frames)[least]
    except Exception:  # nothing works with the changed number
        return {"film": film.name} | dict.fromkeys(FIGURES, FAILED)
    row = film.row("", 0, 0, tracks)
    right = row["found"] + row["false_boxes"]
    return {
        "film": film.name,
        "recall": row["found"] / row["boxes"] if row["boxes"] else None,
        "precision": row["found"] / right if right else None,
        "numbers": row["numbers"],
        "false": row["no_flyer"],
        "first_track_s": row["first_track_s"],
    }


SETTINGS = NumbersSettings()
QUICK = replace(SETTINGS, seeds=2, films=("V_DRONE_114",), frames=20, drawn=())
COST_S = 20.0
