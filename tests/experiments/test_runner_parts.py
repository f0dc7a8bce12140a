"""What sweeps are made of: who knows which code gave a row, what is counted, what cannot be asked for."""

import builtins
import functools
import json
import multiprocessing
import os
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import experiments
from benchmarks import sweep_speed
from cotarget.errors import ConfigError
from cotarget.sim.render import opengl
from experiments.__main__ import INTERRUPTED
from experiments.__main__ import main as entry
from experiments.engine import harness, tasks
from experiments.engine.bounds import compare
from experiments.engine.cases import choose, known_experiments
from experiments.engine.results import NO_ROWS, differing, fingerprint
from experiments.engine.sessions import Log, Share, sessions
from experiments.engine.tasks import Task, perform
from experiments.engine.versions import OPENGL, versions
from experiments.engine.workers import ONE_THREAD, in_turn
from experiments.following import delay, hold


def test_ctrl_c_is_told_in_one_line_while_the_experiments_load(monkeypatch, capsys):
    load = builtins.__import__

    def interrupted(name, *more, **options):
        if name == "experiments.engine.command":
            raise KeyboardInterrupt
        return load(name, *more, **options)

    monkeypatch.setattr(builtins, "__import__", interrupted)
    assert entry() == INTERRUPTED == harness.INTERRUPTED
    assert capsys.readouterr() == ("", "python -m experiments: interrupted\n")


def test_rows_are_of_the_code_that_was_loaded(monkeypatch):
    old, new = "0.1.0+aaaa.llll", "0.1.0+bbbb.llll"
    now = [old]
    monkeypatch.setattr(tasks, "code_version", lambda: old)
    monkeypatch.setattr(tasks, "_fingerprint_with", functools.cache(lambda modules: now[0]))

    def edited():
        now[0] = new
        return []

    def loading():
        monkeypatch.setitem(sys.modules, "one_that_was_not_there", types.ModuleType("one_that_was_not_there"))
        return []

    assert perform(Task(0, 0, list)).version == old
    assert perform(Task(0, 0, edited)).version == old  # nothing new was loaded
    mixed = perform(Task(0, 0, loading)).version
    assert mixed == f"{old} and {new}"
    assert differing(mixed, old) == differing(mixed, new) == "code"


def test_what_two_versions_differ_in():
    one = "0.1.0+aaaa.llll"
    others = ("0.1.0+aaaa.llll", "0.1.0+aaaa.mmmm", "0.1.0+bbbb.mmmm", "0.2.0+aaaa.llll", "0.1.0+12345678")
    assert [differing(one, other) for other in others] == ["", "libraries", "code", "version", "code"]


def test_only_what_rows_depend_on_makes_other_code(tmp_path, monkeypatch):
    assert all((Path(experiments.__file__).parent / f"{name}.py").exists() for name in NO_ROWS)
    monkeypatch.setattr(experiments, "__file__", str(tmp_path / "__init__.py"))
    for name in ("following/hold", "engine/report"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / f"{name}.py").write_text("")
    before = fingerprint()
    (tmp_path / "engine/report.py").write_text("# told better")
    assert fingerprint() == before
    (tmp_path / "following/hold.py").write_text("# other rows")
    assert differing(fingerprint(), before) == "code"


def test_pictures_of_other_processes_count_too():
    assert tasks.TALLY == opengl.TALLY

    def call():
        subprocess.run(f'printf ... >> "${opengl.TALLY}"', shell=True, check=True)  # as drawing does
        return []

    assert perform(Task(0, 0, call)).renders == 3
    assert opengl.TALLY not in os.environ


def test_a_session_that_is_killed_has_left_word(tmp_path, monkeypatch):
    log = Log(tmp_path, "somebody")
    log.add("tiny", Share(1, 2.0, 0.0, 3))
    assert sessions(tmp_path) == []  # so soon
    monkeypatch.setattr("experiments.engine.sessions.OFTEN_S", 0.0)
    log.add("tiny", Share(0, 0.0, 4.0, 5))
    (told,) = sessions(tmp_path)
    assert told.cases == {"tiny": Share(1, 2.0, 4.0, 8)}


@pytest.mark.render
def test_each_picture_is_tallied(tmp_path, monkeypatch):
    monkeypatch.setenv(opengl.TALLY, str(tmp_path / "tally"))
    model = opengl.mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    canvas, before = opengl.Canvas(model, (8, 8), shadows=False), opengl.Canvas.drawn
    for _ in range(2):
        canvas.draw(np.zeros(3), np.eye(3), (-1.0, 1.0, -1.0, 1.0), (8, 8))
    canvas.close()
    assert (tmp_path / "tally").stat().st_size == opengl.Canvas.drawn - before == 2
    monkeypatch.delenv(OPENGL, raising=False)
    assert versions()["opengl"] == opengl.renderer_version() != ""
    monkeypatch.setenv(OPENGL, "another")  # as where a process is told by the one that starts it
    assert versions()["opengl"] == "another"


def as_it_is(_):
    return multiprocessing.current_process().daemon, [os.environ.get(name) for name in ONE_THREAD]


@pytest.mark.slow
def test_timings_may_start_processes_and_take_all_cores(monkeypatch):
    for name in ONE_THREAD:
        monkeypatch.delenv(name, raising=False)
    assert dict(in_turn(as_it_is, [0])) == {0: (False, [None] * len(ONE_THREAD))}


IN_THE_FIELD = (
    *("hold", "first_shot", "delay", "five_targets", "dead_zone", "sim_speed"),
    *("detectors", "single_ptz", "env_score", "env_speed"),
)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("chain.cases=['nope']", "chain.cases: 'nope' is not one of: default rig"),
        ("chain.noise_px=-1", "chain.noise_px: -1 is below 0"),
        ("chain.cases=[]", "chain.cases: is empty; at least one is needed"),
        ("hold.targets=['cat']", "hold.targets: 'cat' is not one of: bird, book, person"),
        ("env_speed.targets=['cat']", "env_speed.targets: 'cat' is not one of: bird, book, person"),
        ("wire.poll_s=0", "wire.poll_s: lasts no time"),
        *(
            (f"{name}.{key}=20.1", f"{key}: 20.1 is above 20, up to which there are ways to go")
            for name, key in (
                *((name, "seconds") for name in IN_THE_FIELD),
                ("sim_speed", "seconds_rendered"),
                ("env_speed", "seconds_seen"),
            )
        ),
        ("depth_error.wrong=0", "wrong: 0 is no error; give one above -1 that is not 0"),
        ("hand_eye.noise_px=0", "noise_px: 0 is not above 0"),
        ("hand_eye.poses=2", "poses: 2 is below 3"),
        ("pipeline_speed.untimed=300", "untimed: 300 is not below frames = 300, so that none is timed"),
        ("pipeline_speed.frames=60", "untimed: 60 is not below frames = 60, so that none is timed"),
        ("single_ptz.misses=[0.5, 1.5]", "misses: 1.5 is no part of the frames, which is 0 to 1"),
        ("photos.square=0", "square: 0 is not above 0"),
        ("photos.columns=2", "columns: 2 is below 3"),
        ("speed.pairs=2", "pairs: 2 is below 3"),
        *((f"{name}.boards=2", "boards: 2 is below 3") for name in ("chain", "honesty", "models")),
        *((f"{name}.looks=1", "looks: 1 is below 2") for name in ("chain", "honesty", "models", "calibration_budget")),
        ("calibration_budget.placements=[2, 6]", "placements: 2 is below 3"),
        ("fig4_book.seconds=7", "seconds: 7 is above 6.8, up to which there are ways to go"),
        ("hold.seconds=2", "seconds: 2 is not above 2"),
        ("first_shot.seconds=3.1", "seconds: 3.1 is not above 3.12"),
        ("sim_speed.seconds_rendered=0", "seconds_rendered: 0 is not above 0"),
        ("fig6_outdoors.seconds=2", "seconds: 2 is not above 2"),
        ("detectors.seconds=2.5", "seconds: 2.5 is not above 3"),
        ("env_speed.seconds=0.99", "seconds: 0.99 is below 1"),
        ("env_speed.seconds_seen=0", "seconds_seen: 0 is not above 0"),
        ("env_score.seconds=0", "seconds: 0 is not above 0"),
        ("wire.faults=['head.fire']", "faults: 'head.fire' is not one of: "),
        ("random_rigs.boards=0", "random_rigs.boards: 0 is below 1"),
        ("hold.processes=2", "say --processes"),
    ],
)
def test_what_cannot_be_is_told_before_any_work(change, said):
    name = change.partition(".")[0]
    with pytest.raises(ConfigError, match=said.replace("[", r"\[")):
        choose(known_experiments(), [name], changes=[change])


def test_what_can_be_is_taken():
    changes = ["depth_error.wrong=-0.05", "delay.delays=[0.0, 0.2]", "fig5_person.detector=motion"]
    cases = choose(known_experiments(), ["depth_error", "delay", "fig5_person"], seed_base=0, changes=changes)
    assert [case.changes[0].partition("=")[0] for case in cases] == ["wrong", "delays", "detector"]
    as_long_as_there_are_ways = [
        *(f"{name}.seconds=20" for name in IN_THE_FIELD),
        *("fig4_book.seconds=6.8", "fig5_person.seconds=60", "fig6_outdoors.seconds=60"),
    ]
    names = [change.partition(".")[0] for change in as_long_as_there_are_ways]
    assert len(choose(known_experiments(), names, changes=as_long_as_there_are_ways)) == len(names)


def test_experiments_in_the_field_share_one_calibration():
    shared = hold.EXPERIMENT.shares(hold.EXPERIMENT.settings)
    assert delay.EXPERIMENT.shares(delay.EXPERIMENT.settings) == shared
    other = replace(delay.EXPERIMENT.settings, seed_base=100)
    assert delay.EXPERIMENT.shares(other) != shared


def test_rows_that_differ_are_counted_and_bounded(monkeypatch):
    def drifting(work, jobs, processes):
        yield from ((i, [{"value": processes if i == 1 else 0}]) for i in range(len(jobs)))

    settings = sweep_speed.EXPERIMENT.quick
    monkeypatch.setattr(sweep_speed, "in_processes", drifting)
    summary = sweep_speed.summarise(sweep_speed.one(None, settings, 0))
    assert {sweep: found["rows_that_differ"] for sweep, found in summary.items()} == {"fitted": 1, "rendered": 1}
    assert len([each for each in compare(sweep_speed.EXPERIMENT, summary) if not each.kept]) == 2
    assert [text for text in sweep_speed.missed(summary) if "rows differ" in text] == [
        "fitted: rows differ", "rendered: rows differ"
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.render
def test_the_same_rows_from_another_number_of_processes():
    """Of jobs that fit and of jobs that render."""
    settings = replace(sweep_speed.EXPERIMENT.quick, jobs=3)
    assert len(json.dumps(sweep_speed.rendered(settings, 0))) > 100  # there is something to differ
    summary = sweep_speed.summarise(sweep_speed.one(None, settings, 0))
    bounds = compare(sweep_speed.EXPERIMENT, summary)
    assert [(each.name, each.kept) for each in bounds] == [
        ("fitted / rows_that_differ", True), ("rendered / rows_that_differ", True)
    ]  # fmt: skip
