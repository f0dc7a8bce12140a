"""Validate tables of TOML and JSON against frozen dataclasses, by pydantic; each error is one line that names the key.

`model` makes a frozen dataclass whose fields are strict: a bool or "12" is no number, an int may be a float, and an
unknown key is refused. Ranges are metadata of a field's type: those of annotated_types, and `OneOf`, `Check` and a text
such as "[lowest, highest]", which messages show. A check across keys is a `__post_init__` that raises a ValueError
beginning with the key and a colon.

pydantic is imported at the first `validate`, because commands such as `cotarget stop` must be quick.
"""

import dataclasses
import functools
import json
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, dataclass_transform

from annotated_types import Ge, Gt

from cotarget.errors import ConfigError, choices
from cotarget.geometry import RigidTransform, pose, pose_dict

T = TypeVar("T")
STRICT = {"strict": True, "extra": "forbid", "allow_inf_nan": False, "arbitrary_types_allowed": True}
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

NO_TABLE = ("dataclass_type", "dict_type", "mapping_type")
UNKNOWN, MISSING = "unexpected_keyword_argument", "missing"
RANGES = ("greater_than", "greater_than_equal", "less_than", "less_than_equal")


def _message(cls: type[Any], errors: list[Any], where: str, beside: Iterable[str]) -> str:
    """Say in one line what is wrong; an unknown key comes first, because a misspelt one makes others missing."""
    error = min(errors, key=lambda each: each["type"] != UNKNOWN)
    kind, loc, value = error["type"], error["loc"], error["input"]
    if kind == "json_invalid":  # half of a surrogate pair in a text, or tables nested too deeply
        return f"{where or 'the file'}: {error['msg']}"
    for end in range(len(loc)):  # below a union, pydantic's location continues with the type that it tried
        if _is_union(_hint_at(cls, loc[:end])):
            tried = (each for each in errors if each["loc"][:end] == loc[:end])
            return f"{_join(where, loc[:end])}: {'; '.join(dict.fromkeys(map(_words, tried)))}"
    outer, hint = _table_at(cls, loc[:-1]), None if kind == UNKNOWN else _hint_at(cls, loc)
    at, above = _join(where, loc), _join(where, loc[:-1])
    if kind == UNKNOWN:
        names = [field.name for field in dataclasses.fields(outer)]
        return f"unknown key '{at}'; valid here: {choices([*names, *(beside if len(loc) == 1 else ())])}"
    if kind == MISSING and not isinstance(loc[-1], int):
        first = min(each["loc"][-1] for each in errors if each["type"] == MISSING and each["loc"][:-1] == loc[:-1])
        return f"{above and f'{above}: '}missing key '{first}'; needed here: {choices(_required(outer))}"
    if kind in (MISSING, "too_long", "too_short"):  # of a list
        here, listed = (above, loc[:-1]) if kind == MISSING else (at, loc)
        of_list = _hint_at(cls, listed)
        return f"{here}: has {len(value)} values where {len(typing.get_args(bare(of_list)))} are wanted{_form(of_list)}"
    if kind in NO_TABLE:
        return f"{at}: {value!r} is not a table"
    if kind == "literal_error":
        return f"{at}: {value!r} is not one of: {choices(map(str, typing.get_args(bare(hint))))}"
    if kind == "value_error":
        reason = str(error["ctx"]["error"])
        is_table = dataclasses.is_dataclass(bare(hint)) or bare(hint) is RigidTransform
        return _join(at, (reason,)) if is_table else f"{at}: {reason}"
    while kind in RANGES and at.endswith("]"):  # the range is the list's
        at = at[: at.rindex("[")]
    return f"{at}: {_words(error)}{_form(hint) if kind == 'tuple_type' else ''}"


def _words(error: Any) -> str:
    """Say what is wrong with a value in pydantic's words; a list is its array."""
    return str(error["msg"]).replace("Input", repr(error["input"]), 1).replace("valid array", "list")


def _is_union(hint: Any) -> bool:
    """Whether an annotation is a union of several types, beside None."""
    if typing.get_origin(hint) is Annotated:
        hint = typing.get_args(hint)[0]
    kinds = [each for each in typing.get_args(hint) if each is not types.NoneType]
    return typing.get_origin(hint) in (types.UnionType, typing.Union) and len(kinds) > 1


def _join(where: str, loc: Iterable[str | int]) -> str:
    """Write the dotted name of a place in a table, with indices of lists in brackets."""
    for part in loc:
        where += f"[{part}]" if isinstance(part, int) else f".{part}" if where else part
    return where


def _hint_at(hint: Any, loc: Iterable[str | int]) -> Any:
    """Find the annotation of a place in a table."""
    for part in loc:
        outer = _table_at(hint, ())
        if dataclasses.is_dataclass(outer):
            hint = typing.get_type_hints(outer, include_extras=True)[str(part)]
        elif isinstance(part, int):
            args = typing.get_args(outer)
            hint = args[0] if args[-1] is ... or len(args) == 1 else args[part]
        else:
            hint = typing.get_args(outer)[1]  # of a Mapping
    return hint


def _table_at(hint: Any, loc: Iterable[str | int]) -> Any:
    """Find the type of a place in a table; that of a pose's table for a pose."""
    found = bare(_hint_at(hint, loc))
    return _PoseTable if found is RigidTransform else found


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


def _form(hint: Any) -> str:
    """Write how a list must look, for the end of a message."""
    form, args = form_of(hint), typing.get_args(bare(hint))
    if not form and args and args[-1] is ... and (one := form_of(args[0])):
        form = f"[{one}, ...]"
    return form and f", {form}"
