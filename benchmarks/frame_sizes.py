"""Time and memory of a detector at the frame sizes of today's cameras, and whether it finds a bird of 4 px in them.

The film is made: a textured ground under a sky, a bird that crosses the sky, and ten twigs that sway, with the noise of
a sensor. On each frame, in turns, two things are timed on one thread: `cv2.createBackgroundSubtractorMOG2().apply`
alone, and detect, track and aim. Memory is the rise of a new process' largest resident size, from when it has made its
frames until it has worked on them.
"""

import ctypes
import gc
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.pipeline_speed import MIXTURE, STAGES, Pipeline, mixture
from cotarget.geometry import Array
from cotarget.rig import Frame
from experiments.engine import Count, Row, Settings

SIZES = ((640, 480), (1920, 1080), (3840, 2160))
RATE_HZ = 25.0
NOISE = 2.0  # grey levels
TWIGS = 10
BIRD_PX, BIRD_CONTRAST = 4, 20
# Goals: largest ratio to the subtraction alone at each width, part of the frames with the bird, and memory [MB].
MOST_RATIO = {640: 2.0, 1920: 0.6, 3840: 0.35}
LEAST_FOUND, MOST_MB = 0.9, 300.0


@dataclass(frozen=True)
class FrameSizesSettings(Settings):
    """Settings: passes as seeds, the detector, and frames of a pass, of which the first are not timed."""

    seeds: Count = 1
    detector: str = "auto"
    frames: Count = 75
    untimed: Count = 25


def film(size: tuple[int, int], frames: int, seed: int) -> Iterator[tuple[Frame, Array]]:
    """Draw the frames of an image size [px], with the centre of the bird in each, (2,) [px]."""
    rng = np.random.default_rng((seed, *size))
    width, height = size
    horizon = height // 2
    ground = cv2.resize(rng.normal(0, 1, (height // 8, width // 8)), (width, height - horizon))
    scene = np.full((height, width), 170.0, np.float32)
    scene[horizon:] = 90 + 25 * ground / ground.std()
    # Frames share a few images of noise, shifted: drawing one takes longer than the detector.
    noise = [rng.normal(0, NOISE, (height, width)).astype(np.float32) for _ in range(3)]
    twigs = rng.uniform((0.05 * width, 0.55 * height), (0.95 * width, 0.95 * height), (TWIGS, 2))
    for i in range(frames):
        grey = scene + np.roll(noise[i % 3], 7 * i)
        for k, (u, v) in enumerate(twigs):
            x, y = round(u + 4 * np.sin(0.9 * i + k)), round(v)
            grey[y : y + 8, x : x + 4] = 30
        at = np.array([0.2 * width + i * width / 320, 0.36 * height + i * height / 960])
        x, y = np.rint(at).astype(int).tolist()
        grey[y : y + BIRD_PX, x : x + BIRD_PX] -= BIRD_CONTRAST
        image = cv2.merge([np.clip(grey, 0, 255).astype(np.uint8)] * 3)
        yield Frame(np.asarray(image, dtype=np.uint8), i / RATE_HZ), np.array([x, y]) + (BIRD_PX - 1) / 2


def one(settings: FrameSizesSettings, seed: int) -> list[Row]:
    """Work on a film of each size; give a row for each frame and way, and one for the memory at the largest."""
    rows: list[Row] = []
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for size in SIZES:
            rows += _timed(settings, seed, size)
    finally:
        cv2.setNumThreads(threads)
    code = f"from benchmarks import frame_sizes; frame_sizes.print_memory({settings.detector!r}, {settings.untimed})"
    memory = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    return [*rows, {"seed": seed, "width": SIZES[-1][0], "way": "memory", "mb": float(memory)}]


def _timed(settings: FrameSizesSettings, seed: int, size: tuple[int, int]) -> list[Row]:
    pipeline = Pipeline(settings.detector, size, RATE_HZ)
    rows: list[Row] = []
    ways: list[tuple[str, Callable[[Frame], Row]]] = [(MIXTURE, mixture()), (settings.detector, pipeline)]
    for index, (frame, bird) in enumerate(film(size, settings.frames, seed)):
        for way, work in ways if index % 2 else reversed(ways):
            done = work(frame)
            if way != MIXTURE:
                done["found"] = any(
                    track.confirmed and np.linalg.norm(track.center_px - bird) <= BIRD_PX
                    for track in pipeline.tracker.tracks
                )
            if index >= settings.untimed:
                rows.append({"seed": seed, "width": size[0], "frame": index, "way": way, **done})
    return rows


def print_memory(detector: str, frames: int) -> None:
    """Print the memory that a detector needs for images of the largest size [MB]."""
    shown = [frame for frame, _ in film(SIZES[-1], 4, 0)]
    pipeline = Pipeline(detector, SIZES[-1], RATE_HZ)
    gc.collect()
    ctypes.CDLL("libc.so.6").malloc_trim(0)  # what making the frames has left would be used again
    Path("/proc/self/clear_refs").write_text("5")  # the largest resident size counts from here on
    before = _largest_mb()
    for i in range(frames + 35):  # more than a second, so that the history is full
        pipeline.detector.detect(replace(shown[i % len(shown)], t=i / RATE_HZ))
    print(_largest_mb() - before)


def _largest_mb() -> float:
    """Largest resident size of this process since clear_refs was written [MB], on Linux."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return float(status["VmHWM"].split()[0]) / 1024


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Give for each width the medians [ms], the ratio to the subtraction, and the part of frames with the bird."""
    found: dict[str, dict[str, float]] = {}
    for width in dict.fromkeys(row["width"] for row in rows):
        mine = [row for row in rows if row["width"] == width and row.get("frame") is not None]
        alone = float(np.median([row["ms"] for row in mine if row["way"] == MIXTURE]))
        ours = [row for row in mine if row["way"] != MIXTURE]
        result = {name: float(np.median([row[name] for row in ours])) for name in ("ms", *STAGES)}
        found[str(width)] = {
            "mog2_ms": alone,
            **result,
            "ratio": result["ms"] / alone,
            "found": float(np.mean([row["found"] for row in ours])),
        }
    found["memory"] = {"mb": max(row["mb"] for row in rows if row["way"] == "memory")}
    return found


def missed(summary: Mapping[str, Any]) -> list[str]:
    """List the goals that are not reached."""
    slow = [f"ratio at {width}" for width, most in MOST_RATIO.items() if not summary[str(width)]["ratio"] <= most]
    lost = [f"bird at {SIZES[-1][0]}"] if not summary[str(SIZES[-1][0])]["found"] >= LEAST_FOUND else []
    return [*slow, *lost, *(["memory"] if not summary["memory"]["mb"] <= MOST_MB else [])]


SETTINGS = FrameSizesSettings()
QUICK = replace(SETTINGS, frames=30, untimed=16)
ALONE = True
COST_S = 60.0
