"""Lists of frozen names in tests/formats/, what the program is compared with them by, and files of v0.1.0."""

import argparse
import csv
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

import cotarget
from cotarget.cli.main import main

FORMATS = Path(__file__).parent
OLD = FORMATS / "v0.1.0"

SAME = 1e-6  # what is computed from the same numbers on another processor [relative; degrees]
# Corners in the same pictures, found by another version of OpenCV, and what a fit to them differs by.
CORNERS_PX, CAPTURES_M, CAPTURES_DEG, CAPTURES_FOCAL = 0.02, 1e-3, 0.02, 1e-3
# Of a replay of 0.1.0, whose filter had more numbers: half a step of the head [degrees]; lens [px]; columns [relative].
COMMANDS_DEG, COMMANDS_PX, COMMANDS = 0.044, 0.1, 2e-3
VIEWS = 2  # images in which another version of OpenCV finds the board, or does not
DETECTED_PX = 1.0  # what another version of OpenCV or of the film's decoder changes of a track
PRINTED = 0.002  # pixels of a board at its edges, as another version of matplotlib draws them
FIGURES = 1e-9  # of figures made from the same rows, whatever adds them up
DEADLINE_S = 60.0  # for what comes at once

UNKNOWN = "no_such_key"


def listed(name):
    """The lines of a list, without comments."""
    lines = (FORMATS / name).read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line.strip() and not line.startswith("#")]


def assert_listed(name, lines, *, begins=""):
    """The program has what the list has, in any order.

    Args:
        name: of the list.
        lines: what the program has.
        begins: how the lines begin that are compared.
    """
    wanted, found = {line for line in listed(name) if line.startswith(begins)}, set(lines)
    gone, new = sorted(wanted - found), sorted(found - wanted)
    assert not gone, (
        f"tests/formats/{name} has lines that the program does not fulfil any more:\n  "
        + "\n  ".join(gone)
        + "\ninstead of which it has:\n  "
        + "\n  ".join(new)
        + "\nUsers' files and scripts hold these names: keep the spelling, by an alias where the code's name changes."
    )
    assert not new, (
        f"tests/formats/{name} lacks what the program has:\n  "
        + "\n  ".join(new)
        + f"\nIf it is added on purpose, write these lines into tests/formats/{name} by hand: they are frozen then."
    )


def leaves(value, where=""):
    """The dotted keys of nested JSON objects with their values; the items of a list share `[]`."""
    if isinstance(value, dict) and value:
        for key, item in value.items():
            yield from leaves(item, f"{where}.{key}" if where else key)
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        for item in value:
            yield from leaves(item, f"{where}[]")
    else:
        yield where, value


def keys_in(value):
    return {key for key, _ in leaves(value)}


def read(path):
    return json.loads(path.read_text(encoding="utf-8"))


def read_lines(path):
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def listed_keys(name, begins=""):
    """The keys of a list, each with what stands behind it: "?" where it may be null, a number that it equals."""
    lines = [line.removeprefix(begins) for line in listed(name) if line.startswith(begins)]
    return {key: mark for key, _, mark in (line.partition(" ") for line in lines)}


def assert_keys(name, table, *, begins="", may_lack=()):
    """A JSON object has the keys of a list and no others.

    Args:
        name: of the list.
        table: the object.
        begins: how the list's lines begin that are of it.
        may_lack: keys, or beginnings of keys, that this object may lack.
    """
    keys, found = listed_keys(name, begins), dict(leaves(table))
    for key, value in found.items():
        assert value is not None or keys.get(key) == "?", f"{key} is null, which tests/formats/{name} does not have"
        if (mark := keys.get(key, "")).startswith("= "):
            assert value == json.loads(mark[2:]), f"{key} is {value}, not as in tests/formats/{name}"
    empty = {key for key, value in found.items() if value in ([], {})}
    new = {
        key
        for key in found.keys() - keys.keys()
        if key not in empty or not any(k.startswith((f"{key}[]", f"{key}.")) for k in keys)
    }
    gone = {
        key
        for key in keys
        if not key.startswith(tuple(may_lack))
        and not any(key == f or f.startswith(f"{key}.") or key.startswith((f"{f}.", f"{f}[]")) for f in found)
    }
    assert not gone, (
        f"{sorted(gone)} of tests/formats/{name} are not written any more: what reads such files wants them"
    )
    assert not new, f"{sorted(new)} are written: if that is on purpose, add them to tests/formats/{name} by hand"


def assert_close(now, then, tolerance):
    """JSON objects are the same, but for numbers with a fraction, which differ by less than a part of themselves."""
    now, then = dict(leaves(now)), dict(leaves(then))
    assert now.keys() == then.keys()
    for key, value in then.items():
        assert now[key] == (pytest.approx(value, rel=tolerance) if isinstance(value, float) else value), key


def columns(name):
    """The listed columns of a table, in their order."""
    return [line.removeprefix(f"{name}: ") for line in listed("tables.txt") if line.startswith(f"{name}: ")]


def header(path):
    with path.open(newline="", encoding="utf-8") as file:
        return next(csv.reader(file))


def table_rows(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def run(capsys, *arguments):
    """Run a command that succeeds; what it prints as JSON."""
    capsys.readouterr()
    assert main([str(each) for each in arguments]) == 0
    return json.loads(capsys.readouterr().out)


def copy_old(tmp_path, monkeypatch):
    """Copy the files of v0.1.0 and work in their folder."""
    folder = tmp_path / "old"
    shutil.copytree(OLD, folder, ignore=shutil.ignore_patterns("captures", "experiments"))
    (folder / "captures").symlink_to(OLD / "captures")
    monkeypatch.chdir(folder)
    return folder


def last_list(message):
    """The choices at the end of a message."""
    return message.rpartition(": ")[2].split(", ")


def program(command, folder):
    """Start a program in a folder, with this project's modules."""
    environment = {**os.environ, "PYTHONPATH": str(Path(cotarget.__file__).parents[1])}
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    return subprocess.Popen(command, text=True, start_new_session=True, cwd=folder, env=environment, **pipes)


POSE = ("sim.T_zoom0_fixed", "sim.T_head_zoom")


def rig_toml_lines():
    """(key, default, choices) of each line of the list."""
    for line in listed("rig_toml.txt"):
        key, _, rest = line.partition(" = ")
        default, _, names = rest.partition(" | ")
        yield key, default, names.split(", ") if names else []


RIG_TOML = list(rig_toml_lines())
KEYS = [key for key, _, _ in RIG_TOML]
TABLES = sorted({key.rpartition(".")[0] for key in KEYS if not key.startswith(POSE)})


PROBES = ("-1", "0", "1", "1.5", "9x6", "70000", "nan", "text")  # what an option's value is tried with


class ParsedError(Exception):
    """A command's parser was found."""


def parser_of(run, monkeypatch):
    """The parser that a command reads its arguments with."""
    found = []

    def catch(parser, *_, **__):
        found.append(parser)
        raise ParsedError

    with monkeypatch.context() as patched:
        patched.setattr(argparse.ArgumentParser, "parse_args", catch)
        with pytest.raises(ParsedError):
            run(["--help"])
    return found[0]


def taken(action):
    """The probes that an option takes."""
    for probe in PROBES:
        try:
            action.type(probe)
        except (argparse.ArgumentTypeError, ValueError):
            continue
        yield probe


def option_line(action):
    """One option in words: names, number of values, values, default."""
    parts = [", ".join(action.option_strings) or "argument"]
    if action.nargs not in (None, 0):
        parts.append(f"[{action.nargs}]")
    if isinstance(action, argparse._AppendAction):
        parts.append("(any number of times)")
    if action.choices is not None:
        parts.append(f"{{{', '.join(map(str, action.choices))}}}")
    elif action.type is Path:
        parts.append("path")
    elif action.type is not None:
        parts.append(f"takes {' '.join(taken(action))}")
    if action.required and action.option_strings:
        parts.append("required")
    elif action.default not in (None, False, "", [], argparse.SUPPRESS) and action.dest != "processes":
        default = action.default
        if isinstance(default, tuple):
            default = ("x" if action.nargs is None else " ").join(map(str, default))
        parts.append(f"= {Path(default).name if Path(str(default)).is_absolute() else default}")
    return " ".join(parts)


def command_lines(name, parser):
    """A command's options, and which of them exclude each other."""
    yield name
    for action in parser._actions:
        if not isinstance(action, argparse._HelpAction | argparse._SubParsersAction):
            yield f"{name} {option_line(action)}"
    for group in parser._mutually_exclusive_groups:
        how = "exactly" if group.required else "at most"
        yield f"{name}: {how} one of {', '.join(action.option_strings[0] for action in group._group_actions)}"


def subcommands(parser):
    (found,) = [each for each in parser._actions if isinstance(each, argparse._SubParsersAction)]
    return found.choices


def statuses():
    """The listed exit statuses: number by what has happened."""
    return {what: int(number) for number, _, what in (line.partition(" ") for line in listed("exit_statuses.txt"))}
