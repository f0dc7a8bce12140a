"""Turns tables, as TOML gives them, into frozen dataclasses by the types of their fields."""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from cotarget.errors import ConfigError, choices
from cotarget.geometry import RigidTransform, pose

KINDS = {int: "whole numbers", float: "numbers", str: "texts"}  # what lists are of, beside lists


def expect_table(value: Any, where: str) -> None:
    """Refuse what is not a table."""
    if not isinstance(value, Mapping):
        raise ConfigError(f"{where}: {value!r} is not a table")


def build(cls: type[Any], table: Any, where: str, base: Any = None) -> Any:
    """Make a dataclass from a table.

    Args:
        cls: the dataclass; its fields' types say what each value must be.
        table: of values; what is not said keeps its default.
        where: dotted name of the table, for messages.
        base: an instance whose values are the defaults instead.

    Raises:
        ConfigError: an unknown key with the valid ones, a missing key, or a value of the wrong kind.
    """
    expect_table(table, where or "the file")
    hints = typing.get_type_hints(cls, include_extras=True)
    unknown = sorted(set(table) - set(hints))
    if unknown:
        raise ConfigError(f"unknown key '{_join(where, unknown[0])}'; valid here: {choices(hints)}")
    values = {name: _convert(hints[name], value, _join(where, name)) for name, value in table.items()}
    if base is not None:
        return dataclasses.replace(base, **values)
    required = {
        f.name
        for f in dataclasses.fields(cls)
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
    }
    missing = sorted(required - set(values))
    if missing:
        raise ConfigError(f"{where}: missing key '{missing[0]}'; needed here: {choices(required)}")
    return cls(**values)


def _join(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _convert(hint: Any, value: Any, where: str) -> Any:
    """Check one value against its field's type and convert it."""
    hint, form = _parts(hint)
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):  # the only unions are "or None", which TOML cannot say
        return _convert(args[0], value, where)
    if origin is Literal:
        if value not in args or isinstance(value, bool):
            raise ConfigError(f"{where}: {value!r} is not one of: {choices(map(str, args))}")
        return value
    if hint is Path:
        if not _convert(str, value, where):
            raise ConfigError(f"{where}: is empty; give a path, or leave it out")
        return Path(value)
    if hint is RigidTransform:
        return _convert_pose(value, where)
    if dataclasses.is_dataclass(hint):
        return build(typing.cast(type[Any], hint), value, where)
    if origin is tuple:
        return _convert_tuple(args, value, where, form)
    if origin is Mapping or (isinstance(origin, type) and issubclass(origin, Mapping)):
        expect_table(value, where)
        return {key: _convert(args[1], item, _join(where, key)) for key, item in value.items()}
    if hint is float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ConfigError(f"{where}: {value!r} is not a finite number")
        return float(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        kinds = {int: "a whole number", str: "a text", bool: "true or false"}
        raise ConfigError(f"{where}: {value!r} is not {kinds[hint]}")
    return value


def _parts(hint: Any) -> tuple[Any, str]:
    """A type, and the words beside it for what its values are: `Annotated[type, words]`; empty where there are none."""
    if typing.get_origin(hint) is Annotated:
        hint, form = typing.get_args(hint)
        return hint, form
    return hint, ""


def _convert_tuple(args: tuple[Any, ...], value: Any, where: str, form: str = "") -> tuple[Any, ...]:
    several = args[-1] is Ellipsis
    if several and not form and (one := _parts(args[0])[1]):
        form = f"[{one}, ...]"
    form = form and f", {form}"
    if not isinstance(value, list):
        kinds = [kind for kind in args if kind is not Ellipsis]
        kind = KINDS.get(kinds[0] if len(set(kinds)) == 1 else float, "lists")
        raise ConfigError(f"{where}: {value!r} is not a list of {'' if several else f'{len(args)} '}{kind}{form}")
    if several:
        return tuple(_convert(args[0], item, f"{where}[{i}]") for i, item in enumerate(value))
    if len(value) != len(args):
        raise ConfigError(f"{where}: has {len(value)} values where {len(args)} are wanted{form}")
    return tuple(_convert(a, item, f"{where}[{i}]") for i, (a, item) in enumerate(zip(args, value, strict=True)))


def _convert_pose(value: Any, where: str) -> RigidTransform:
    expect_table(value, where)
    keys = {"translation", "rotvec_deg"}
    if set(value) != keys:
        wrong = sorted(set(value) ^ keys)[0]
        raise ConfigError(
            f"{where}: {'unknown' if wrong in value else 'missing'} key '{wrong}'; needed: {choices(keys)}"
        )
    triple = (float, float, float)
    translation = _convert_tuple(triple, value["translation"], f"{where}.translation", "[x, y, z]")
    rotvec_deg = _convert_tuple(triple, value["rotvec_deg"], f"{where}.rotvec_deg", "[rx, ry, rz]")
    try:
        return pose(translation, rotvec_deg)
    except ValueError as error:
        raise ConfigError(f"{where}.{error}") from None
