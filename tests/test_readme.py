"""What the README shows is so: its configurations are read, its commands exist with the options that it names."""

import io
import re
import subprocess
import sys
import tomllib
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from cotarget.config import parse_config
from experiments.__main__ import main
from experiments.cases import choose, known_experiments

DEADLINE_S = 60.0  # for a command to say how it is used
README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
# `cotarget NAME ... --option ...` up to where a line of code or of a shell ends.
COMMANDS = re.findall(r"cotarget ([a-z-]+)((?: [^`\n]*)?)", README)
# `python -m experiments[.name] ...`, of which one line of code follows the other.
EXPERIMENTS = re.findall(r"python -m experiments((?:\.[a-z_]+)?)((?: (?:(?!python -m)[^`#])*)?)", README)


def test_there_are_examples():
    assert README.count("```toml") >= 1
    assert len(COMMANDS) > 30


@pytest.mark.parametrize("block", re.findall(r"(?:```toml|<<'TOML')\n(.*?)(?:```|TOML)\n", README, re.DOTALL))
def test_configurations_are_read(block):
    assert parse_config(tomllib.loads(block)) is not None


def asked(*arguments):
    """What a command's --help says."""
    command = [sys.executable, "-m", "cotarget.cli", *arguments, "--help"]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=DEADLINE_S).stdout


@pytest.fixture(scope="module")
def helps():
    existing = known(asked())
    return {name: asked(name) for name in sorted({name for name, _ in COMMANDS} & existing)}


def known(text):
    return set(re.findall(r"^    ([a-z-]+)", text, re.MULTILINE))


def test_commands_and_their_options_exist(helps):
    for name, rest in COMMANDS:
        if name not in helps:
            assert not rest.strip().startswith("--"), name  # prose, such as "cotarget makes the two cooperate"
            continue
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", rest):
            assert option in helps[name], f"cotarget {name} {option}"


def test_experiments_and_their_options_exist():
    assert len(EXPERIMENTS) > 8
    known = known_experiments()
    with pytest.raises(SystemExit), redirect_stdout(io.StringIO()) as said:
        main(["--help"])
    for name, rest in EXPERIMENTS:
        if name:
            assert name.removeprefix(".") in known
            continue
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", rest):
            assert option in said.getvalue(), f"python -m experiments {option}"
        names = [word for word in re.findall(r"^ ([a-z_ ]+)(?= |$)", rest) for word in word.split()]
        assert choose(known, names, changes=re.findall(r"--set (\S+)", rest))


def test_every_command_is_told_of(helps):
    assert known(asked()) <= set(helps)
