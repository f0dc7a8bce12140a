"""Make the tables of configuration.md and cli.md from the code.

Both pages hold an introduction and a mark; `python docs/make_reference.py` writes anew what is below it. A test checks
that both pages are as the code is.
"""

import argparse
import dataclasses
import json
import re
import typing
from collections.abc import Iterator, Mapping, Sequence
from functools import partial, reduce
from pathlib import Path
from typing import Annotated, Any, Literal

from cotarget.backends import check
from cotarget.cli.main import COMMANDS, make_parser
from cotarget.config import DEFAULT_TARGETS, HardwareConfig, RigConfig, parse_config
from cotarget.drivers import DRIVERS
from cotarget.drivers.board import BoardSettings
from cotarget.drivers.rig import ROLES, device_of
from cotarget.errors import ConfigError
from cotarget.geometry import RigidTransform
from cotarget.schema import bare, form_of, keys_of, toml_text

MARK = "<!-- made from the code -->"
KINDS = {bool: "boolean", int: "integer", float: "number", str: "string", Path: "path"}
UNITS = {"deg_s2": "degrees/s^2", "deg_s": "degrees/s", "deg": "degrees", "px": "px", "mm": "mm", "hz": "Hz", "s": "s"}
UNIT_IN_TEXT = re.compile(r" \[(m|s|px|mm|degrees|degrees/s|degrees/s\^2|grey levels)\]")


def pages() -> dict[Path, str]:
    """Make the text of both pages: the introduction as it is, and below the mark what is made from the code."""
    made = {"configuration.md": configuration(), "cli.md": command_line()}
    texts = {Path(__file__).with_name(name): text for name, text in made.items()}
    return {page: f"{page.read_text('utf-8').partition(MARK)[0]}{MARK}\n\n{text}" for page, text in texts.items()}


def configuration() -> str:
    """Describe every table of rig.toml and every key in it."""
    keys = ("size", "dimension", "wanted_px", "detector")
    known = [(f"`{name}`", *(_toml(getattr(each, key)) for key in keys)) for name, each in DEFAULT_TARGETS.items()]
    return "\n".join((*_tables("", RigConfig), "These targets need no table:\n", _grid(("target", *keys), known)))


def _hardware() -> Iterator[str]:
    """Describe the tables of [hardware], one a driver, and the board's."""
    yield _heading("`[hardware]`", "hardware")
    yield (
        "The real devices. The key `driver` of a device's table names its driver, and the driver says which other keys "
        'there are. A driver of your own is `"module:class"`, see [Drivers](drivers.md).\n'
    )
    for role in ROLES:
        for driver in DRIVERS[role]:
            yield from _tables(f"hardware.{role}", device_of(role, {"driver": driver}).driver.Settings, driver)
    yield from _tables("hardware.board", BoardSettings)


def _tables(where: str, cls: type[Any], driver: str = "") -> Iterator[str]:
    """Describe one table, then the tables in it."""
    rows, inner = list[tuple[str, ...]](), list[Any]()
    for each in keys_of(cls):
        name, hint, default, meaning = each
        key = f"{where}.{name}".lstrip(".")
        if each.table is not None:
            inner.append((f"{key}.NAME" if typing.get_origin(bare(hint)) is Mapping else key, each.table))
            continue
        by_suffix = [unit for end, unit in UNITS.items() if name.endswith(f"_{end}")]
        unit, meaning = (UNIT_IN_TEXT.findall(meaning) or by_suffix or [""])[0], UNIT_IN_TEXT.sub("", meaning)
        rows.append((f"`{name}`", _kind(hint), unit, _toml(default), _range(key, hint, default, driver), meaning))
    title, anchor = f"`[{where}]`" if where else "Outside of the tables", where or "backend"
    if driver:
        names = DRIVERS[where.rpartition(".")[2]]
        first = next(iter(names))
        anchor += "" if driver == first else f".{driver}"
        title += "" if len(names) == 1 and where != "hardware.ptz" else f" with driver `{driver}`"
        choices = f'{", ".join(json.dumps(name) for name in names)} or `"module:class"`'
        default = "required" if where == "hardware.ptz" else f"`{json.dumps(first)}`"
        rows.insert(0, ("`driver`", "string", "", default, choices, f"the driver; here `{driver}`"))
    yield _heading(title, anchor)
    yield (cls.__doc__ or "").partition("Attributes:")[0].replace("\n    ", "\n").strip() + "\n"
    yield _grid(("key", "type", "unit", "default", "range", "meaning"), rows) if rows else ""
    for key, held in inner:
        yield from _hardware() if held is HardwareConfig else _tables(key, held)


def _kind(hint: Any) -> str:
    """Name a type."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if form := form_of(hint):
        return f"`{form}`"
    if origin is Annotated:
        return "pose" if args[0] is RigidTransform else _kind(args[0])
    if origin is Literal:
        return ", ".join(f"`{json.dumps(each)}`" for each in args)
    if origin is tuple:
        return f"list of {_kind(args[0])}" if args[-1] is ... else f"[{', '.join(map(_kind, args))}]"
    if origin is Mapping:
        return f"table: NAME = {_kind(args[1])}"
    return KINDS[hint] if hint in KINDS else _kind(args[0])  # X or None


def _toml(value: Any) -> str:
    """Write a default as rig.toml has it."""
    if value in (None, dataclasses.MISSING):
        return "none" if value is None else "required"
    return f"`{toml_text(value)}`"


def _range(key: str, hint: Any, default: Any, driver: str) -> str:
    """Find by trying which numbers are accepted while all other keys have their defaults."""
    number: Any = bare(hint)
    if number not in (int, float):
        return ""
    usual = default if isinstance(default, int | float) else 1.0
    if choices := _refusal(key, driver, usual + 1).partition("is not one of: ")[2]:
        return choices
    words = []
    for inclusive, exclusive, bad in (("≥", ">", -(10**9)), ("≤", "<", 10**9)):
        if _refusal(key, driver, number(bad)):
            good = usual
            while abs(good - bad) > (1 if number is int else 1e-9):
                middle = number((good + bad) / 2)
                good, bad = (good, middle) if _refusal(key, driver, middle) else (middle, bad)
            edge = number(round(good, 6))
            words.append(f"{exclusive if _refusal(key, driver, edge) else inclusive} {edge:g}")
    return " and ".join(words)


def _refusal(key: str, driver: str, value: float) -> str:
    """Say why a value is refused; empty where it is accepted."""
    table: dict[str, Any] = {"sim": {"effects": {"optics": False}}}  # with it, a check takes ten times as long
    *path, name = (key := key.replace("NAME", "book")).split(".")
    last = reduce(lambda inner, part: inner.setdefault(part, {}), path, table)
    last |= {name: value, **({"driver": driver} if driver else {})}
    try:
        check(parse_config(table))
    except ConfigError as error:
        return str(error) if str(error).startswith(key) else ""
    return ""


def command_line() -> str:
    """Describe every command and its arguments."""
    commands = next(a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction)).choices
    parts = []
    for name, parser in ((name, commands[name]) for name in COMMANDS):
        parser.formatter_class = partial(argparse.HelpFormatter, width=96)
        parts += [_heading(f"cotarget {name}", name), f"{parser.description[:1].upper()}{parser.description[1:]}.\n"]
        parts.append(f"```text\n{parser.format_usage()}```\n".replace("usage: ", "").replace("\n       ", "\n"))
        hidden = [a.dest for a in parser._actions if a.help == argparse.SUPPRESS]
        write = parser._get_formatter()._format_action_invocation
        rows = [(f"`{write(a)}`", a.help or "") for a in parser._actions if a.dest not in ("help", "verbose", *hidden)]
        parts.append(_grid(("argument", "meaning"), rows) if rows else "")
        epilog = parser.make_epilog() if parser.make_epilog else parser.epilog
        parts.append(f"```text\n{epilog}\n```\n" if epilog else "")
        parts.append(f"Example: `{parser.example}`\n")
    return "\n".join(parts)


def _heading(title: str, anchor: str) -> str:
    """Write a heading with an anchor that GitHub knows too."""
    return f'<a id="{anchor}"></a>\n\n## {title}\n'


def _grid(heads: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """Write a table in Markdown."""
    lines = [heads, ("---",) * len(heads), *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


if __name__ == "__main__":
    for page, text in pages().items():
        page.write_text(text, "utf-8")
