"""Experiments keep their names and files; rows of v0.1.0 give the figures of v0.1.0."""

import functools
import re

import pytest

from experiments.command import INTERRUPTED, TERMINATED
from experiments.command import main as experiments_main
from experiments.engine import known_experiments, pictured
from experiments.paper.gallery import main as gallery_main
from experiments.report import EXPECTED, compare
from experiments.tables import plain
from tests.formats.lists import (
    FIGURES,
    OLD,
    UNKNOWN,
    assert_close,
    assert_keys,
    assert_listed,
    command_lines,
    header,
    leaves,
    listed,
    parser_of,
    read,
    statuses,
)
from tests.support.tiny_experiments import KNOWN as TINY_KNOWN
from tests.support.tiny_experiments import here, here_together

KNOWN = known_experiments()
LATER = {"centred_yield", "follow"}  # figures that v0.1.0 did not have
QUICKEST = ("hand_eye", "depth_error", "shortcut", "worked_example")  # a fraction of a second each


@functools.cache
def experiment_of(name):
    return KNOWN[name]()


def test_there_are_the_listed_experiments():
    """And others, whose names are listed when they are released."""
    assert {line.partition(" ")[2] for line in listed("experiments.txt") if line.startswith("name ")} <= set(KNOWN)


def test_the_experiments_commands_have_the_listed_options(monkeypatch):
    programs = {"": experiments_main, ".gallery": gallery_main}
    lines = []
    for name, program in programs.items():
        lines += command_lines(f"experiments{name}", parser_of(program, monkeypatch))
    assert_listed("commands.txt", lines, begins="experiments")


def old_jobs(name):
    return [read(path) for path in sorted((OLD / "experiments" / name / "jobs").glob("0*.json"))]


OLD_RESULTS = sorted(path.parent.name for path in OLD.glob("experiments/*/result.json"))


@pytest.mark.parametrize("name", OLD_RESULTS)
def test_v010_rows_give_the_same_figures(name):
    experiment, result = experiment_of(name), read(OLD / "experiments" / name / "result.json")
    rows = [row for job in old_jobs(name) for row in job["rows"]]
    summary = experiment.summarise(rows)
    found, then = dict(leaves(plain(summary))), dict(leaves(result["summary"]))
    assert_close({key: found[key] for key in then}, then, FIGURES)  # there may be figures of later versions too
    assert experiment.missed is None or list(experiment.missed(summary)) is not None
    bounds = compare(name, experiment.bounded(summary))
    gone = [bound.name for bound in bounds if bound.reached is None and not LATER & set(re.split(" / |, ", bound.name))]
    assert not gone, "a figure that has a bound is not there any more"
    assert (EXPECTED / f"{name}.json").exists() == bool(bounds)


@pytest.mark.parametrize("name", QUICKEST)
def test_rows_give_figures(name):
    experiment = experiment_of(name)
    assert experiment.summarise(pictured(experiment.one(experiment.quick, 0)).rows)


def test_results_are_written_with_the_listed_keys(tmp_path):
    """By experiments that take no time."""
    out = tmp_path / "out"
    command = ["tiny", "--quick", "--out", str(out)]
    assert experiments_main(command, TINY_KNOWN, tmp_path, here_together, here) == 0
    files = {re.sub("[0-9]", "N", str(path.relative_to(out))) for path in out.rglob("*") if path.is_file()}
    files = {name.replace("tiny/", "NAME/").replace("drawn", "PICTURE") for name in files}
    assert_listed("experiments.txt", {f"file {name}" for name in files}, begins="file ")
    result = read(out / "tiny" / "result.json")
    assert_keys("experiments.txt", {**result, "summary": 0, "settings": 0}, begins="result.json ")
    seeds = {f"seeds.csv {key}" for key in header(out / "tiny" / "seeds.csv")}
    assert_listed("experiments.txt", seeds, begins="seeds.csv ")
    assert header(out / "tiny" / "rows.csv") == ["seed", "value", "sum", "odd", "none"]


def test_experiments_end_with_the_listed_status(capsys):
    failed = statuses()["experiments: a name is unknown, a job fails, a figure is missed, or a bound is broken"]
    assert experiments_main(["--list"]) == statuses()["experiments: all is as it should be"]
    assert experiments_main([UNKNOWN]) == failed
    with pytest.raises(SystemExit) as ended:
        experiments_main(["--no-such-option"])
    assert ended.value.code == statuses()["experiments: an argument is wrong"]
    assert statuses()["experiments: Ctrl-C"] == INTERRUPTED
    assert statuses()["experiments: SIGTERM"] == TERMINATED
