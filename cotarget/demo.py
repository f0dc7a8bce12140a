"""Demonstrate the method in simulation: calibrate a rig from rendered boards, then follow three targets.

Calibration, runs and evaluation follow each other, each in its own process, because a world and its renderers need some
400 MB; they hand over files. The process that starts them imports nothing large. A script that calls `run_demo` needs
``if __name__ == "__main__"``.
"""

import dataclasses
import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from cotarget.errors import ConfigError
from cotarget.parallel import Progress, run_apart

if TYPE_CHECKING:
    from cotarget.config import RigConfig

SCENES = {"book": "indoor", "person": "indoor", "bird": "outdoor"}
CALIBRATION_SCENE = "indoor"
# Length of the runs: two seconds to learn the background, then enough to acquire and follow the target [s].
RUN_S = {"book": 8.0, "person": 11.0, "bird": 11.0}
POINTING_TARGETS = 400  # number of targets over which the calibration's pointing error is stated
POINTING_STREAM = 4  # stream of random numbers for these, independent of the world's
FRONT_DEG, BACK_DEG = -62.0, 118.0  # directions of the two pictures of the rig
CALIBRATION = "calibration.json"

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
        calibration = run_apart(_calibrate, (seed, work), progress)
        for name in SCENES:
            run_apart(_follow_one, (name, seed, work), progress)
        metrics = {
            "calibration": calibration,
            "targets": run_apart(_evaluate, (work,), progress),
            "seed": seed,
            "wall_s": round(time.perf_counter() - began, 1),
        }
        (work / "metrics.json").write_text(json.dumps(metrics, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return metrics


def sim_config(scene: str, targets: tuple[str, ...], seed: int) -> "RigConfig":
    """Make the default rig in a scene with targets."""
    from cotarget.config import RigConfig

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
        for left in out.glob(f"{UNFINISHED}*"):  # by a killed run
            if time.time() - left.stat().st_mtime > ABANDONED_S:
                shutil.rmtree(left, ignore_errors=True)
        work = TemporaryDirectory(dir=out, prefix=UNFINISHED)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written to: {error.strerror}; name a folder that can") from None
    with work as folder:
        yield Path(folder)
        for path in sorted(Path(folder).iterdir()):
            path.replace(out / path.name)


def _calibrate(seed: int, work: Path, progress: Progress) -> dict[str, Any]:
    """Calibrate from rendered boards and draw the rig; return the calibration's residuals and its true errors."""
    import numpy as np

    from cotarget.calibration.calibrate import calibrate
    from cotarget.control.controller import reach_of
    from cotarget.drawing import captioned, draw_frames, write_picture
    from cotarget.evaluation import pointing_errors
    from cotarget.safety.safe_rig import guard
    from cotarget.sim.world import SimWorld

    config = sim_config(CALIBRATION_SCENE, (), seed)
    world = SimWorld(config)
    with guard(world.rig, config.safety) as rig:
        calibration = calibrate(
            rig,
            config.board,
            seed=seed,
            progress=lambda done, total, text: progress(done, total, f"calibrating: {text}"),
        )
        calibration.save(work / CALIBRATION)
        rng = np.random.default_rng((seed, POINTING_STREAM))
        errors = np.degrees(pointing_errors(calibration, world.truth(), reach_of(rig), rng, POINTING_TARGETS))
        rig.head.move(0.0, 0.0, wait=True)  # here the zoom camera's frame is zoom0
        front, back = world.portrait(FRONT_DEG, axes=False), world.portrait(BACK_DEG, axes=True)
    panels = [
        captioned(front.image, "the rig: a fixed camera, and a zoom camera on a pan-tilt unit"),
        captioned(
            draw_frames(back.image, back.origins_px),
            "its frames (x red, y green, z blue), Gamma = T_zoom0_fixed and T = T_head_zoom",
        ),
    ]
    write_picture(work / "rig.png", np.hstack(panels))
    residuals = calibration.residuals
    assert residuals is not None
    return {
        "fixed_rms_px": residuals.fixed_rms_px,
        "zoom_rms_px": residuals.zoom_rms_px,
        "stereo_rms_px": residuals.stereo_rms_px,
        "pointing_error_deg": {"median": float(np.median(errors)), "p95": float(np.percentile(errors, 95))},
    }


def _follow_one(name: str, seed: int, work: Path, progress: Progress) -> None:
    """Follow one target; write its rows, its picture and its part of the video."""
    from cotarget.calibration import Calibration
    from cotarget.drawing import TargetStages, side_by_side, write_picture
    from cotarget.evaluation import add_row
    from cotarget.metrics import Row, write_rows
    from cotarget.pipeline import follow
    from cotarget.safety.safe_rig import guard
    from cotarget.sim.world import SimWorld
    from cotarget.video import FilmWriter

    config = sim_config(SCENES[name], (name,), seed)
    target, rate_hz = config.target(name), config.sim.fixed.rate_hz
    calibration = Calibration.load(work / CALIBRATION)
    world = SimWorld(config)
    truth = world.truth()
    rows: list[Row] = []
    with guard(world.rig, config.safety) as rig, FilmWriter(work / f"{name}.mp4", rate_hz) as film:
        stages = TargetStages(rig.zoom.focal_range[0])
        frames = round(RUN_S[name] * rate_hz)
        for step in follow(rig, calibration, target, seconds=RUN_S[name]):
            stages.see(step)
            add_row(rows, step, truth, name, target)
            film.write(side_by_side(step, name, step.fixed.t), step.fixed.t)
            progress(min(step.index + 1, frames), frames, f"following: {name}")
    write_picture(work / f"{name}.png", stages.picture(name))
    write_rows(work / f"{name}.csv", rows)


def _evaluate(work: Path, progress: Progress) -> dict[str, Any]:
    """Join the runs' rows and films, plot them, and return the targets' scores."""
    from cotarget.drawing import plot_aim_error
    from cotarget.metrics import read_rows, score, write_rows
    from cotarget.video import join_films

    tables, films = ([work / f"{name}.{suffix}" for name in SCENES] for suffix in ("csv", "mp4"))
    runs = dict(zip(SCENES, map(read_rows, tables), strict=True))
    write_rows(work / "steps.csv", [row for run in runs.values() for row in run])
    join_films(films, work / "demo.mp4")
    plot_aim_error(work / "aim_error.png", runs)
    for part in (*tables, *films):
        part.unlink()
    return {name: dataclasses.asdict(score(run)) for name, run in runs.items()}


# Figures of a target in the summary, with their formats.
SUMMARY = {
    "time_to_acquire_s": ".2f",
    "in_frame_ratio": ".2f",
    "closeup_yield": ".2f",
    "centred_yield": ".2f",
    "tpo_width_median": ".1%",
    "size_ratio_median": ".2f",
    "range_m": ".1f",
}


def summary(metrics: dict[str, Any]) -> str:
    """Format the figures as a short table."""
    pointing = metrics["calibration"]["pointing_error_deg"]
    lines = [
        f"pointing error of the calibration: median {pointing['median']:.4f}, p95 {pointing['p95']:.4f} degrees",
        f"{'target':8} {'acquired':>9} {'in frame':>9} {'yield':>6} {'centred':>8}"
        f" {'offset':>8} {'size':>6} {'range':>8}",
    ]
    for name, scores in metrics["targets"].items():
        acquired, in_frame, good, centred, offset, size, range_m = (
            "-" if scores.get(key) is None else format(scores[key], form) for key, form in SUMMARY.items()
        )
        shares = f"{in_frame:>9} {good:>6} {centred:>8}"
        lines.append(f"{name:8} {acquired:>7} s {shares} {offset:>8} {size:>6} {range_m:>6} m")
    return "\n".join(lines)
