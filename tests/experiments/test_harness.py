"""The experiments' harness, and the synthetic rig's truth against what is worked by hand."""

import contextlib
import csv
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import pipeline_speed
from cotarget.errors import ConfigError
from cotarget.geometry import RigidTransform, pose
from cotarget.video import FilmWriter
from experiments.calibration import photos, random_rigs
from experiments.calibration.synthetic.aims import aimed
from experiments.calibration.synthetic.rig import SIZE, Lens, Stop, Truth, undistorted, with_lever_shifted
from experiments.calibration.synthetic.views import Placing, spread_views, views_at_stops
from experiments.engine.harness import Experiment, Settings
from experiments.engine.texts import rms, table
from tests.support.tiny_experiments import TINY

PHOTOS = Path(__file__).parents[3] / "shared" / "data" / "opencv_stereo"
STILL = RigidTransform.identity()
PLAIN = Lens(500.0, 500.0, 320.0, 240.0)
# Everything in one place, looking along +z.
PLAIN_RIG = Truth(fixed=PLAIN, zoom=PLAIN, gamma=STILL, hand=STILL, dz=0.0, eps=0.0)
ROUNDING = 1e-9
DEADLINE_S = 60.0  # for what should come in some seconds


@dataclass(frozen=True)
class DummySettings(Settings):
    factor: float = 2.0


def shared(settings):
    return "a"


def dummy(extra, settings, seed):
    return [{"seed": seed, "value": settings.factor * seed, "missing": None}, {"seed": seed, "extra": extra}]


def summed(rows):
    return {"sum": sum(row.get("value", 0.0) for row in rows), "nothing": float("nan"), "by": {1: np.float64(2.5)}}


EXPERIMENT = Experiment(
    "dummy",
    "Sums.",
    DummySettings(seeds=4),
    DummySettings(seeds=2),
    dummy,
    summed,
    lambda _, summary: f"sum {summary['sum']}",
    lambda rows, figure: figure.subplots().plot([row.get("value", 0.0) for row in rows]),
    prepare=shared,
)
HERE = replace(EXPERIMENT, alone=True)  # which spares the start of a process


def test_a_run_writes_its_files(tmp_path, capsys):
    out = tmp_path / "new" / "folder"
    assert HERE.main(["--seeds", "3", "--seed-base", "10", "--processes", "1", "--out", str(out)]) == 0
    assert capsys.readouterr().out == "sum 66.0\n"
    result = json.loads((out / "result.json").read_text())
    assert result["settings"] == {"seeds": 3, "seed_base": 10, "processes": 1, "factor": 2.0}
    assert result["summary"] == {"sum": 66.0, "nothing": None, "by": {"1": 2.5}}
    libraries = {"opencv", "numpy", "scipy", "mujoco", "matplotlib", "gymnasium", "av", "opengl"}
    assert set(result["versions"]) == {"cotarget", "python", *libraries}
    rows = list(csv.DictReader((out / "rows.csv").read_text().splitlines()))
    assert [row["seed"] for row in rows] == ["10", "10", "11", "11", "12", "12"]
    assert (rows[0]["value"], rows[0]["extra"], rows[1]["extra"]) == ("20.0", "", "a")
    assert cv2.imread(str(out / "figure.png")) is not None
    assert HERE.main(["--quick", "--processes", "1"]) == 0
    assert capsys.readouterr().out == "sum 2.0\n"


def never(extra, settings, seed):
    raise AssertionError("nothing is run before the arguments are looked at")


UNRUN = replace(HERE, one=never, prepare=None)


@pytest.mark.parametrize(("arguments", "said"), [
    (["--seeds", "0"], "--seeds: '0' is not a whole number from 1"),
    (["--seed-base", "-5"], "--seed-base: '-5' is not a whole number from 0"),
    (["--processes", "0"], "--processes: '0' is not a whole number from 1"),
    (["--nothing"], "unrecognized arguments: --nothing"),
])  # fmt: skip
def test_wrong_arguments_end_in_one_line_before_any_work(capsys, arguments, said):
    with pytest.raises(SystemExit) as caught:
        UNRUN.main(arguments)
    err = capsys.readouterr().err
    assert caught.value.code == 2
    assert said in err
    assert err.startswith("python -m experiments.dummy: ")
    assert err.count("\n") == 1


def test_a_file_in_the_way_of_the_results_is_told_before_any_work(tmp_path, capsys):
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "deeper" / "still"):
        assert UNRUN.main(["--out", str(out)]) == 1
        err = capsys.readouterr().err
        assert (
            err
            == f"experiments.dummy: --out: {tmp_path / 'file'} is no folder; name one that is, or that can be made\n"
        )


def test_an_interrupt_ends_in_one_line(capsys, tmp_path):
    def interrupted(extra, settings, seed):
        raise KeyboardInterrupt

    assert replace(HERE, one=interrupted).main(["--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "experiments.dummy: interrupted\n"
    assert not (tmp_path / "out").exists()


def wrong_once(extra, settings, seed):
    if seed == 1:
        raise ValueError("seed 1\nis wrong")
    return dummy(extra, settings, seed)


def test_a_seed_that_fails_loses_no_other(tmp_path, capsys):
    assert replace(HERE, one=wrong_once).main(["--seeds", "3", "--out", str(tmp_path)]) == 1
    told = capsys.readouterr()
    assert (told.out, told.err) == ("sum 4.0\n", "experiments.dummy: seed 1 failed: ValueError: seed 1 is wrong\n")
    assert json.loads((tmp_path / "result.json").read_text())["summary"]["sum"] == 4.0


def test_a_quick_run_is_not_held_to_what_is_wanted():
    lost = replace(HERE, missed=lambda summary: ["sum"])
    assert [lost.main(given) for given in ([], ["--quick"])] == [1, 0]


def test_help_says_what_quick_means(capsys):
    with pytest.raises(SystemExit):
        EXPERIMENT.main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "how many (4; 2 if quick)" in text
    assert "a look only: seeds 2" in text


WAITS = """
import os, time
from pathlib import Path

def work(_, settings, seed):
    path = Path(__file__).with_name(str(seed))
    path.with_suffix(".new").write_text(str(os.getpid()))
    path.with_suffix(".new").rename(path)
    time.sleep(600)
"""
WAITER = """
import sys
import waits

if __name__ == "__main__":
    from experiments.engine.harness import Experiment, Settings
    experiment = Experiment("waiter", "Waits.", Settings(3), Settings(1), waits.work, dict, str)
    sys.exit(experiment.main(["--processes", "2"]))
"""


@contextlib.contextmanager
def waiter(folder):
    """An experiment in two processes, both at their jobs, which are files to write and then to wait."""
    (folder / "waits.py").write_text(WAITS)
    (folder / "waiter.py").write_text(WAITER)
    paths = f"{Path(__file__).parents[2]}{os.pathsep}{folder}"
    command = [sys.executable, "waiter.py"]
    with subprocess.Popen(
        command, cwd=folder, env=os.environ | {"PYTHONPATH": paths}, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    ) as process:  # fmt: skip
        try:
            deadline = time.monotonic() + DEADLINE_S
            while not all((folder / job).exists() for job in ("0", "1")):
                assert process.poll() is None, process.stderr.read()
                assert time.monotonic() < deadline, "the jobs have not begun"
                time.sleep(0.02)
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # whatever is left of it


def test_an_interrupt_of_all_processes_ends_them_in_one_line(tmp_path):
    """As a terminal sends it: to the whole group; the workers are at their jobs, the last of which has not begun."""
    with waiter(tmp_path) as process:
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=DEADLINE_S)
    assert (process.returncode, out, err) == (130, "", "experiments.waiter: interrupted\n")
    assert not (tmp_path / "2").exists()
    for job in ("0", "1"):
        with pytest.raises(ProcessLookupError):
            os.kill(int((tmp_path / job).read_text()), 0)


def test_workers_end_with_their_parent_however_it_ends(tmp_path):
    """Its pipes are closed only when nobody holds them any more; the jobs would for minutes."""
    with waiter(tmp_path) as process:
        process.kill()
        process.communicate(timeout=DEADLINE_S)
    assert process.returncode == -signal.SIGKILL


def test_a_pipeline_that_is_too_slow_is_missed():
    def rows(motion, target):
        took = {pipeline_speed.ALONE: 4.0, "mog2": 40.0, "motion": motion, "speck": target}
        return [{"way": way, "ms": ms, "aimed": True} for way, ms in took.items()]

    assert pipeline_speed.missed(pipeline_speed.summarise(rows(6.0, 10.0))) == []  # the mixture's own is told, no more
    summary = pipeline_speed.summarise(rows(6.1, 10.1))
    assert pipeline_speed.missed(summary) == ["motion", "speck"]
    assert pipeline_speed.EXPERIMENT.missed is pipeline_speed.missed
    assert "<= 2.5" in pipeline_speed.describe(pipeline_speed.SETTINGS, summary)


def test_a_film_that_is_too_short_is_told_before_any_work(tmp_path, monkeypatch):
    path = tmp_path / "film.mp4"
    with FilmWriter(path, 25.0) as film:
        for number in range(10):
            film.write(np.zeros((48, 64, 3), np.uint8), number / 25)
    monkeypatch.setattr(pipeline_speed, "FILM", path)
    settings = replace(pipeline_speed.SETTINGS, frames=10, untimed=2)
    assert pipeline_speed.needs(settings) == ""
    assert pipeline_speed.needs(replace(settings, frames=11)) == f"needs 11 frames, and {path} has 10"


def test_processes_change_nothing():
    settings = TINY.quick  # seeds 0 and 1
    rows = replace(TINY, prepare=None).run(replace(settings, processes=2))
    assert [row["seed"] for row in rows] == [0, 0, 1, 1]
    assert [row["value"] for row in rows[::2]] == [0.0, 1.0]
    assert str(rows) == str(replace(TINY, prepare=None).run(settings))  # nan is nan


def test_what_is_lacking_or_cannot_be_ends_in_one_line(capsys):
    lacking = replace(UNRUN, needs=lambda settings: "needs the moon")
    assert lacking.main([]) == 1
    assert capsys.readouterr().err == "experiments.dummy: needs the moon\n"
    with pytest.raises(ConfigError, match="seeds = 0: at least 1 is needed"):
        DummySettings(seeds=0)


def test_a_pair_is_left_out_for_each_photo(tmp_path):
    for number in range(3):
        (tmp_path / f"left{number}.jpg").touch()
    settings = replace(photos.SETTINGS, directory=str(tmp_path))
    assert list(photos.jobs(settings)) == [0, 1, 2]
    assert list(photos.jobs(replace(settings, seeds=2))) == [0, 1]
    assert photos.needs(settings) == ""
    assert "which are not part of the project" in photos.needs(replace(settings, directory=str(tmp_path / "none")))


def test_tables_and_rms():
    text = table(("a", "b"), [["x", 1.0], ["long", 123.4], ["y", float("nan")]])
    assert text.splitlines() == ["a        b", "x     1.00", "long   123", "y        -"]
    assert rms([3.0, float("nan"), 4.0]) == pytest.approx(np.sqrt(12.5))
    assert np.isnan(rms([]))


@pytest.mark.parametrize("lens", [
    PLAIN,
    Lens(686.0, 684.0, 325.0, 239.0, (-0.2, 0.05, 0.001, -0.002, 0.01)),
    Lens(686.0, 684.0, 325.0, 239.0, (0.5, 0, 0, 0, 0, 1.0, 0.3, 0)),
    Lens(686.0, 684.0, 325.0, 239.0, (-0.2, 0, 0, 0, 0, 0, 0, 0, 0.003, 0.002, -0.002, 0.001)),
    Lens(686.0, 684.0, 325.0, 239.0, (-0.15, 0.1, 0, 0), fisheye=True),
], ids=["plain", "usual", "rational", "thin prism", "fisheye"])  # fmt: skip
def test_undistorting_is_the_inverse_of_projecting(lens):
    pixels = np.array([[0.0, 0.0], [639.0, 479.0], [320.0, 240.0], [10.0, 400.0]])
    xy = undistorted(pixels, lens)
    assert np.allclose(lens.project(np.c_[xy, np.ones(4)]), pixels, rtol=0, atol=1e-7)
    assert np.allclose(undistorted(pixels[1], lens), xy[1])


def test_an_equidistant_fisheye():
    lens = replace(PLAIN, distortion=(0, 0, 0, 0), fisheye=True)
    assert np.allclose(lens.project([[np.tan(0.3), 0.0, 1.0]]), [[320.0 + 500.0 * 0.3, 240.0]])


def test_where_the_head_stands():
    at, came = np.array([0.2, -0.1]), np.array([0.1, 0.3])
    assert PLAIN_RIG.stands(at, came) == (0.2, -0.1)
    assert np.allclose(replace(PLAIN_RIG, play=0.02).stands(at, came), (0.19, -0.09))  # it lags behind
    assert np.allclose(replace(PLAIN_RIG, play=0.02).stands(at, at), at)
    assert np.allclose(replace(PLAIN_RIG, sag=0.01).stands(np.array([0.0, np.pi / 3])), (0.0, np.pi / 3 + 0.005))
    assert np.allclose(replace(PLAIN_RIG, pan_scale=1.1).stands(at), (0.22, -0.1))
    jittery = replace(PLAIN_RIG, jitter=0.01)
    drawn = np.array([jittery.stands(at, None, np.random.default_rng(i)) for i in range(400)])
    assert np.allclose(drawn.std(axis=0), 0.01, rtol=0.15)  # 400 tell it to 3.5 %
    assert jittery.stands(at) == (0.2, -0.1)


def test_a_lever_that_gives_or_slips():
    x = np.array([[0.0, 0.0, 5.0]])
    giving = replace(PLAIN_RIG, give=(0.0, 0.0, 0.1))
    assert np.allclose(giving.in_zoom(x, 0.0, 0.0), x)
    # Tilted up by 0.2, the camera has moved forward by 0.02 along its own axis.
    tilted = PLAIN_RIG.in_zoom(x, 0.0, 0.2)
    assert np.allclose(giving.in_zoom(x, 0.0, 0.2), tilted - [0.0, 0.0, 0.02])
    slipped = with_lever_shifted(replace(PLAIN_RIG, gamma=pose([-0.4, 0, 0], [0, 0, 0])), (0.0, 0.1, 0.0))
    # The camera is 0.1 lower on a head that stands where it stood.
    assert np.allclose(slipped.in_zoom(x, 0.0, 0.0), [[-0.4, -0.1, 5.0]])


def test_aiming_at_points_one_each():
    x, rays = np.array([[1.0, 0.0, 1.0], [0.0, -1.0, 2.0], [0.0, 0.0, -3.0]]), np.array([0.0, 0.0, 1.0])
    assert np.allclose(np.abs(aimed(PLAIN_RIG, x, rays)[:2]), [[np.pi / 4, 0.0], [0.0, np.arctan(0.5)]])
    x_zoom = Truth().in_zoom(x[:2] * 5, *aimed(Truth(), x[:2] * 5, rays).T)
    assert np.allclose(x_zoom[:, :2] / x_zoom[:, 2:], 0.0, atol=ROUNDING)


def test_boards_are_spread_and_seen():
    points = np.array([[x, y, 0.0] for y in (0.0, 0.5) for x in (0.0, 0.8)])
    placing = Placing(boards=15, looks=3)
    views = spread_views(Truth(), points, np.random.default_rng(0), 0.0, placing)
    assert len(views) == 15 * 4
    for view in views:
        assert ((view.corners_px >= 0) & (view.corners_px <= np.array(SIZE) - 1)).all()
    fixed = np.concatenate([view.corners_px for view in views if view.camera == "fixed"])
    assert (fixed.min(axis=0) < [60, 60]).all()
    assert (fixed.max(axis=0) > [580, 420]).all()
    shape = points + np.array([[0.01], [0.0], [0.0], [0.01]]) * [0.0, 0.0, 1.0]
    bent = spread_views(Truth(), points, np.random.default_rng(0), 0.0, placing, shape=shape)
    assert not np.allclose(bent[0].corners_px, views[0].corners_px, atol=0.01)


def test_a_board_seen_in_part_through_a_longer_lens():
    v, u = np.mgrid[:6, :9]
    x_fixed = np.c_[u.ravel() * 0.1 - 0.4, v.ravel() * 0.1 - 0.25, np.full(54, 5.0)]
    stop = Stop(4000.0, replace(PLAIN, fx=4000.0, fy=4000.0), pupil=0.5)
    views = views_at_stops(replace(PLAIN_RIG, stops=(stop,)), [x_fixed], np.random.default_rng(0), 0.0, looks=4)
    assert views
    for view in views:
        assert view.focal_px == 4000.0
        across = np.diff(view.corners_px.reshape(6, 9, 2)[..., 0], axis=1)
        # 0.1 m at 4.5 m from the pupil, a little stretched by the tilt; not all corners are within 640 px.
        assert np.nanmedian(across) == pytest.approx(4000 * 0.1 / 4.5, rel=0.05)
        assert 12 <= view.seen.sum() < 54


@pytest.mark.slow
def test_random_rigs_are_within_what_is_promised():
    rigs = [random_rigs.draw_rig(np.random.default_rng(i)) for i in range(20)]
    for rig in rigs:
        baseline = np.linalg.norm(rig.truth.gamma.inv().translation)
        assert 0.1 <= baseline <= 10
        assert rig.served >= random_rigs.SERVED
        assert rig.grown == pytest.approx(max(1.0, baseline / 3))
        assert np.linalg.norm(rig.truth.hand.translation) <= 0.3


@pytest.mark.slow
@pytest.mark.skipif(not PHOTOS.is_dir(), reason=f"the real stereo photos are not at {PHOTOS}")
def test_the_real_photos(capsys):
    assert photos.main([str(PHOTOS), "--quick", "--processes", "1"]) == 0
    assert "left13.jpg, right13.jpg" not in capsys.readouterr().out  # two pairs only


def test_no_photos(tmp_path, capsys):
    assert photos.main([str(tmp_path)]) == 1
    assert "no file matches 'left*.jpg'" in capsys.readouterr().err
