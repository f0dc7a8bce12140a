"""Demonstrate the method in simulation: calibrate a rig from rendered boards, then follow three targets.

The software knows nothing of the simulated rig but what it measures. Calibration and runs come one after the other,
each in a process of its own, because a world and its renderers need some 300 MB. So a script that calls `run_demo`
needs ``if __name__ == "__main__"``.
"""

import dataclasses
import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from cotarget.calibration import Calibration, save_calibration
from cotarget.calibration.calibrate import calibrate
from cotarget.config import RigConfig
from cotarget.control.controller import reach_of
from cotarget.detection import make_detector
from cotarget.drawing import TargetStages, captioned, draw_frames, plot_aim_error, side_by_side, write_picture
from cotarget.errors import ConfigError
from cotarget.evaluation import add_row, pointing_errors
from cotarget.metrics import Row, Score, score, write_rows
from cotarget.parallel import Progress, run_apart
from cotarget.pipeline import FollowSettings, follow
from cotarget.safety.safe_rig import guard
from cotarget.sim.world import SimWorld
from cotarget.video import FilmWriter, join_films

SCENES = {"book": "indoor", "person": "indoor", "bird": "outdoor"}
CALIBRATION_SCENE = "indoor"
# Length of the runs: two seconds to learn the background, then enough to acquire and follow the target [s].
RUN_S = {"book": 8.0, "person": 11.0, "bird": 11.0}
# Number of targets over which the pointing error of the calibration is stated.
POINTING_TARGETS = 400
POINTING_STREAM = 4  # stream of random numbers for these, independent of the world's
FRONT_DEG, BACK_DEG = -62.0, 118.0  # directions of the two pictures of the rig

UNFINISHED = ".unfinished-"  # prefix of the folder in which a run works
ABANDONED_S = 3600.0  # age from which such a folder is taken to be left by a killed run


def run_demo(out: Path, seed: int, progress: Progress) -> dict[str, Any]:
    """Calibrate a simulated rig from rendered boards, follow a book, a person and a bird, and write the results.

    Args:
        out: folder for pictures, video, tables and metrics.json; its files are replaced only when all is done.
        seed: seed of everything random.
        progress: called with (done, total, what).

    Returns:
        The content of metrics.json.
    """
    began = time.perf_counter()
    with finished_together(out) as work:
        config = sim_config(CALIBRATION_SCENE, (), seed)
        calibration, pointing = run_apart(_calibrate, (config, work, seed), progress)
        rows = {name: run_apart(_follow_one, (name, seed, calibration, work), progress) for name in SCENES}
        write_rows(work / "steps.csv", [row for run in rows.values() for row in run])
        parts = [work / f"{name}.mp4" for name in SCENES]
        join_films(parts, work / "demo.mp4")
        for part in parts:
            part.unlink()
        plot_aim_error(work / "aim_error.png", rows)
        residuals = calibration.residuals
        assert residuals is not None
        metrics = {
            "calibration": {
                "fixed_rms_px": residuals.fixed_rms_px,
                "zoom_rms_px": residuals.zoom_rms_px,
                "stereo_rms_px": residuals.stereo_rms_px,
                "pointing_error_deg": pointing,
            },
            "targets": {name: dataclasses.asdict(score(run)) for name, run in rows.items()},
            "seed": seed,
            "wall_s": round(time.perf_counter() - began, 1),
        }
        (work / "metrics.json").write_text(json.dumps(metrics, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return metrics


def sim_config(scene: str, targets: tuple[str, ...], seed: int) -> RigConfig:
    """Make the default rig in a scene with targets."""
    config = RigConfig()
    return dataclasses.replace(config, sim=dataclasses.replace(config.sim, scene=scene, targets=targets, seed=seed))


@contextmanager
def finished_together(out: Path) -> Iterator[Path]:
    """Yield a folder to work in; its files move to ``out`` only when the block ends without an error.

    Raises:
        ConfigError: ``out`` cannot be a folder.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        for left in out.glob(f"{UNFINISHED}*"):
            if time.time() - left.stat().st_mtime > ABANDONED_S:
                shutil.rmtree(left, ignore_errors=True)
        work = TemporaryDirectory(dir=out, prefix=UNFINISHED)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written to: {error.strerror}; name a folder that can") from None
    with work as folder:
        yield Path(folder)
        for path in sorted(Path(folder).iterdir()):
            path.replace(out / path.name)


def _calibrate(config: RigConfig, work: Path, seed: int, progress: Progress) -> tuple[Calibration, dict[str, float]]:
    """Calibrate from rendered boards, evaluate the calibration by the ground truth, and draw the rig."""
    world = SimWorld(config)
    with guard(world.rig, config.safety) as rig:
        calibration = calibrate(
            rig,
            config.board,
            seed=seed,
            progress=lambda done, total, text: progress(done, total, f"calibrating: {text}"),
        )
        save_calibration(work / "calibration.json", calibration)
        errors = np.degrees(
            pointing_errors(
                calibration,
                world.truth(),
                reach_of(rig),
                np.random.default_rng((seed, POINTING_STREAM)),
                POINTING_TARGETS,
            )
        )
        rig.head.move(0.0, 0.0, wait=True)  # here the zoom camera's frame is zoom0
        front, back = world.portrait(FRONT_DEG, axes=False), world.portrait(BACK_DEG, axes=True)
        picture = np.hstack(
            [
                captioned(front.image, "the rig: a fixed camera, and a zoom camera on a pan-tilt unit"),
                captioned(
                    draw_frames(back.image, back.origins_px),
                    "its frames (x red, y green, z blue), Gamma = T_zoom0_fixed and T = T_head_zoom",
                ),
            ]
        )
        write_picture(work / "rig.png", picture)
    return calibration, {"median": float(np.median(errors)), "p95": float(np.percentile(errors, 95))}


def _follow_one(name: str, seed: int, calibration: Calibration, work: Path, progress: Progress) -> list[Row]:
    """Follow one target; write its picture and its part of the video, and return its rows."""
    config = sim_config(SCENES[name], (name,), seed)
    target, rate_hz = config.target(name), config.sim.fixed.rate_hz
    world = SimWorld(config, ahead=False)  # rendering ahead takes another 200 MB
    truth = world.truth()
    rows: list[Row] = []
    with guard(world.rig, config.safety) as rig, FilmWriter(work / f"{name}.mp4", rate_hz) as film:
        stages = TargetStages(rig.zoom.focal_range[0])
        detector = make_detector(target, rate_hz)
        settings = FollowSettings()
        frames = round(RUN_S[name] * rate_hz)
        for step in follow(rig, calibration, target, detector, seconds=RUN_S[name], settings=settings):
            stages.see(step)
            add_row(rows, step, truth, name, target)
            film.write(side_by_side(step, name, step.fixed.t), step.fixed.t)
            progress(min(step.index + 1, frames), frames, f"following: {name}")
    write_picture(work / f"{name}.png", stages.picture(name))
    return rows


def summary(metrics: dict[str, Any]) -> str:
    """Format the figures as a short table."""
    pointing = metrics["calibration"]["pointing_error_deg"]
    lines = [
        f"pointing error of the calibration: median {pointing['median']:.4f}, p95 {pointing['p95']:.4f} degrees",
        f"{'target':8} {'acquired':>9} {'in frame':>9} {'yield':>6} {'offset':>8} {'size':>6} {'range':>8}",
    ]
    for name, values in metrics["targets"].items():
        s = Score(**values)

        def cell(value: float | None, form: str) -> str:
            return "-" if value is None else format(value, form)

        lines.append(
            f"{name:8} {cell(s.time_to_acquire_s, '.2f'):>7} s {cell(s.in_frame_ratio, '.2f'):>9} "
            f"{cell(s.closeup_yield, '.2f'):>6} {cell(s.tpo_width_median, '.1%'):>8} "
            f"{cell(s.size_ratio_median, '.2f'):>6} {cell(s.range_m, '.1f'):>6} m"
        )
    return "\n".join(lines)
