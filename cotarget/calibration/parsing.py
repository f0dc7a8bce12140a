"""Reading JSON that people may have edited: every error names the key and what was expected there.

Messages do not name the file; the caller, who knows it, puts it in front.
"""

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cotarget.errors import CalibrationError, choices
from cotarget.geometry import RigidTransform, pose

Table = Mapping[str, Any]


def read_json(path: Path, wanted: str) -> Table:
    """Read a JSON object from a file.

    Args:
        path: of the file.
        wanted: what to give instead, where it holds something else.

    Raises:
        CalibrationError: the file is missing, or is not JSON; the message says what it is, if that can be told.
    """

    def refuse(constant: str) -> None:
        raise CalibrationError(f"{path}: holds the number {constant}, which is not finite")

    try:
        text = path.read_text(encoding="utf-8")
        table = json.loads(text, parse_constant=refuse)
    except FileNotFoundError:
        raise CalibrationError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise CalibrationError(f"{path}: cannot be read: {reason}") from None
    except (json.JSONDecodeError, RecursionError) as error:
        what = "is empty" if not text.strip() else "is TOML" if _is_toml(text) else f"is not JSON: {error}"
        raise CalibrationError(f"{path}: {what}; {wanted}") from None
    if not isinstance(table, dict):
        raise CalibrationError(f"{path}: holds no JSON object; {wanted}")
    return table


def _is_toml(text: str) -> bool:
    try:
        return bool(tomllib.loads(text))
    except (tomllib.TOMLDecodeError, RecursionError):
        return False


def check_schema(path: Path, table: Table, schema: int) -> None:
    """Refuse a file of another version.

    Raises:
        CalibrationError: it has another schema number, or none.
    """
    if "schema" not in table:
        raise CalibrationError(f"{path}: missing key 'schema'; this version reads schema {schema}")
    if table["schema"] != schema or isinstance(table["schema"], bool):
        raise CalibrationError(f"{path}: schema {table['schema']!r} is not {schema}, the one that this version reads")


def get(table: Table, key: str, where: str = "") -> Any:
    """Look a key up, or say that it is missing."""
    if key not in table:
        raise CalibrationError(f"missing key '{join(where, key)}'; found here: {choices(table)}")
    return table[key]


def join(where: str, key: str) -> str:
    """Name a key inside a table."""
    return f"{where}.{key}" if where else key


def as_table(value: Any, where: str) -> Table:
    """Expect a JSON object."""
    if not isinstance(value, dict):
        raise CalibrationError(f"{where}: {short(value)} is not an object")
    return value


def as_list(value: Any, where: str, length: int | None = None) -> Sequence[Any]:
    """Expect a JSON list, of a certain length where one is given."""
    if not isinstance(value, list):
        raise CalibrationError(f"{where}: {short(value)} is not a list")
    if length is not None and len(value) != length:
        raise CalibrationError(f"{where}: has {len(value)} values where {length} are wanted")
    return value


def as_number(value: Any, where: str, *, positive: bool = False) -> float:
    """Expect a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CalibrationError(f"{where}: {short(value)} is not a finite number")
    if positive and value <= 0:
        raise CalibrationError(f"{where}: {value:g} is not greater than zero")
    return float(value)


def as_whole(value: Any, where: str, *, lowest: int = 0) -> int:
    """Expect a whole number."""
    if isinstance(value, bool) or not isinstance(value, int) or value < lowest:
        raise CalibrationError(f"{where}: {short(value)} is not a whole number from {lowest} up")
    return value


def as_text(value: Any, where: str) -> str:
    """Expect a text."""
    if not isinstance(value, str):
        raise CalibrationError(f"{where}: {short(value)} is not a text")
    return value


def as_numbers(value: Any, where: str, length: int) -> tuple[float, ...]:
    """Expect a list of finite numbers."""
    return tuple(as_number(item, f"{where}[{i}]") for i, item in enumerate(as_list(value, where, length)))


def as_size(value: Any, where: str) -> tuple[int, int]:
    """Expect (width, height) or (columns, rows)."""
    first, second = as_list(value, where, 2)
    return as_whole(first, f"{where}[0]", lowest=1), as_whole(second, f"{where}[1]", lowest=1)


def as_pose(value: Any, where: str) -> RigidTransform:
    """Expect a translation [m] and a rotation vector [degrees]."""
    table = as_table(value, where)
    translation = as_numbers(get(table, "translation", where), join(where, "translation"), 3)
    rotvec_deg = as_numbers(get(table, "rotvec_deg", where), join(where, "rotvec_deg"), 3)
    try:
        return pose(translation, rotvec_deg)
    except ValueError as error:
        raise CalibrationError(join(where, str(error))) from None


def short(value: Any) -> str:
    """Quote a value in an error message without filling the screen."""
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
