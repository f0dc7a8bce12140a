"""Validate tables of TOML and JSON against frozen dataclasses, by pydantic; each error is one line that names the key.

`model` makes a frozen dataclass whose fields are strict: a bool or "12" is no number, an int may be a float, and an
unknown key is refused. Ranges are metadata of a field's type: those of annotated_types, and `OneOf`, `Check` and a text
such as "[lowest, highest]", which docs/configuration.md shows. A check across keys is a `__post_init__` that raises a
ValueError beginning with the key and a colon.

pydantic is imported at the first `validate`, because commands such as `cotarget stop` must be quick.
"""

import dataclasses
import functools
import inspect
import json
import re
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, cast, dataclass_transform

from annotated_types import Ge, Gt

from cotarget.errors import ConfigError, choices
from cotarget.geometry import RigidTransform, pose, pose_dict

T = TypeVar("T")
STRICT = {"strict": True, "extra": "forbid", "allow_inf_nan": False, "arbitrary_types_allowed": True}
ATTRIBUTE = re.compile(r"^    (\w+): (.*(?:\n {8}.*)*)", re.MULTILINE)  # of a docstring
CONFIG = "__pydantic_config__"  # where pydantic looks for a dataclass's settings


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def model(cls: type[T]) -> type[T]:
    """Make a frozen dataclass that `validate` reads strictly."""
    setattr(cls, CONFIG, STRICT)
    return dataclass(frozen=True)(cls)


# Types of fields


@dataclass(frozen=True)
class Check:
    """Refuse values of a field: the function raises a ValueError that says what is wrong.

    Attributes:
        function: takes the value and returns it.
        before: whether it takes the value as the table has it, and not as the field's type.
    """

    function: Callable[[Any], Any]
    before: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        """Describe the check to pydantic."""
        from pydantic_core import core_schema

        before, after = core_schema.no_info_before_validator_function, core_schema.no_info_after_validator_function
        return (before if self.before else after)(self.function, handler(source))


@dataclass(frozen=True)
class InFolder:
    """Complete a value that is relative to the folder of its file.

    Attributes:
        function: takes the value and the folder, and returns the complete value.
    """

    function: Callable[[Any, Path], Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        """Describe the completion to pydantic, whose context is the folder."""
        from pydantic_core import core_schema

        def complete(value: Any, info: Any) -> Any:
            return value if info.context is None else self.function(value, info.context)

        return core_schema.with_info_after_validator_function(complete, handler(source))


class OneOf(Check):
    """Take one of some numbers; a Literal would take True for 1."""

    def __init__(self, *values: int) -> None:
        def check(value: Any) -> Any:
            if isinstance(value, bool) or value not in values:
                raise ValueError(f"{value!r} is not one of: {', '.join(map(str, values))}")
            return value

        super().__init__(check, before=True)


@dataclass(frozen=True)
class Needed:
    """Mark a text that may be empty in a file, but not where the device is opened; see `missing_key`.

    Attributes:
        example: a value, for messages.
    """

    example: str


def missing_key(settings: Any) -> tuple[str, str] | None:
    """Find the first empty field that is `Needed`: its key, and an example; None if nothing is missing."""
    for key, hint in typing.get_type_hints(type(settings), include_extras=True).items():
        for needed in _metadata(hint):
            if isinstance(needed, Needed) and not getattr(settings, key):
                return key, needed.example
    return None


def _refuse_empty(value: Any) -> Any:
    if value == "":
        raise ValueError("is empty; give a path, or leave it out")
    return value


def _refuse_disorder(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] >= value[1]:
        raise ValueError(f"{list(value)} is not [lowest, highest]")
    return value


@dataclass(frozen=True)
class _AsPose:
    """Read a pose from its table."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(
            lambda table: pose(table.translation, table.rotvec_deg), handler.generate_schema(_PoseTable)
        )


Pair = tuple[float, float]
Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
ASCENDING = Check(_refuse_disorder)
Limits = Annotated[Pair, "[lowest, highest]", ASCENDING]
Size = Annotated[tuple[Annotated[int, Gt(0)], Annotated[int, Gt(0)]], "[width, height]"]
NotEmptyPath = Annotated[Path, Check(_refuse_empty, before=True)]
FilePath = Annotated[NotEmptyPath, InFolder(lambda path, folder: folder / path)]
Pose = Annotated[RigidTransform, _AsPose()]


@model
class _PoseTable:
    """A pose as a file has it: translation [m] and rotation vector [degrees]."""

    translation: Annotated[tuple[float, float, float], "[x, y, z]"]
    rotvec_deg: Annotated[tuple[float, float, float], "[rx, ry, rz]"]


# Description


class Key(NamedTuple):
    """A key of a table: its name, annotation, default, and what the dataclass's docstring says of it."""

    name: str
    hint: Any
    default: Any
    meaning: str

    @property
    def table(self) -> type[Any] | None:
        """The dataclass of the table that the key holds, or of each of its tables by name; None for a value."""
        hint = bare(self.hint)
        held = typing.get_args(hint)[1] if typing.get_origin(hint) is Mapping else hint
        return held if dataclasses.is_dataclass(held) else None  # type: ignore[return-value]


def keys_of(cls: type[Any]) -> list[Key]:
    """List the keys of a dataclass's table, with what "Attributes:" says of them in its docstring and its bases'."""
    sections = (inspect.cleandoc(each.__doc__ or "").partition("Attributes:\n")[2] for each in cls.__mro__[-2::-1])
    said = {name: " ".join(text.split()).rstrip(".") for each in sections for name, text in ATTRIBUTE.findall(each)}
    hints = typing.get_type_hints(cls, include_extras=True)
    return [
        Key(f.name, hints[f.name], f.default_factory() if callable(f.default_factory) else f.default, said[f.name])
        for f in dataclasses.fields(cls)
    ]


def toml_text(value: Any) -> str:
    """Write a value as TOML has it, in one line; a pose to nine digits."""
    value = as_table(value)
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {toml_text(each)}' for key, each in value.items())} }}".replace("{  }", "{}")
    if isinstance(value, list):
        return f"[{', '.join(map(toml_text, value))}]"
    return json.dumps(round(value, 9) if isinstance(value, float) else value)


# Validation


def validate(
    cls: type[T],
    table: Any,
    where: str,
    base: T | None = None,
    beside: Iterable[str] = (),
    folder: Path | None = None,
) -> T:
    """Make a dataclass from a table.

    Args:
        cls: the dataclass.
        table: table of TOML or JSON; missing keys keep their defaults.
        where: dotted name of the table, for messages.
        base: an instance whose values are the defaults instead.
        beside: further keys that the table may have, for messages.
        folder: folder of the file, to which its paths and modules are relative; without it they stay as they are.

    Raises:
        ConfigError: an unknown key with the valid ones, a missing key, or a refused value.
    """
    from pydantic import ValidationError

    if not isinstance(table, Mapping):
        raise ConfigError(f"{where or 'the file'}: {table!r} is not a table")
    whole = table
    if base is not None:
        whole = {name: as_table(getattr(base, name)) for name in _required(cls)} | dict(table)
    try:
        adapter = _adapter(cast(Any, cls))
        found: T = adapter.validate_json(json.dumps(whole, default=_no_json), context=folder)
    except ValidationError as error:
        raise ConfigError(_message(cls, error.errors(include_url=False), where, beside)) from None
    if base is None:
        return found
    return dataclasses.replace(base, **{name: getattr(found, name) for name in table})  # type: ignore[type-var]


def _no_json(value: Any) -> Any:
    """Write a value that JSON lacks, such as TOML's dates, as one that no field takes."""
    return {type(value).__name__: str(value)}


def as_table(value: Any) -> Any:
    """Convert dataclasses to tables that `validate` reads, without values of None, which TOML does not have."""
    if isinstance(value, RigidTransform):
        return pose_dict(value)
    if dataclasses.is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return {name: as_table(part) for name, part in parts.items() if part is not None}
    if isinstance(value, Mapping):
        return {key: as_table(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [as_table(part) for part in value]
    return str(value) if isinstance(value, Path) else value


@functools.cache
def _adapter(cls: Any) -> Any:
    from pydantic import TypeAdapter

    _make_strict(cls)
    return TypeAdapter(cls)


def _make_strict(cls: type[Any]) -> None:
    """Make a plain dataclass strict, and the dataclasses of its fields."""
    if not hasattr(cls, CONFIG):
        setattr(cls, CONFIG, STRICT)
        for hint in typing.get_type_hints(cls).values():
            for each in (hint, *typing.get_args(hint)):
                if isinstance(each, type) and dataclasses.is_dataclass(each):
                    _make_strict(each)


def _required(cls: type[Any]) -> list[str]:
    missing = dataclasses.MISSING
    return [f.name for f in dataclasses.fields(cls) if f.default is missing and f.default_factory is missing]


# Messages

UNKNOWN = "unexpected_keyword_argument"


def _message(cls: type[Any], errors: list[Any], where: str, beside: Iterable[str]) -> str:
    """Say in one line what is wrong; an unknown key comes first, because a misspelt one makes others missing."""
    error = min(errors, key=lambda each: each["type"] != UNKNOWN)
    loc, value = error["loc"], error["input"]
    table, known = _known(cls, loc)
    if error["type"] == UNKNOWN and known == len(loc) - 1:
        names = choices([*(field.name for field in dataclasses.fields(table)), *(() if known else beside)])
        return f"unknown key '{_join(where, loc)}'; valid here: {names}"
    at = _join(where, loc[:known])
    if error["type"] == "value_error":
        reason, is_table = str(error["ctx"]["error"]), dataclasses.is_dataclass(table) or table is RigidTransform
        return _join(at, (reason,)) if is_table else f"{at}: {reason}"
    return f"{at or 'the file'}: {error['msg'].replace('Input', repr(value), 1)}"


def _join(where: str, loc: Iterable[str | int]) -> str:
    """Write the dotted name of a place in a table, with indices of lists in brackets."""
    for part in loc:
        where += f"[{part}]" if isinstance(part, int) else f".{part}" if where else part
    return where


def _known(hint: Any, loc: Sequence[str | int]) -> tuple[Any, int]:
    """Find the type of a place in a table, and how many parts of the place are known.

    Below a union, pydantic's place continues with the type that it tried.
    """
    for n, part in enumerate(loc):
        table = _PoseTable if bare(hint) is RigidTransform else bare(hint)
        hints = typing.get_type_hints(table, include_extras=True) if dataclasses.is_dataclass(table) else {}
        inner = typing.get_args(table)
        if part in hints:
            hint = hints[part]
        elif inner and isinstance(part, int) == (typing.get_origin(table) in (tuple, list)):
            hint = inner[0] if isinstance(part, int) else inner[-1]  # of a Mapping
        else:
            return table, n
    return bare(hint), len(loc)


def bare(hint: Any) -> Any:
    """Strip an annotation of its metadata, and of None."""
    if typing.get_origin(hint) is Annotated:
        hint = typing.get_args(hint)[0]
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        hint = bare(typing.get_args(hint)[0])
    return hint


def _metadata(hint: Any) -> tuple[Any, ...]:
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        hint = typing.get_args(hint)[0]
    return typing.get_args(hint)[1:] if typing.get_origin(hint) is Annotated else ()


def form_of(hint: Any) -> str:
    """Return the text in an annotation's metadata, such as "[lowest, highest]"; empty if there is none."""
    return next((each for each in _metadata(hint) if isinstance(each, str)), "")
