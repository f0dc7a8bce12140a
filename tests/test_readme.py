"""What the README shows is so: its configurations are read, its commands exist with the options that it names."""

import io
import re
import tomllib
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest

from cotarget import cli
from cotarget.calibration import load_calibration
from cotarget.config import DEFAULT_TARGETS, load_config, parse_config
from cotarget.detect_video import COLUMNS as FILM_COLUMNS
from cotarget.evaluation import true_calibration
from cotarget.recording.recorder import COLUMNS as STEP_COLUMNS
from cotarget.rig import Frame
from cotarget.sim.world import SimWorld
from experiments.engine.cases import choose, known_experiments
from experiments.engine.command import main

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
    with redirect_stdout(io.StringIO()) as out, pytest.raises(SystemExit) as ended:
        cli.main([*arguments, "--help"])
    assert ended.value.code == 0
    return out.getvalue()


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
            assert name.removeprefix(".") in {*known, "gallery"}
            continue
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", rest):
            assert option in said.getvalue(), f"python -m experiments {option}"
        names = [word for word in re.findall(r"^ ([a-z_ ]+)(?= |$)", rest) for word in word.split()]
        assert choose(known, names, changes=re.findall(r"--set (\S+)", rest))


def test_every_command_is_told_of(helps):
    assert known(asked()) <= set(helps)


def row_of(beginning):
    """The line of a table that begins so."""
    (line,) = (line for line in README.splitlines() if line.startswith(beginning))
    return line


@pytest.mark.parametrize(
    ("beginning", "columns"),
    [("| `follow --csv`, `replay --csv`", STEP_COLUMNS), ("| `detect --csv`", FILM_COLUMNS)],
)
def test_every_column_is_told_of_in_its_order(beginning, columns):
    told = re.findall(r"`(\w+)`", row_of(beginning))
    assert tuple(told) == columns


def test_what_is_known_of_each_target_is_told():
    for name, target in DEFAULT_TARGETS.items():
        size, dimension, wanted_px, detector, _ = (cell.strip() for cell in row_of(f"| {name} |").split("|")[2:-1])
        assert (float(size.removesuffix(" m")), float(wanted_px)) == (target.size, target.wanted_px)
        assert (dimension, detector.split(",")[0]) == (target.dimension, target.detector)


def block_after(mark, language):
    """The block of code after a comment."""
    (found,) = re.findall(rf"<!-- {mark} -->\n```{language}\n(.*?)```", README, re.DOTALL)
    return found


def python_with(word):
    """The one block of Python in which a word stands."""
    (found,) = (block for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if word in block)
    return found


def test_target_and_scene_of_ones_own_are_there_as_shown(tmp_path):
    from tests.sim.test_own_models import BOX

    (tmp_path / "rig.toml").write_text(block_after("own", "toml"))
    (tmp_path / "yard.xml").write_text(block_after("yard", "xml"))
    (tmp_path / "dog.obj").write_text(BOX)
    world = SimWorld(load_config(tmp_path / "rig.toml"), rendered=())
    truth = world.truth()
    assert not 0 <= truth.center_px("dog", "fixed", 4.0)[0] < 640  # while the background is learnt
    assert truth.silhouette("dog", "fixed", 9.0).visible == 1.0
    world.close()


@pytest.mark.render
def test_the_library_in_ten_lines_runs(capsys):
    block = python_with("true_calibration")
    assert len(block.strip().splitlines()) <= 11  # with the empty one
    exec(block.replace("seconds=8.0", "seconds=0.2"), {})
    *_, last = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"0\.\d\d s: following, \[[\d. ]+\] px", last)


@pytest.mark.render
def test_the_library_on_any_rig_runs(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text('[sim]\nscene = "indoor"\ntargets = ["book"]\n')
    world = SimWorld(load_config(tmp_path / "rig.toml"), rendered=())
    # To calibrate takes half a minute, and has tests of its own.
    monkeypatch.setattr("cotarget.calibration.calibrate.calibrate", lambda rig, board: true_calibration(world))
    exec(python_with("SafeRig").replace("seconds=8.0", "seconds=0.1"), {})
    assert "searching" in capsys.readouterr().out
    assert load_calibration(tmp_path / "calibration.json").T_head_zoom is not None


def test_the_detector_of_ones_own_finds_what_it_says():
    names = {}
    exec(python_with("ExternalDetector"), names)
    picture = np.full((60, 80, 3), 128, np.uint8)
    picture[20:30, 50:65] = (0, 0, 255)
    (found,) = names["detector"].detect(Frame(picture, 0.0))
    assert (found.center_px.tolist(), found.size_px.tolist()) == ([57.0, 24.5], [15.0, 10.0])
