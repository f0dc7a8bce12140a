"""Print a rig.toml with every key, its default and what it is: `cotarget config > rig.toml`."""

import argparse
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

WIDTH = 118  # of a comment [characters]
HEAD = "# Every key of rig.toml with its default. Take the # from a line to set its key; `cotarget doctor` checks it."


def add(parser: argparse.ArgumentParser) -> None:
    """Add no options."""


def run(options: argparse.Namespace) -> None:
    """Print the tables, whose keys are comments."""
    from cotarget.config import RigConfig

    print("\n".join((HEAD, *_table("", RigConfig()))))


def _table(where: str, values: Any) -> Iterator[str]:
    """Write a table of which ``values`` are the defaults, then the tables in it."""
    from cotarget.config import HardwareConfig
    from cotarget.drivers import DRIVERS
    from cotarget.drivers.rig import board_settings, devices
    from cotarget.schema import form_of, keys_of, toml_text

    if isinstance(values, HardwareConfig):
        settings = {role: device.settings for role, device in devices(values).items()}
        values = settings | {"board": board_settings(values)}
    if isinstance(values, Mapping):
        for name, value in values.items():
            yield from _table(f"{where}.{name}", value)
        return
    if where:
        yield f"\n[{where}]"
    if drivers := DRIVERS.get(where.removeprefix("hardware.")):
        yield f'# The driver; another one has other keys.\n#driver = "{next(iter(drivers))}"'
    inner = {}
    for key in keys_of(type(values)):
        value = getattr(values, key.name)
        if key.table is not None and value is not None:
            inner[f"{where}.{key.name}".lstrip(".")] = value
            continue
        meaning = key.meaning.replace("``", "")
        yield textwrap.indent(textwrap.fill(f"{meaning[:1].upper()}{meaning[1:]}.", WIDTH), "# ")
        yield f"#{key.name} = {form_of(key.hint) or '...' if value is None else toml_text(value)}"
    for name, value in inner.items():
        yield from _table(name, value)
