"""Sweeps: every job once, whatever happens to the others or to the program; the same rows whoever does them."""

import base64
import contextlib
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from cotarget.errors import ConfigError
from cotarget.sim.render.opengl import Canvas
from experiments.engine.bounds import Bound, compare, tighten
from experiments.engine.cases import EXPERIMENTS, choose, known_experiments
from experiments.engine.cluster import _check_linear_algebra, on_dask
from experiments.engine.command import main
from experiments.engine.harness import Experiment, Settings
from experiments.engine.outcome import Outcome
from experiments.engine.report import Run, duration, used, write_report
from experiments.engine.results import FORMAT, LOCK, Record, Spent, code_version, taken
from experiments.engine.sessions import Session, Share, sessions
from experiments.engine.tasks import Task, perform
from experiments.engine.workers import LINEAR_ALGEBRA, ONE_THREAD, Died, here, in_processes
from tests.support.tiny_experiments import ALONE, KNOWN, TINY, knows_its_code, notes, pids

DEADLINE_S = 120.0  # for a program to come as far as it is waited for
QUICKLY_S = 60.0  # for a program to end that is interrupted, on a busy machine; its jobs would take for ever
ROOT = Path(__file__).parents[2]


@pytest.fixture
def run(tmp_path, capsys, monkeypatch):
    """The command on tiny experiments, in a folder of its own; exit status, what it said, and what it complained of.

    Everything is done in this process, which spares the start of others, unless processes are asked for.
    """

    def typed(*arguments, out="out", expected=tmp_path):
        with monkeypatch.context() as patched:
            patched.setattr("cotarget.cli.common.REMARK_S", math.inf)  # a busy machine is no complaint
            if "--processes" not in arguments:
                patched.setattr("experiments.engine.command.in_processes", here)
                patched.setattr("experiments.engine.runner.in_turn", here)
            status = main([*arguments, "--out", str(tmp_path / out)], KNOWN, expected)
        told = capsys.readouterr()
        return status, told.out, told.err

    return typed


def noted(tmp_path, *names):
    return [argument for name in names for argument in ("--set", f"{name}.notes='{tmp_path}'")]


def job(tmp_path, name, number, out="out"):
    return json.loads((tmp_path / out / name / "jobs" / f"{number:06d}.json").read_text())


# ---------------------------------------------------------------- what is done
def test_each_job_once_what_is_shared_first_and_timings_last(run, tmp_path):
    shared, others = tmp_path / "shared", tmp_path / "others"
    shared.mkdir()
    others.mkdir()
    places = (*noted(shared, "sharing"), *noted(others, "tiny", "alone"))
    status, told, complaints = run("sharing", "tiny", "alone", *places, "--processes", "2")
    assert (status, complaints) == (0, "")
    assert notes(shared)[0] == "prepared"
    assert sorted(notes(shared)[1:]) == [f"job {seed}" for seed in range(4)]
    assert sorted(notes(others)[:4]) == [f"job {seed}" for seed in range(4)]
    assert notes(others)[4:] == [f"alone {seed}" for seed in range(4)]
    assert os.getpid() not in pids(shared) | pids(others)
    timing = pids(others, "alone")
    assert len(timing) == 1  # one process for all of them, which has done nothing else
    assert not timing & (pids(shared) | pids(others, "job"))
    (folder,) = (path for path in (tmp_path / "out").iterdir() if path.name.startswith("sharing"))
    assert json.loads((folder / "jobs" / "shared.json").read_text())["seconds"] > 0
    record = json.loads((folder / "jobs" / "000003.json").read_text())
    assert record["rows"][0] == {"seed": 3, "value": 3.0, "sum": record["rows"][0]["sum"], "shared": "given to all"} | {
        "odd": True
    }
    assert record["version"] == code_version()
    assert record["seconds"] > 0
    assert record["settings"]["factor"] == 1.0
    assert "seeds 0 to 3: <total> 6" in told
    assert str(tmp_path / "out" / "report.html") in told
    assert run("tiny", "--processes", "1", out="one")[0] == 0
    one, two = (sorted((tmp_path / out).glob("tiny*/rows.csv")) for out in ("one", "out"))
    assert one[0].read_bytes() == two[0].read_bytes()


def test_what_a_job_takes_is_told():
    def call():
        Canvas.drawn += 3  # as drawing does
        end = time.process_time() + 0.02
        while time.process_time() < end:
            pass
        return [{"seed": 0, "value": np.float32(0.5), "of": (1, 2)}]

    done = perform(Task(0, 0, call))
    assert (done.renders, done.result) == (3, [{"seed": 0, "value": 0.5, "of": [1, 2]}])
    assert 0.02 <= done.cpu_s <= done.seconds + 0.01  # clocks of their own
    assert "a row holds a set, which is no number" in perform(Task(0, 0, lambda: [{"seed": {0}}])).failed


def test_more_seeds_are_added_to_those_that_are_there(run, tmp_path):
    assert run("tiny", *noted(tmp_path, "tiny"), "--seeds", "2")[0] == 0
    assert run("tiny", *noted(tmp_path, "tiny"), "--seeds", "3")[0] == 0
    assert notes(tmp_path).count("job 0") == 1
    assert sorted(notes(tmp_path)) == ["job 0", "job 1", "job 2"]
    status, told, _ = run("tiny", *noted(tmp_path, "tiny"), "--seeds", "1", "--report")
    assert (status, "seeds 0 to 0: <total> 0" in told) == (0, True)
    assert len(notes(tmp_path)) == 3


def test_settings_can_be_swept(run, tmp_path):
    status, told, _ = run("tiny", "--seeds", "2", "--set", "tiny.factor=2", "--set", "tiny.factor=3.5")
    assert status == 0
    assert told.index("tiny, factor=2 (") < told.index("tiny, factor=3.5 (")
    assert [job(tmp_path, f"tiny,factor={text}", 1)["rows"][0]["value"] for text in ("2", "3.5")] == [2.0, 3.5]
    page = (tmp_path / "out" / "report.html").read_text()
    assert '<tr><th scope="row">total</th><td>2</td><td>3.5</td></tr>' in page
    cases = choose(KNOWN, ["tiny"], changes=["tiny.factor=1", "tiny.wrong=[1]", "tiny.factor=2", "tiny.wrong=[]"])
    assert [(case.settings.factor, case.settings.wrong) for case in cases] == [
        (1.0, (1,)), (1.0, ()), (2.0, (1,)), (2.0, ())
    ]  # fmt: skip
    assert len({case.folder for case in cases}) == 4
    again = ("factor=0.1", "wrong=[1, 2]", "factor=1e-1", "wrong=[1,2]", "factor=0.10", "factor=0.2")
    assert [case.changes for case in choose(KNOWN, ["tiny"], changes=[f"tiny.{each}" for each in again])] == [
        ("factor=0.1", "wrong=[1, 2]"), ("factor=0.2", "wrong=[1, 2]")
    ]  # fmt: skip


# ---------------------------------------------------------------- what goes wrong
def test_a_seed_that_fails_is_recorded_and_the_rest_goes_on(run, tmp_path):
    wrong = ("tiny", *noted(tmp_path, "tiny"), "--set", "tiny.wrong=[1]")
    status, told, complaints = run(*wrong)
    assert status == 1
    assert complaints.count("\n") == 1
    assert "seed 1 failed: ValueError: seed 1 is wrong" in complaints
    assert "<total> 5" in told  # 0 + 2 + 3
    (folder,) = (path for path in (tmp_path / "out").iterdir() if path.is_dir())
    assert "ValueError: seed 1" in (folder / "jobs" / "000001.traceback.txt").read_text()
    assert json.loads((folder / "jobs" / "000001.json").read_text())["rows"] is None
    page = (tmp_path / "out" / "report.html").read_text()
    assert "1 job failed" in page
    assert "ValueError: seed 1 is wrong" in page
    (tmp_path / "mended").touch()
    before = len(notes(tmp_path))
    assert run(*wrong)[0] == 0
    assert notes(tmp_path)[before:] == ["job 1"]
    assert not (folder / "jobs" / "000001.traceback.txt").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "total"), [("tiny", "<total> 5"), ("alone", "<total> 3")])
def test_a_job_that_kills_its_process_takes_no_other_along(run, tmp_path, name, total):
    fatal = (*noted(tmp_path, name), "--set", f"{name}.fatal=[1]", "--processes", "2")
    status, told, complaints = run(name, *fatal)
    assert (status, complaints.count("\n")) == (1, 1)
    assert "seed 1 failed: its process died" in complaints
    assert total in told
    assert len(notes(tmp_path)) == 4  # each once


def test_what_is_shared_by_several_is_prepared_once(run, tmp_path):
    both = ("--set", "sharing.factor=1", "--set", "sharing.factor=2")
    assert run("sharing", *noted(tmp_path, "sharing"), *both, "--seeds", "1")[0] == 0
    assert notes(tmp_path) == ["prepared", "job 0", "job 0"]
    taken_by = [json.loads(path.read_text())["seconds"] for path in (tmp_path / "out").glob("*/jobs/shared.json")]
    assert len(taken_by) == 1  # counted once too


def test_what_is_shared_fails(run, tmp_path):
    status, told, complaints = run("vain", "tiny")
    assert status == 1
    assert complaints.count("vain, seed") == 4
    assert "OSError: nothing to share" in complaints
    assert "no job has given any rows" in told
    assert "<total> 6" in told


def test_figures_that_cannot_be_made_are_told(run, monkeypatch):
    monkeypatch.setitem(KNOWN, "tiny", lambda: Experiment("tiny", "", *[TINY.settings] * 2, ALONE.one, min, str))
    status, told, _ = run("tiny")
    assert status == 1
    assert "the rows give no figures: TypeError" in told


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tyni"], "unknown experiment 'tyni', the nearest is 'tiny'; there are: alone, lacking, sharing, tiny, vain"),
        (["tiny", "--set", "tiny.facto=1"], "unknown key 'tiny.facto'; valid here: factor, fatal, gated"),
        (["tiny", "--set", "tiny.factor=high"], "tiny.factor: 'high' is not a finite number"),
        (["tiny", "--set", "tiny.seeds=0"], "seeds = 0: at least 1 is needed"),
        (["tiny", "--set", "tiny.factor=-1"], "tiny.factor: -1 is below 0"),
        (["tiny", "--set", "tiny.processes=2"], "how many processes there are changes no row; say --processes"),
        (["tiny", "--set", "vain.factor=1"], "vain is not among those to run: tiny"),
        (["tiny", "--set", "factor"], "'factor' is not like NAME.KEY=VALUE"),
        (["lacking"], "lacking needs the moon"),
        (["tiny"], "file is no folder; name one that is, or that can be made"),
        (["tiny", "--scheduler", "tcp://127.0.0.1:1"], "goes with --backend dask"),
        (["tiny", "--update-expected"], "goes with --quick alone"),
        (["tiny", "--report", "--fresh"], "say one of them"),
        (["tiny", "--report"], "out: no such folder; --out names one with results"),
        (["tiny", "--report"], "empty: holds no results of what is asked for; --out names the folder that does"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_mistakes_end_in_one_line(run, tmp_path, arguments, message):
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    out = next((name for name in ("file", "empty") if name in message), "out")
    status, told, complaints = run(*arguments, out=out)
    assert (status, told) == (1, "")
    assert complaints.count("\n") == 1
    assert message in complaints


def test_wrong_arguments_end_in_one_line(capsys):
    for arguments in (["--seeds", "0"], ["--nothing"]):
        with pytest.raises(SystemExit) as ended:
            main(arguments, KNOWN)
        assert ended.value.code == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_what_cannot_be_done_is_left_out_unless_it_is_named(run, tmp_path):
    status, told, _ = run("--seeds", "1")
    assert status == 1  # of `vain`
    assert "lacking\nnot run: needs the moon" in told
    assert "needs the moon" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": "0.0.9+12345678"}, "is of cotarget 0.0.9+12345678, this is"),
        ({"version": code_version().partition("+")[0] + "+12345678"}, "keep it all the same with --any-code"),
        ({"format": 0}, f"is of format 0, this is format {FORMAT}"),
        ({"settings": None}, "is of tiny with"),
    ],
    ids=["version", "code", "format", "settings"],
)
def test_results_of_another_version_are_refused(run, tmp_path, change, message):
    assert run("tiny", "--seeds", "1")[0] == 0
    path = tmp_path / "out" / "tiny" / "jobs" / "000000.json"
    told = json.loads(path.read_text())
    path.write_text(json.dumps(told | (change if change.get("settings", 1) else {"settings": {"factor": 9.0}})))
    kept = path.read_bytes()
    status, said, complaints = run("tiny", "--seeds", "1")
    assert (status, said, complaints.count("\n")) == (1, "", 1)
    assert message in complaints
    assert "another folder with --out, or begin anew with --fresh" in complaints
    assert path.read_bytes() == kept
    is_code = "--any-code" in message
    assert run("tiny", "--seeds", "1", "--any-code")[0] == (0 if is_code else 1)
    status, said, _ = run("tiny", "--seeds", "1", "--report")
    assert status == (0 if is_code else 1)
    assert not is_code or f"done by cotarget {change['version']}, this is {code_version()}" in said
    assert run("tiny", "--seeds", "1", "--fresh")[0] == 0
    assert json.loads(path.read_text())["version"] == code_version()


def test_what_a_killed_run_has_left_half_written_is_no_result(run, tmp_path):
    folder = tmp_path / "out" / "tiny" / "jobs"
    folder.mkdir(parents=True)
    (folder / ".000000.part.json").write_text("{")
    assert run("tiny", "--seeds", "1")[0] == 0
    assert [path.name for path in folder.iterdir()] == ["000000.json"]


def test_two_runs_into_one_folder(run, tmp_path):
    with taken(tmp_path / "out"):
        status, told, complaints = run("tiny")
        assert (status, told, complaints.count("\n")) == (1, "", 1)
        assert "another run is writing its results there; wait for it, or take another folder" in complaints
        assert run("tiny", "--report")[0] == 1  # which only looks; nothing is done yet
    assert run("tiny")[0] == 0


def test_code_that_is_changed_meanwhile_ends_the_run(run, tmp_path, monkeypatch):
    def changed(task):
        return replace(perform(task), version="0.1.0+12345678")

    with monkeypatch.context() as patched:
        patched.setattr(
            "experiments.engine.runner.perform", lambda task: (perform if task.number == 0 else changed)(task)
        )
        status, told, complaints = run("tiny")
        assert run("tiny", "--any-code")[0] == 1  # is for what is there, not for who does more
        afresh = run("tiny", "--fresh")[2]
    assert (status, told, complaints.count("\n")) == (1, "", 1)
    assert afresh.endswith("and the same command without --fresh goes on\n")
    assert f"a worker has cotarget 0.1.0+12345678, this is {code_version()}; was the code changed?" in complaints
    assert "1 of 4 jobs are done and kept" in complaints
    assert complaints.endswith("and the same command goes on\n")
    assert len(list((tmp_path / "out" / "tiny" / "jobs").iterdir())) == 1
    assert run("tiny")[0] == 0


def test_other_settings_are_refused(run):
    assert run("tiny", "--quick", "--seeds", "1")[0] == 0
    status, _, complaints = run("tiny", "--seeds", "1", "--seed-base", "5")
    assert status == 1
    assert "is of tiny with seed_base = 0, here it is 5; ask as before (--quick, --seed-base, --set), " in complaints


def test_a_file_that_cannot_be_read(run, tmp_path):
    assert run("tiny", "--seeds", "1")[0] == 0
    file = tmp_path / "out" / "tiny" / "jobs" / "000000.json"
    told = json.loads(file.read_text())
    harms = [("cannot be read", "{")]
    harms += [
        ("lacks something", json.dumps({key: told[key] for key in told if key != gone})) for gone in ("rows", "seed")
    ]
    harms += [("lacks something", json.dumps(told | {"pictures": {"a": "no base 64"}}))]
    for complaint, text in harms:
        file.write_text(text)
        status, _, complaints = run("tiny", "--seeds", "1")
        assert (status, complaints.count("\n")) == (1, 1)
        assert f"000000.json: {complaint}" in complaints


# ---------------------------------------------------------------- what is broken off
@pytest.fixture
def started(tmp_path):
    """The command as a program of its own, with a job that waits for ever once the others are done."""
    arguments = [*noted(tmp_path, "tiny"), "--set", "tiny.gated=[2, 3]", "--out", str(tmp_path / "out")]
    command = [sys.executable, "-m", "tests.support.tiny_experiments", "tiny", "--processes", "2", *arguments]
    os.mkfifo(tmp_path / "gate")
    programs = []

    def start():
        programs.append(
            subprocess.Popen(
                command,
                cwd=ROOT,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
                env=os.environ | {"PYTHONPATH": str(ROOT)},
            )
        )
        return programs[-1]

    yield start
    for program in programs:
        program.kill()
        program.communicate()


def until(condition, what):
    end = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.02)


def is_gone(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return True
    return state == "Z"


def test_a_killed_run_goes_on_where_it_was(started, tmp_path):
    program = started()
    until(lambda: len(notes(tmp_path)) == 4, "all four jobs have begun, two of them wait")
    until(lambda: len(list((tmp_path / "out").glob("*/jobs/*.json"))) == 2, "two are on disk")
    workers = pids(tmp_path)
    program.send_signal(signal.SIGKILL)
    program.wait()
    until(lambda: all(map(is_gone, workers)), "no process outlives the one that started it")
    assert not [path for path in (tmp_path / "out").rglob(".*") if path.name != LOCK]  # none half-written
    (tmp_path / "gate").unlink()
    (tmp_path / "gate").touch()
    again = started()
    told, complaints = again.communicate(timeout=DEADLINE_S)
    assert (again.returncode, "python -m experiments:" in complaints) == (0, False)
    assert "<total> 6" in told
    assert sorted(notes(tmp_path)) == ["job 0", "job 1", "job 2", "job 2", "job 3", "job 3"]


@pytest.mark.parametrize(
    ("end", "status"),
    [
        (lambda program: os.killpg(program.pid, signal.SIGINT), 130),  # as a terminal does: to all processes
        pytest.param(lambda program: program.terminate(), 143, marks=pytest.mark.slow),
    ],
    ids=["Ctrl-C", "kill"],
)
def test_a_polite_end_is_quick_and_says_how_to_go_on(started, tmp_path, end, status):
    program = started()
    until(lambda: len(notes(tmp_path)) == 4, "all four jobs have begun, two of them wait")
    until(lambda: len(list((tmp_path / "out").glob("*/jobs/*.json"))) == 2, "two are on disk")
    end(program)
    told, complaints = program.communicate(timeout=QUICKLY_S)
    assert (program.returncode, told) == (status, "")
    assert "; 2 of 4 jobs are done and kept" in complaints
    assert "Traceback" not in complaints
    assert all(map(is_gone, pids(tmp_path)))


def test_an_engine_that_is_left_ends_its_processes(tmp_path):
    results = in_processes(knows_its_code, [str(tmp_path)] * 3, 1)
    assert next(results) == (0, True)
    results.close()
    with pytest.raises(ValueError, match="invalid literal"):
        list(in_processes(int, ["1", "x", "3"], 2))
    assert dict(in_processes(os._exit, [3], 1)) == {0: Died}


# ---------------------------------------------------------------- the report and the bounds
def test_the_report_has_everything_and_needs_nothing(run, tmp_path):
    (tmp_path / "tiny.json").write_text('{"total": 0.5, "by": {"worst": 3.0}}')
    status, told, _ = run("--quick", "--seeds", "2")
    assert status == 1
    assert "worse than its bound: total, 1.0 is not at most 0.5" in told
    page = (tmp_path / "out" / "report.html").read_text()
    pictures = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert [base64.b64decode(picture) for picture in pictures] == [
        (tmp_path / "out" / name / "figure.png").read_bytes() for name in ("tiny", "sharing")
    ]
    assert cv2.imdecode(np.frombuffer(base64.b64decode(pictures[0]), np.uint8), cv2.IMREAD_COLOR) is not None
    text = re.sub(r"base64,[^\"]+", "", page)
    assert "http" not in text
    assert not re.search(r"<(script|link|iframe)", text)
    for words in (
        *("Adds up.", "Shares.", "Takes the time.", "seeds 0 to 1: &lt;total&gt; 1", "Values of each seed."),
        *("needs the moon", "OSError: nothing to share", "python -m experiments --quick", code_version()),
        "<td>at most 0.5</td><td>1</td><td>NO</td>",  # bound, reached
        "<td>at most 3</td><td>1</td><td>yes</td>",
    ):
        assert words in text, words
    for version in (np.__version__, cv2.__version__):
        assert version in text
    times = text[text.index('id="times"') : text.index('id="made"')]
    assert times.count("<tr>") == 2 + 4 + 1 + 1  # two heads, four experiments with jobs and all of them, one session
    assert re.search(r"In all: .+ s and 0 renders; a full run may take 60 min and 80000 renders\.", times)


def test_a_wanted_figure_that_is_missed_is_told(run, tmp_path):
    arguments = ("tiny", "--set", "tiny.factor=50", "--seeds", "3")
    status, told, _ = run(*arguments)
    assert (status, "missed: total: too much" in told) == (1, True)
    assert "Some figures are not what is wanted" in (tmp_path / "out" / "report.html").read_text()
    assert run(*arguments, "--quick", out="quick")[0] == 0  # which is too short for that


def test_bounds_only_tighten(run, tmp_path):
    path = tmp_path / "tiny.json"
    path.write_text('{"total": 0.5, "by": {"worst": {"at_most": 3.0}}, "rows": {"at_least": null}}')
    status, told, _ = run("tiny", "--quick", "--update-expected")
    assert status == 1
    assert json.loads(path.read_text()) == {"total": 0.5, "by": {"worst": {"at_most": 1.0}}, "rows": {"at_least": 4.0}}
    assert "tiny: by / worst: at most 3 -> 1\ntiny: rows: at least - -> 4\n" in told
    assert "no bound is tighter now" in run("tiny", "--quick", "--update-expected")[1]
    assert [Bound((), kind, -1.0, reached).kept for kind, reached in (("at_most", -1.0), ("at_most", -0.95))] == [
        True
    ] * 2
    assert [Bound((), "at_least", -1.0, reached).kept for reached in (-1.05, -1.15)] == [True, False]
    assert not Bound((), "at_most", -1.0, -0.9).kept  # which is more than 10 % worse
    assert tighten(ALONE, {"total": 0.0}, tmp_path) == []  # times


def test_bounds_are_kept_to_from_either_side(tmp_path):
    bounds = {"book": {"yield": {"at_least": 0.88}, "offset": {"at_most": 0.02}, "sum": {"within": [0.85, 1.15]}}}
    (tmp_path / "tiny.json").write_text(json.dumps(bounds | {"n": 0.0}))

    def broken(book, n=0.0):
        found = compare(TINY, {"book": book, "n": n}, tmp_path)
        return [f"{bound.name} {bound.text}" for bound in found if not bound.kept]

    good = {"yield": 0.81, "offset": np.float32(0.0219), "sum": 1.14, "more": 7.0}
    assert broken(good) == []
    for key, bad in (("yield", 0.79), ("offset", 0.0221), ("sum", 1.16), ("sum", 0.84), ("offset", math.nan)):
        assert len(broken(good | {key: bad})) == 1
    assert broken({}) == ["book / yield at least 0.88", "book / offset at most 0.02", "book / sum within 0.85 to 1.15"]
    assert broken(good, 0.1) == ["n at most 0"]
    tighten(TINY, {"book": {"yield": 0.9, "offset": 0.03, "sum": 1.0}, "n": 0}, tmp_path)
    assert json.loads((tmp_path / "tiny.json").read_text()) == {
        "book": bounds["book"] | {"yield": {"at_least": 0.9}},
        "n": 0.0,
    }


def test_a_bound_whose_figure_is_gone_is_broken(tmp_path):
    (tmp_path / "tiny.json").write_text('{"total": 1.0, "other": {"figure": 1.0}, "by": 1.0}')
    found = compare(TINY, {"total": 1.09, "by": float("nan")}, tmp_path)
    assert [(bound.name, bound.kept) for bound in found] == [("total", True), ("other / figure", False), ("by", False)]
    for wrong, said in (
        ("[]", "not a table of bounds"),
        ('{"total": "low"}', "total: 'low' is not a number"),
        ('{"total": {"within": [1]}}', r"total / within: \[1\] is not a pair"),
    ):
        (tmp_path / "tiny.json").write_text(wrong)
        with pytest.raises(ConfigError, match=said):
            compare(TINY, {}, tmp_path)


def test_a_report_of_what_is_there_says_how_it_was_made(run, tmp_path):
    assert run("tiny", "--seeds", "1")[0] == 0
    assert run("tiny", "--seeds", "1", "--report")[0] == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "python -m experiments tiny --seeds 1 --out" in page
    assert "--report" not in page


def test_sessions_are_told_without_what_was_forgotten(run, tmp_path):
    path = tmp_path / "out" / "sessions.json"
    assert run("tiny", "sharing", "--seeds", "1")[0] == 0
    (before,) = sessions(path.parent)
    assert set(before.cases) == {"tiny", "sharing"}
    assert before.cases["sharing"].shared_s > 0
    assert run("tiny", "--fresh", "--seeds", "1")[0] == 0
    first, second = sessions(path.parent)
    assert (set(first.cases), set(second.cases)) == ({"sharing"}, {"tiny"})
    assert 0 < first.wall_s < before.wall_s
    page = (path.parent / "report.html").read_text()
    assert page.count(f"<td>{second.workers}</td>") == 1  # the other is of what is not reported here
    told = json.loads(path.read_text())
    path.write_text(json.dumps([{"began": 1}, 2, *told, told[0] | {"wall_s": "long"}]))
    assert sessions(path.parent) == [first, second]
    assert run("tiny", "--seeds", "1")[0] == 0


@pytest.mark.parametrize("damaged", ["[", "{}"])
def test_damaged_sessions_are_not_taken_for_none(run, tmp_path, damaged):
    assert run("tiny", "--seeds", "1")[0] == 0
    (tmp_path / "out" / "sessions.json").write_text(damaged)
    status, _, complaints = run("tiny", "--seeds", "1", "--report")
    assert (status, complaints.count("\n")) == (1, 1)
    assert "sessions.json: cannot be read" in complaints
    assert (tmp_path / "out" / "sessions.json").read_text() == damaged


@pytest.mark.parametrize(
    ("what", "wall_s", "said"),
    [
        ("is_quick", 290.0, "4 min 50 s and 70000 renders, of 5 min that a quick run may take"),
        ("is_quick", 310.0, "5 min 10 s and 70000 renders, of 5 min that a quick run may take: too much time"),
        ("is_full", 3500.0, "58 min 20 s and 70000 renders, of 60 min and 80000 renders that a full run may take"),
        (
            "is_full",
            3700.0,
            "1 h 2 min and 70000 renders, of 60 min and 80000 renders that a full run may take: too much time",
        ),
        ("neither", 3700.0, "1 h 2 min and 70000 renders; a full run may take 60 min and 80000 renders"),
    ],
)
def test_what_all_took_is_told_beside_what_it_may(what, wall_s, said):
    (case,) = choose(KNOWN, ["sharing"])
    outcome = Outcome(case, {0: Record(0, 9.0, 8.0, "", 20_000, [])}, shared=Spent(2.0, 1.0, 50_000))
    session = Session("", wall_s, "", "", "", {}, {"sharing": Share(1, 9.0, 2.0, 70_000)})
    run = Run([outcome], {}, [session], "", is_full=what == "is_full", is_quick=what == "is_quick")
    assert used(run) == said
    assert outcome.cpu_s == 9.0


def test_every_version_that_has_a_part_is_told(tmp_path):
    """One after the other by two machines, the first of which did more later."""
    session = Session("2026-01-01", 1.0, "", "0.1.0+a.b", "small", {"numpy": "2.1.0"}, {"tiny": Share(1)})
    others = [replace(session, began="2026-01-02", versions={"numpy": "2.2.0"}), replace(session, began="2026-01-03")]
    write_report(tmp_path / "report.html", Run([], {}, [session, *others], ""))
    page = (tmp_path / "report.html").read_text()
    assert page.count("2.1.0") == page.count("2.2.0") == 1
    assert "2026-01-01 and 2026-01-03" in page


def test_times_in_words():
    told = [duration(seconds) for seconds in (0.0123, 59.0, 310.0, 7380.0)]
    assert told == ["0.012 s", "59 s", "5 min 10 s", "2 h 3 min"]


# ---------------------------------------------------------------- the real ones
def test_all_experiments_are_of_one_shape(capsys):
    known = known_experiments()
    assert tuple(known) == tuple(EXPERIMENTS)
    files = {
        path.stem
        for folder in ("experiments", "benchmarks")
        for path in (ROOT / folder).rglob("*.py")
        if "EXPERIMENT = " in path.read_text()
    }
    assert files == set(EXPERIMENTS)
    for name, load in known.items():
        experiment = load()
        assert experiment.name == name
        assert isinstance(experiment.quick, Settings)
        assert len(experiment.jobs(experiment.quick)) <= len(experiment.jobs(experiment.settings))
        assert experiment.plot is None or experiment.plot.__doc__  # the picture's caption
    assert main(["--list"]) == 0
    told = capsys.readouterr().out
    assert [name for name in EXPERIMENTS if not re.search(rf"^{name} +\S", told, re.MULTILINE)] == []
    assert {name for name, load in known.items() if load().alone} == {
        *("speed", "wire", "sim_speed", "env_speed", "pipeline_speed", "sweep_speed"),
    }


# ---------------------------------------------------------------- on a cluster
@pytest.fixture
def cluster(monkeypatch):
    for name, value in ONE_THREAD.items():  # workers within this process leave it as it was
        monkeypatch.setenv(name, value)
    distributed = pytest.importorskip("distributed", reason="Dask is not installed: pip install 'cotarget[sweeps]'")

    def start(threads=1, processes=True):
        made.append(
            distributed.LocalCluster(
                n_workers=2,
                threads_per_worker=threads,
                host="127.0.0.1",
                protocol="tcp://",
                processes=processes,
                dashboard_address="127.0.0.1:0",
                silence_logs=40,
            )
        )
        return made[-1].scheduler_address

    made, threads = [], cv2.getNumThreads()
    yield start
    cv2.setNumThreads(threads)
    for each in made:
        each.close()


@pytest.mark.parametrize("processes", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_same_sweep_on_a_cluster(run, tmp_path, cluster, processes):
    where = ("--backend", "dask", "--scheduler", cluster(processes=processes))
    arguments = ("sharing", "alone", *noted(tmp_path, "sharing", "alone"), "--set", "sharing.wrong=[1]")
    status, _, complaints = run(*arguments, *where)
    assert (status, complaints.count("\n")) == (1, 1)
    assert "seed 1 failed: ValueError: seed 1 is wrong" in complaints
    assert len(pids(tmp_path) - {os.getpid()}) == 2 * processes  # both workers had something to do
    (tmp_path / "mended").touch()
    before = len(notes(tmp_path))
    assert run(*arguments, *where)[0] == 0
    assert notes(tmp_path)[before:] == ["prepared", "job 1"]
    assert run(*arguments, *(["--processes", "1"] if processes else []), out="here")[0] == 0
    ours, theirs = (sorted((tmp_path / out).glob("*/rows.csv")) for out in ("here", "out"))
    assert len(ours) == 2
    assert [path.read_bytes() for path in ours] == [path.read_bytes() for path in theirs]


@pytest.mark.slow
def test_a_job_that_kills_its_workers_on_a_cluster(run, cluster):
    where = ("--backend", "dask", "--scheduler", cluster())
    status, told, complaints = run("tiny", "--set", "tiny.fatal=[1]", *where)
    assert (status, complaints.count("\n")) == (1, 1)
    assert "seed 1 failed: its process died" in complaints
    assert "<total> 5" in told  # 0 + 2 + 3


def test_a_cluster_that_is_not_fit(run, tmp_path, cluster, monkeypatch):
    two = ("--backend", "dask", "--scheduler", cluster(threads=2, processes=False))
    status, _, complaints = run("tiny", *two)
    assert (status, complaints.count("\n")) == (1, 1)
    assert "has 2 threads; start workers with --nthreads 1" in complaints
    where = ("--backend", "dask", "--scheduler", cluster(processes=False))
    for name in LINEAR_ALGEBRA:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MKL_NUM_THREADS", "1")  # which what pip installs does not heed
    assert "start it with OMP_NUM_THREADS=1" in run("tiny", *where)[2]
    with monkeypatch.context() as patched:
        patched.setattr("experiments.engine.cluster._check_workers", lambda *_: None)  # as if they had joined later
        assert "start it with OMP_NUM_THREADS=1" in run("tiny", *where)[2]
        assert "has 2 threads; start workers with --nthreads 1" in run("tiny", *two)[2]
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")  # which OpenBLAS heeds first
    several = "has linear algebra on several threads, by OPENBLAS_NUM_THREADS=2; start it with OPENBLAS_NUM_THREADS=1"
    assert several in run("tiny", *where)[2]
    with monkeypatch.context() as patched:
        patched.setattr("experiments.engine.cluster._check_workers", lambda *_: None)
        assert several in run("tiny", *where)[2]
    monkeypatch.setattr("experiments.engine.command.code_version", lambda: "0.0.9+12345678")
    assert f"has cotarget {code_version()}, this is 0.0.9+12345678; give both the same" in run("tiny", *where)[2]
    assert not list((tmp_path / "out").glob("*/jobs/*"))


@pytest.mark.parametrize(
    ("environment", "held"),
    [
        ({}, False),
        ({"OMP_NUM_THREADS": "1"}, True),
        ({"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "4"}, True),
        ({"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "1"}, False),
        ({"OPENBLAS_NUM_THREADS": "0", "GOTO_NUM_THREADS": "2", "OMP_NUM_THREADS": "1"}, False),
        ({"OPENBLAS_NUM_THREADS": "many", "OMP_NUM_THREADS": "1,2"}, True),
    ],
    ids=str,
)
def test_one_thread_is_what_openblas_makes_of_the_variables(environment, held):
    """OpenBLAS itself starts its threads when numpy is loaded."""
    with contextlib.nullcontext() if held else pytest.raises(ConfigError, match="several threads"):
        _check_linear_algebra("tcp://10.0.0.1:9", environment)
    tasks = Path("/proc/self/task")
    if not tasks.is_dir() or len(os.sched_getaffinity(0)) < 2:
        pytest.skip("a process's threads cannot be counted here, or have but one core")
    clean = {name: value for name, value in os.environ.items() if name not in LINEAR_ALGEBRA}
    count = f"import os, numpy; print(len(os.listdir('{tasks}')))"
    made = subprocess.run([sys.executable, "-c", count], env=clean | environment, capture_output=True, check=True)
    assert (int(made.stdout) == 1) == held


def test_nobody_answers(run):
    status, _, complaints = run("tiny", "--backend", "dask", "--scheduler", "nowhere")
    assert (status, complaints.count("\n")) == (1, 1)
    assert "no Dask scheduler answers at nowhere" in complaints


@pytest.mark.slow
def test_a_cluster_of_ones_own():
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'cotarget[sweeps]'")
    assert dict(on_dask(math.sqrt, [4.0, 9.0], 1, version=code_version())) == {0: 2.0, 1: 3.0}


def test_results_are_kept_where_nobody_can_begin_anew(run, tmp_path, monkeypatch):
    assert run("tiny")[0] == 0
    dask = ("tiny", "--fresh", "--backend", "dask")
    assert "no Dask scheduler answers" in run(*dask, "--scheduler", "nowhere")[2]
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "needs distributed" in run(*dask)[2]
    assert len(list((tmp_path / "out" / "tiny" / "jobs").iterdir())) == 4


def test_a_missing_engine_is_named_with_what_brings_it(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    status, _, complaints = run("tiny", "--backend", "dask", "--scheduler", "tcp://127.0.0.1:1")
    assert (status, complaints.count("\n")) == (1, 1)
    assert "needs distributed, which is not installed: pip install 'cotarget[sweeps]'" in complaints
