"""Experiments keep their names, settings, columns and files; rows of v0.1.0 give the figures of v0.1.0."""

import dataclasses
import functools
import re
import shutil

import pytest

import cotarget
from experiments.calibration.photos import main as photos_main
from experiments.engine.bounds import EXPECTED, compare
from experiments.engine.cases import known_experiments
from experiments.engine.command import main as experiments_main
from experiments.engine.harness import INTERRUPTED, TERMINATED
from experiments.engine.texts import plain
from experiments.engine.workers import here
from experiments.paper.gallery import main as gallery_main
from experiments.wire.wire import main as wire_main
from tests.formats.lists import (
    FIGURES,
    OLD,
    UNKNOWN,
    assert_close,
    assert_keys,
    assert_listed,
    command_lines,
    header,
    parser_of,
    read,
    statuses,
)
from tests.support.tiny_experiments import KNOWN as TINY_KNOWN

KNOWN = known_experiments()
QUICKEST = ("hand_eye", "depth_error", "shortcut", "worked_example")  # a fraction of a second each


@functools.cache
def experiment_of(name):
    return KNOWN[name]()


def setting_lines(name):
    return {f"setting {name}.{field.name}" for field in dataclasses.fields(experiment_of(name).settings)}


def test_there_are_the_listed_experiments():
    assert_listed("experiments.txt", {f"name {name}" for name in KNOWN}, begins="name ")


@pytest.mark.parametrize("name", KNOWN)
def test_an_experiment_has_the_listed_settings(name):
    assert_listed("experiments.txt", setting_lines(name), begins=f"setting {name}.")


def test_the_experiments_commands_have_the_listed_options(monkeypatch):
    programs = {"": experiments_main, ".NAME": experiment_of("hand_eye").main}
    programs |= {".photos": photos_main, ".wire": wire_main, ".gallery": gallery_main}
    lines = []
    for name, program in programs.items():
        lines += command_lines(f"experiments{name}", parser_of(program, monkeypatch))
    assert_listed("commands.txt", lines, begins="experiments")


def old_jobs(name):
    return [read(path) for path in sorted((OLD / "experiments" / name / "jobs").glob("0*.json"))]


OLD_RESULTS = sorted(path.parent.name for path in OLD.glob("experiments/*/result.json"))


@pytest.mark.parametrize("name", OLD_RESULTS)
def test_v010_rows_give_the_same_figures(name, tmp_path):
    experiment, result = experiment_of(name), read(OLD / "experiments" / name / "result.json")
    rows = [row for job in old_jobs(name) for row in job["rows"]]
    assert_listed("experiments.txt", {f"column {name}.{key}" for row in rows for key in row}, begins=f"column {name}.")
    summary = experiment.summarise(rows)
    assert_close(plain(summary), result["summary"], FIGURES)
    assert experiment.describe(experiment.quick, summary)
    assert experiment.missed is None or list(experiment.missed(summary)) is not None
    bounds = compare(experiment, summary)
    assert all(bound.reached is not None for bound in bounds), "a figure that has a bound is not there any more"
    assert (EXPECTED / f"{name}.json").exists() == bool(bounds)


@pytest.mark.parametrize("name", QUICKEST)
def test_rows_are_written_with_the_listed_columns(name):
    experiment = experiment_of(name)
    rows = experiment.run(dataclasses.replace(experiment.quick, seeds=1), here)
    assert_listed("experiments.txt", {f"column {name}.{key}" for row in rows for key in row}, begins=f"column {name}.")


def test_results_are_written_with_the_listed_keys(tmp_path, capfd):
    """By experiments that take no time."""
    out, notes = tmp_path / "out", f'sharing.notes="{tmp_path}"'
    command = ["tiny", "sharing", "--quick", "--processes", "1", "--out", str(out), "--set", notes]
    assert experiments_main(command, known=TINY_KNOWN) == 0
    files = {re.sub("[0-9]", "N", str(path.relative_to(out))) for path in out.rglob("*") if path.is_file()}
    files = {re.sub("^(tiny|sharing[^/]*)/", "NAME/", name) for name in files}
    assert_listed("experiments.txt", {f"file {name}" for name in files}, begins="file ")
    assert_results(out)
    assert header(out / "tiny" / "rows.csv") == ["seed", "value", "sum", "shared", "odd"]


def assert_results(out):
    session, *_ = read(out / "sessions.json")
    session["cases"] = {"NAME": next(iter(session["cases"].values()))}
    assert_keys("experiments.txt", session, begins="sessions.json ")
    for folder in (path.parent for path in out.glob("*/result.json")):
        for path in folder.glob("jobs/0*.json"):
            assert_keys("experiments.txt", {**read(path), "rows": 0, "settings": 0, "pictures": 0}, begins="job ")
        if (folder / "jobs" / "shared.json").exists():
            shared = read(folder / "jobs" / "shared.json")
            assert_keys("experiments.txt", {**shared, "settings": 0}, begins="shared.json ")
        result = read(folder / "result.json")
        assert_keys("experiments.txt", {**result, "summary": 0, "settings": 0}, begins="result.json ")


def test_v010_results_have_the_listed_keys():
    assert_results(OLD / "experiments")


def test_v010_results_are_reported_or_refused_in_one_line(tmp_path, capsys):
    """Rows of another version are not mixed with this one's."""
    shutil.copytree(OLD / "experiments", tmp_path / "out")
    status = experiments_main(["hand_eye", "--quick", "--report", "--out", str(tmp_path / "out")])
    said = capsys.readouterr()
    if cotarget.__version__ == "0.1.0":
        assert (tmp_path / "out" / "report.html").exists()
    else:
        assert (
            status
            == statuses()["experiments: a name is unknown, a job fails, a figure is missed, or a bound is broken"]
        )
        assert len(said.err.splitlines()) == 1
        assert "0.1.0" in said.err


def test_experiments_end_with_the_listed_status(capsys):
    failed = statuses()["experiments: a name is unknown, a job fails, a figure is missed, or a bound is broken"]
    assert experiments_main(["--list"]) == statuses()["experiments: all is as it should be"]
    assert experiments_main([UNKNOWN]) == failed
    with pytest.raises(SystemExit) as ended:
        experiments_main(["--no-such-option"])
    assert ended.value.code == statuses()["experiments: an argument is wrong"]
    assert statuses()["experiments: Ctrl-C"] == INTERRUPTED
    assert statuses()["experiments: SIGTERM"] == TERMINATED
