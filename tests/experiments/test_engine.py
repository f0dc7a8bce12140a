"""Sweeps: every seed once, the same rows whoever does them; a figure that is off its goal is missed, and no other."""

import contextlib
import fcntl
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from argparse import Namespace
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cotarget.errors import ConfigError
from cotarget.sim.render import opengl
from experiments.command import choose, main
from experiments.engine import ONE_THREAD, TALLY, code_version, csv_of, known_experiments, perform, read_rows
from experiments.following import dead_zone, hold
from experiments.report import Bound, compare, draw
from experiments.tables import plain
from tests.formats.test_experiments import OLD_RESULTS, experiment_of, old_jobs
from tests.support.tiny_experiments import KNOWN, here, here_together, notes, pids

DEADLINE_S = 120.0  # for a program to come as far as it is waited for
ROOT = Path(__file__).parents[2]


@pytest.fixture
def run(tmp_path, capsys, monkeypatch):
    """The command on tiny experiments, in this process; exit status, what it said, and what it complained of."""
    monkeypatch.setattr("cotarget.parallel.PROGRESS_LINE_S", math.inf)  # a busy machine is no complaint

    def typed(*arguments, out="out", known=KNOWN, apart=here):
        status = main([*arguments, "--out", str(tmp_path / out)], known, tmp_path, here_together, apart)
        told = capsys.readouterr()
        return status, told.out, told.err

    return typed


def noted(tmp_path, *names):
    return [argument for name in names for argument in ("--set", f"{name}.notes='{tmp_path}'")]


def cases(*names, changes=(), known=KNOWN, quick=False, seeds=None, seed_base=None, folder=Path("out")):
    return choose(known, Namespace(names=names, set=changes, quick=quick, seeds=seeds, seed_base=seed_base), folder)


# ---------------------------------------------------------------- what is done
def test_each_seed_once_and_timings_last(run, tmp_path):
    status, told, complaints = run("alone", "tiny", *noted(tmp_path, "tiny", "alone"))
    assert (status, complaints) == (0, "")
    assert notes(tmp_path) == [*(f"job {seed}" for seed in range(4)), *(f"alone {seed}" for seed in range(4))]
    (folder,) = (path for path in (tmp_path / "out").iterdir() if path.name.startswith("tiny"))
    (first, second) = read_rows(folder / "rows" / "000003.csv")
    assert (first["seed"], first["value"], first["odd"], first["none"]) == (3, 3.0, True, None)
    assert math.isnan(second["value"])
    assert second["odd"] is None
    assert (folder / "drawn.png").read_bytes() == b"PNG"
    assert cv2.imread(str(folder / "figure.png")) is not None
    assert len(read_rows(folder / "rows.csv")) == 8
    result = json.loads((folder / "result.json").read_text())
    assert result["summary"] == {"total": 6.0, "by": {"worst": 3.0}, "rows": 8}
    assert result["settings"]["factor"] == 1.0
    (log, *_) = read_rows(folder / "seeds.csv")
    assert (log["version"], log["failed"]) == (code_version(), None)
    assert len((folder / "seeds.csv").read_text().splitlines()) == 1 + 4
    assert str(tmp_path / "out" / "report.html") in told
    assert "Values of each seed." in (tmp_path / "out" / "report.html").read_text()


def test_workers_are_no_more_than_jobs_and_end_before_times_are_measured(tmp_path):
    events = []

    @contextlib.contextmanager
    def together(processes, scheduler):
        events.append(processes)
        yield here
        events.append("ended")

    def apart(jobs):
        events.append("timed")
        yield from here(jobs)

    arguments = ["tiny", "alone", "--seeds", "1", "--processes", "7", "--out", str(tmp_path)]
    assert main(arguments, KNOWN, tmp_path, together, apart) == 0
    assert events == [1, "ended", "timed"]


def test_a_folder_is_locked_by_the_run_that_writes_to_it(run, tmp_path):
    (tmp_path / "out").mkdir()
    with (tmp_path / "out" / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        status, _, complaints = run("tiny")
    assert (status, complaints.count("\n"), "another run" in complaints) == (1, 1, True)


def test_more_seeds_are_added_to_those_that_are_there(run, tmp_path):
    assert run("tiny", *noted(tmp_path, "tiny"), "--seeds", "2")[0] == 0
    assert run("tiny", *noted(tmp_path, "tiny"), "--seeds", "3")[0] == 0
    assert notes(tmp_path) == ["job 0", "job 1", "job 2"]
    status, told, _ = run("tiny", *noted(tmp_path, "tiny"), "--seeds", "1", "--report")
    assert status == 0
    assert len(notes(tmp_path)) == 3
    assert "total" in told
    page = (tmp_path / "out" / "report.html").read_text()
    assert "--seeds 1" in page
    assert "--report" not in page
    status, told, _ = run("tiny", *noted(tmp_path, "tiny"), "--seeds", "5", "--report")
    assert (status, "2 seeds are not done yet" in told) == (1, True)


def test_settings_can_be_swept(run, tmp_path):
    assert run("tiny", "--seeds", "2", "--set", "tiny.factor=2", "--set", "tiny.factor=3.5")[0] == 0
    values = [read_rows(tmp_path / "out" / f"tiny,factor={f}" / "rows" / "000001.csv")[0]["value"] for f in (2, 3.5)]
    assert values == [2.0, 3.5]
    assert "Settings compared" in (tmp_path / "out" / "report.html").read_text()
    found = cases("tiny", changes=["tiny.factor=1", "tiny.wrong=[1]", "tiny.factor=2", "tiny.wrong=[]"])
    assert [(case.settings.factor, case.settings.wrong) for case in found] == [
        (1.0, (1,)), (1.0, ()), (2.0, (1,)), (2.0, ())
    ]  # fmt: skip
    assert len({case.folder for case in found}) == 4
    assert len(cases("tiny", changes=["tiny.factor=0.1", "tiny.factor=1e-1", "tiny.factor=0.10"])) == 1


TEXTS = st.sampled_from(["book", "a, b", "1 m"])
VALUES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | TEXTS


@given(st.lists(st.fixed_dictionaries({"a": VALUES, "b": VALUES})))
@settings(derandomize=True, database=None, deadline=None)
def test_rows_are_read_as_they_were_written(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("rows") / "rows.csv"
    path.write_bytes(csv_of(rows))
    read = read_rows(path)
    assert read == rows
    assert [[type(row[key]) for key in "ab"] for row in read] == [[type(row[key]) for key in "ab"] for row in rows]


# ---------------------------------------------------------------- what goes wrong
def test_a_seed_that_fails_is_recorded_and_the_rest_goes_on(run, tmp_path):
    wrong = ("tiny", *noted(tmp_path, "tiny"), "--set", "tiny.wrong=[1]")
    status, _, complaints = run(*wrong)
    assert (status, complaints.count("\n")) == (1, 1)
    assert "seed 1 failed: ValueError: seed 1 is wrong" in complaints
    (folder,) = (path for path in (tmp_path / "out").iterdir() if path.is_dir())
    assert json.loads((folder / "result.json").read_text())["summary"]["total"] == 5.0  # 0 + 2 + 3
    assert "ValueError: seed 1" in (folder / "000001.txt").read_text()
    assert "ValueError: seed 1 is wrong" in (tmp_path / "out" / "report.html").read_text()
    (tmp_path / "mended").touch()
    assert run(*wrong)[0] == 0
    assert notes(tmp_path)[4:] == ["job 1"]
    assert not (folder / "000001.txt").exists()
    (tmp_path / "mended").unlink()
    assert run(*wrong)[0] == 0
    assert run(*wrong, "--fresh")[0] == 1
    assert run(*wrong, "--fresh", "--seeds", "1")[0] == 0
    assert not (folder / "000001.txt").exists()


def test_a_goal_that_is_missed_fails_but_not_a_quick_run(run):
    status, told, _ = run("tiny", "--set", "tiny.factor=50", "--seeds", "3")
    assert (status, "missed: total: too much" in told) == (1, True)
    assert run("tiny", "--set", "tiny.factor=50", "--seeds", "3", "--quick", out="quick")[0] == 0


@pytest.mark.parametrize(("arguments", "named"), [
    (["tyni"], "tyni"), (["tiny", "--set", "tiny.facto=1"], "tiny.facto"),
    (["tiny", "--set", "tiny.factor=high"], "tiny.factor"), (["tiny", "--set", "tiny.seeds=0"], "tiny.seeds"),
    (["tiny", "--set", "tiny.kinds=['none']"], "tiny.kinds"), (["tiny", "--set", "tiny.kinds=[]"], "tiny.kinds"),
    (["tiny", "--set", "alone.factor=1"], "alone"), (["tiny", "--set", "factor"], "factor"), (["lacking"], "lacking"),
    (["tiny", "--update-expected"], "--update-expected"), (["tiny", "--report", "--fresh"], "--report"),
    (["tiny", "--report"], "--report"),
], ids=" ".join)  # fmt: skip
def test_mistakes_end_in_one_line_before_any_work(run, tmp_path, arguments, named):
    status, told, complaints = run(*arguments)
    assert (status, told, complaints.count("\n")) == (1, "", 1)
    assert named in complaints
    assert not (tmp_path / "out" / "tiny").exists()


def test_what_cannot_be_done_is_left_out_unless_it_is_named(run, tmp_path):
    status, told, _ = run("--seeds", "1")
    assert (status, "not run: needs the moon" in told) == (0, True)
    assert "needs the moon" in (tmp_path / "out" / "report.html").read_text()


def test_results_of_other_settings_or_other_code_are_refused(run, tmp_path):
    assert run("tiny", "--seeds", "1")[0] == 0
    status, _, complaints = run("tiny", "--seeds", "1", "--seed-base", "5")
    assert (status, complaints.count("\n"), "settings.json" in complaints) == (1, 1, True)
    log = tmp_path / "out" / "tiny" / "seeds.csv"
    log.write_text(log.read_text().replace(code_version(), "0.0.9+1.2"))
    status, _, complaints = run("tiny", "--seeds", "2")
    assert (status, complaints.count("\n"), "0.0.9+1.2" in complaints) == (1, 1, True)
    status, told, _ = run("tiny", "--seeds", "2", "--any-code")
    assert (status, "0.0.9+1.2" in told) == (0, True)
    assert run("tiny", "--seeds", "2", "--fresh")[0] == 0
    assert "0.0.9" not in log.read_text()
    assert "--fresh" not in (tmp_path / "out" / "report.html").read_text()


def test_a_worker_with_other_code_ends_the_run(run, tmp_path):
    def changed(jobs):
        for i, (job, done) in enumerate(here(jobs)):
            yield job, replace(done, version="0.1.0+1.2") if i else done

    status, _, complaints = run("alone", "--fresh", apart=changed)
    assert (status, complaints.count("\n")) == (1, 1)
    assert "0.1.0+1.2" in complaints
    assert "1 of 4 seeds are done and kept" in complaints
    assert complaints.endswith("the same command without --fresh goes on\n")
    assert run("alone")[0] == 0


# ---------------------------------------------------------------- figures and bounds
def test_bounds_only_tighten(run, tmp_path):
    path = tmp_path / "tiny.json"
    path.write_text('{"total": 0.5, "by": {"worst": {"at_most": 3.0}}, "rows": {"at_least": null}}')
    status, told, _ = run("tiny", "--quick", "--update-expected")
    assert (status, "by / worst" in told) == (1, True)
    assert json.loads(path.read_text()) == {"total": 0.5, "by": {"worst": {"at_most": 1.0}}, "rows": {"at_least": 4.0}}
    assert run("tiny", out="full")[0] == 0  # bounds are of quick runs
    (tmp_path / "alone.json").write_text('{"total": 9.0}')
    assert run("alone", "--quick", "--update-expected")[0] == 0
    assert json.loads((tmp_path / "alone.json").read_text()) == {"total": 9.0}  # of times none is written


@pytest.mark.parametrize(("kind", "bound", "good", "bad"), [
    ("at_most", 0.02, 0.0219, 0.0221), ("at_least", 0.88, 0.81, 0.79), ("at_most", -1.0, -0.95, -0.9),
    ("at_least", -1.0, -1.05, -1.15), ("within", (0.85, 1.15), 1.14, 1.16), ("within", (0.85, 1.15), 0.86, 0.84),
    ("at_most", None, 5.0, None), ("at_most", 0.0, 0.0, math.nan),
])  # fmt: skip
def test_a_bound_allows_a_tenth(kind, bound, good, bad):
    assert Bound("", kind, bound, good).kept
    assert not Bound("", kind, bound, bad).kept


def test_a_bound_becomes_a_better_value_of_four_digits():
    kinds = (("at_most", 5.0), ("at_most", 3.0), ("at_least", 3.0), ("at_least", 5.0), ("within", (3.0, 5.0)))
    assert [Bound("", kind, bound, 4.00004).tighter for kind, bound in kinds] == [4.0, None, 4.0, None, None]


def test_a_bound_whose_figure_is_gone_is_broken(tmp_path):
    path = tmp_path / "tiny.json"
    path.write_text('{"total": 1.0, "other": {"figure": 1.0}, "by": 1.0, "is": 1}')
    found = compare("tiny", {"total": 1.09, "by": math.nan, "is": True}, tmp_path)
    assert [bound.name for bound in found if not bound.kept] == ["other / figure", "by", "is"]
    for wrong in ("{", '{"total": "low"}', '{"total": {"within": [1]}}'):
        path.write_text(wrong)
        with pytest.raises(ConfigError, match=r"tiny\.json"):
            compare("tiny", {}, tmp_path)


# ---------------------------------------------------------------- what a seed takes
def test_what_a_seed_takes_is_counted():
    assert TALLY == opengl.TALLY

    def one(settings, seed):
        subprocess.run(f'printf ... >> "${TALLY}"', shell=True, check=True)  # as drawing does, in any process
        end = time.process_time() + 0.02
        while time.process_time() < end:
            pass
        return [{"seed": 0, "value": np.float32(0.5)}]

    done = perform(one, None, 0)
    assert (done.renders, done.failed) == (3, "")
    assert done.cpu_s >= 0.02
    assert TALLY not in os.environ
    assert "a row holds a set" in perform(lambda *_: [{"seed": {0}}], None, 0).failed


# ---------------------------------------------------------------- workers
@pytest.fixture
def started(tmp_path):
    """The command as a program of its own, with seeds that wait for ever once the others are done."""
    command = [sys.executable, "-m", "tests.support.tiny_experiments", *arguments_of(tmp_path), "--processes", "2"]
    os.mkfifo(tmp_path / "gate")
    programs = []

    def start():
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        programs.append(subprocess.Popen(command, cwd=ROOT, start_new_session=True, env=environment, **pipes))
        return programs[-1]

    yield start
    for program in programs:
        program.kill()
        program.communicate()


def arguments_of(tmp_path):
    return ["tiny", *noted(tmp_path, "tiny"), "--set", "tiny.gated=[2, 3]", "--out", str(tmp_path / "out")]


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


def all_wait(tmp_path):
    until(lambda: len(notes(tmp_path)) == 4, "all four seeds have begun, two of them wait")
    until(lambda: len(list((tmp_path / "out").glob("*/rows/[0-9]*.csv"))) == 2, "two are on disk")


def test_a_killed_run_goes_on_where_it_was(started, tmp_path, capsys):
    program = started()
    all_wait(tmp_path)
    workers = pids(tmp_path)
    program.send_signal(signal.SIGKILL)
    program.wait()
    until(lambda: all(map(is_gone, workers)), "no process outlives the one that started it")
    (tmp_path / "gate").unlink()
    (tmp_path / "gate").write_text("")  # nothing waits any more
    assert main(arguments_of(tmp_path), KNOWN, together=here_together, apart=here) == 0
    assert "python -m experiments:" not in capsys.readouterr().err
    assert sorted(notes(tmp_path)) == ["job 0", "job 1", "job 2", "job 2", "job 3", "job 3"]


def test_ctrl_c_ends_all_processes_in_one_line(started, tmp_path):
    program = started()
    all_wait(tmp_path)
    os.killpg(program.pid, signal.SIGINT)  # as a terminal does: to all processes
    _, complaints = program.communicate(timeout=DEADLINE_S)
    assert program.returncode == 130
    assert complaints.splitlines()[-1].startswith("python -m experiments: interrupted; 2 of 4 seeds are done and kept")
    assert "Traceback" not in complaints
    until(lambda: all(map(is_gone, pids(tmp_path))), "the workers have ended")


def test_the_same_rows_from_dask_a_laboratory_and_a_seed_that_kills_its_workers(tmp_path, capsys):
    import distributed  # not while tests are collected: it takes a second in each process

    arguments = ["tiny", "alone", *noted(tmp_path, "tiny"), "--set", "tiny.fatal=[1]", "--set", "alone.fatal=[2]"]
    assert main([*arguments, "--processes", "2", "--out", str(tmp_path / "dask")], KNOWN, tmp_path) == 1
    complaints = capsys.readouterr().err
    failed = [line.partition("failed: ")[0] for line in complaints.splitlines() if "failed:" in line]
    assert [line.rpartition(", seed ")[2] for line in failed] == ["1 ", "2 "]
    assert notes(tmp_path).count("job 1") == 2  # it is tried once more
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None, env=ONE_THREAD
    ) as laboratory:  # fmt: skip
        (tmp_path / "notes").mkdir()
        arguments = ["tiny", *noted(tmp_path / "notes", "tiny"), "--scheduler", laboratory.scheduler_address]
        assert main([*arguments, "--out", str(tmp_path / "laboratory")], KNOWN, tmp_path) == 0
    assert notes(tmp_path / "notes") == [f"job {seed}" for seed in range(4)]
    command = [sys.executable, "-c", ONLY_HERE, str(tmp_path / "here")]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL, env=os.environ | ONE_THREAD)
    found = [path.parent for out in ("here", "dask", "laboratory") for path in tmp_path.glob(f"{out}/tiny*/rows")]
    for name in ("rows/000000.csv", "rows/000002.csv", "rows/000003.csv"):
        assert len({(folder / name).read_bytes() for folder in found}) == 1
    assert [(folder / "rows" / "000001.csv").exists() for folder in found] == [True, False, True]


ONLY_HERE = """
import sys
from experiments.command import main
from tests.support.tiny_experiments import KNOWN, here, here_together
assert main(["tiny", "--out", sys.argv[1]], KNOWN, together=here_together, apart=here) == 0
"""


def test_nobody_answers(tmp_path, capsys):
    assert main(["tiny", "--out", str(tmp_path)], KNOWN, together=here_together) == 0
    capsys.readouterr()
    status = main(["tiny", "--fresh", "--scheduler", "nowhere", "--out", str(tmp_path)], KNOWN)
    complaints = capsys.readouterr().err
    assert (status, complaints.count("\n"), "nowhere" in complaints) == (1, 1, True)
    assert len(list((tmp_path / "tiny" / "rows").iterdir())) == 4  # nothing is deleted where nothing can be done


# ---------------------------------------------------------------- the real ones
def test_all_experiments_are_found_and_of_one_shape(capsys):
    known = known_experiments()
    assert {"hold", "chain", "fig4_book", "wire", "sim_speed"} <= set(known)
    for name, load in known.items():
        experiment = load()
        assert (experiment.name, bool(experiment.purpose)) == (name, True)
        assert len(experiment.jobs(experiment.quick)) <= len(experiment.jobs(experiment.settings))
        assert experiment.plot is None or experiment.plot.__doc__  # the picture's caption
    assert main(["--list"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(known)


@pytest.mark.parametrize("change", [
    "chain.cases=['nope']", "chain.noise_px=-1", "chain.boards=2", "chain.looks=1", "hold.targets=['cat']",
    "hold.seconds=2", "hold.seconds=20.1", "first_shot.seconds=3.1", "detectors.seconds=2.5", "wire.poll_s=0",
    "depth_error.depths=[1.0]", "depth_error.wrong=-1", "hand_eye.noise_px=0", "hand_eye.poses=2",
    "single_ptz.misses=[0.5, 1.5]", "photos.square=0", "calibration_budget.placements=[2, 6]", "fig4_book.seconds=7",
    "fig4_book.places=3", "fig5_person.seconds=4", "fig6_outdoors.ways=['mine']", "sim_speed.seconds_rendered=0",
    "env_speed.seconds=0.99", "wire.faults=['head.fire']",
])  # fmt: skip
def test_a_setting_that_cannot_be_is_refused_by_name(change):
    key = change.partition("=")[0]
    with pytest.raises(ConfigError, match=key.partition(".")[2]):
        cases(key.partition(".")[0], changes=[change], known=known_experiments())


@pytest.mark.parametrize(("text", "named"), [
    ("def one(\nSETTINGS = 5", "SyntaxError: .*never closed"),
    ("import nowhere\nSETTINGS = 5", "No module named 'nowhere'"),
    ("SETTINGS = 5", "SETTINGS are of a subclass of Settings, not 5"),
    ("from experiments.engine import Settings\nSETTINGS = Settings()", r"no function one\(settings, seed\)"),
    ("one = 5", "it sets no SETTINGS"),
])  # fmt: skip
def test_a_file_that_is_no_experiment_is_named(tmp_path, monkeypatch, capsys, text, named):
    folder = f"sketches_{abs(hash(text))}"  # a new package each time: imports are kept
    for module in ("engine", "command"):
        monkeypatch.setattr(f"experiments.{module}.ROOT", tmp_path)
        monkeypatch.setattr(f"experiments.{module}.FOLDERS", (folder,))
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / folder).mkdir()
    (tmp_path / folder / "rounding.py").write_text(text)
    assert main(["rounding", "--out", str(tmp_path / "out")]) == 1
    assert re.fullmatch(rf"python -m experiments: {folder}/rounding.py: .*{named}.*\n", capsys.readouterr().err)


OURS = "this project"


def figures_of(name):
    return experiment_of(name).summarise([row for job in old_jobs(name) for row in job["rows"]])


@pytest.mark.parametrize(("name", "path", "value", "said"), [
    ("hold", "book/closeup_yield/median", 0.87, "book: closeup_yield"),
    ("first_shot", "book/corrected_width", math.nan, "book: corrected_width"),
    ("delay", "bird/wide view alone/200 ms/times", 2.9, "bird"), ("delay", "bird/closed loop/times", 2.9, "bird"),
    ("five_targets", "person/best over first", 1.4, "person"),
    ("dead_zone", "person/commands_per_min/over", 0.51, "person: commands_per_min"),
    ("env_speed", "images, bird/ratio", 0.79, "images, bird"),
    ("env_score", "cotarget/Schedule-v0 person/chance/mean", 99.0, "cotarget/Schedule-v0 person"),
    ("sim_speed", "loop_over_renderer", 1.16, "loop_over_renderer"),
    ("fig4_book", f"{OURS}/close up/decoded", 0.89, "close up: decoded"),
    ("fig5_person", f"{OURS}/in_frame_ratio/median", 0.98, "in_frame_ratio"),
    ("fig6_outdoors", f"{OURS}/tpo_percent/median", 4.1, "tpo_percent"),
    ("table2_table3", "zoom/fx/bias", -3.1, "zoom: fx: bias"),
    ("calibration_budget", "exponent_noise", 0.7, "exponent_noise"),
    ("depth_error", "pixels/over_first_order/median", 1.13, "pixels"),
    ("models", "seen/regime/offset ignored/to", math.nan, "seen: full model 5 times better than offset ignored"),
    ("pointing", "default/full model/p95_deg/median", 0.0061, "default: p95_deg"),
    ("zoom_range", "steps/ratio", 1.11, "steps: ratio"),
    ("shortcut", "mounted/exact/whole view/all/worst_deg", 2e-6, "exact range"),
    ("single_ptz", "person/lone, misses 5 %/in_frame_ratio", 0.84, "person, lone, misses 5 %"),
    ("sweep_speed", "fitted/rows_that_differ", 1, "fitted"),
])  # fmt: skip
def test_a_figure_off_its_goal_is_missed(name, path, value, said):
    missed, right = experiment_of(name).missed, figures_of(name)
    wrong = node = deepcopy(right)
    *trail, last = path.replace("cotarget/", "cotarget|").split("/")
    for key in trail:
        node = node[key.replace("|", "/")]
    node[last] = value
    more = [text for text in missed(wrong) if text not in missed(right)]
    assert [text.startswith(said) for text in more] == [True]


DRAWN = [name for name in OLD_RESULTS if experiment_of(name).plot and name != "shortcut"]  # of which rows are left out


@pytest.mark.parametrize("name", DRAWN)
def test_a_plot_is_drawn_from_rows(name):
    assert draw(experiment_of(name), [row for job in old_jobs(name) for row in job["rows"]]).startswith(b"\x89PNG")


def test_the_papers_way_has_no_goals():
    for name in ("fig4_book", "fig5_person", "fig6_outdoors"):
        rows = [row for job in old_jobs(name) for row in job["rows"]]
        bad = [{key: 99.0 if isinstance(v, float) else v for key, v in row.items()} for row in rows]
        summary = experiment_of(name).summarise([*rows, *(row | {"way": "as the paper"} for row in bad)])
        assert experiment_of(name).missed(summary) == experiment_of(name).missed(figures_of(name))


def test_a_run_without_a_figure_counts_as_the_worst():
    """A target that is never acquired has the least shares and the largest times and offsets, or no ratio."""
    (row, *_) = [row for job in old_jobs("hold") for row in job["rows"] if row["target"] == "book"]
    never = dict.fromkeys(row) | {"target": "book", "closeup_yield": 0.0}
    most = hold.summarise([row, never, never])["book"]
    assert (most["identification"]["median"], most["time_to_acquire_s"]["median"]) == (0.0, math.inf)
    assert math.isnan(most["identification"]["largest"])
    few = hold.summarise([row, row, never])["book"]
    assert few["identification"]["median"] == row["identification"]
    assert math.isnan(few["time_to_acquire_s"]["largest"])
    run = {"target": "book", "commands_per_min": 9.0, "reversals_per_min": 0.0}
    rows = [run | {"way": "with", "tpo_width_median": None}, run | {"way": "without", "tpo_width_median": 0.02}]
    found = {key: each["over"] for key, each in dead_zone.summarise(rows)["book"].items()}
    assert found["reversals_per_min"] == 1.0  # nothing over nothing
    assert plain(found["tpo_width_median"]) is None
