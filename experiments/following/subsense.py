"""Real films with labels: the detector beside SuBSENSE (St-Charles et al. 2015), as `films` has it beside the mixtures.

SuBSENSE is that of bgslibrary, which PyPI has as a source package for Debian's OpenCV: `apt install libopencv-dev g++`,
and `pip install -e '.[experiments]' bgslibrary` in an environment of its own. It computes three frames a second, so
that every fifth film by name is searched. It takes its settings from a file in the working directory, which is written
here.
"""

import contextlib
import importlib.util
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cotarget.rig import Image
from experiments.engine import Count, Row
from experiments.following import films
from experiments.following.films import (
    FilmsSettings,
    detector_tracks,
    foreground_tracks,
    labelled_film,
    missed,
    plot,
    summarise,
)

__all__ = ["missed", "plot", "summarise"]
WAY, EVERY = "SuBSENSE", 5
CONFIG = """<?xml version="1.0"?>
<opencv_storage><fRelLBSPThreshold>0.333</fRelLBSPThreshold><nDescDistThresholdOffset>3</nDescDistThresholdOffset>
<nMinColorDistThreshold>{threshold:g}</nMinColorDistThreshold><nBGSamples>50</nBGSamples>
<nRequiredBGSamples>2</nRequiredBGSamples><nSamplesForMovingAvgs>100</nSamplesForMovingAvgs>
<showOutput>0</showOutput></opencv_storage>
"""


@dataclass(frozen=True)
class SubsenseSettings(FilmsSettings):
    """Settings: as those of `films`, with SuBSENSE's least difference of colour as thresholds; 30 is its default."""

    seeds: Count = 10
    thresholds: tuple[float, ...] = (15.0, 30.0)  # [grey levels]


def needs(settings: SubsenseSettings) -> str:
    """Describe what is missing to run; empty if nothing."""
    if importlib.util.find_spec("pybgs") is None:
        return "needs bgslibrary, in an environment of its own"
    return films.needs(settings)


def jobs(settings: SubsenseSettings) -> Sequence[int]:
    """Give the films' numbers; one where there is no film."""
    return range(1 if needs(settings) else min(settings.seeds, len(films.films(settings)[::EVERY])))


def one(settings: SubsenseSettings, number: int) -> list[Row]:
    """Search a film in both ways; give a row for each threshold."""
    film = labelled_film(*films.films(settings)[::EVERY][number])
    found = detector_tracks(settings.detector, settings.scores, film.frames, film.rate_hz)
    rows = [film.row(settings.detector, least, 0, tracks) for least, tracks in found.items()]
    for threshold in settings.thresholds:
        for area, tracks in foreground_tracks(subsense(threshold), settings.areas_px, film.frames).items():
            rows.append(film.row(WAY, threshold, area, tracks))
    return [{"seed": number, **row} for row in rows]


def subsense(threshold: float) -> Callable[[Image], Image]:
    """Make SuBSENSE with a least difference of colour [grey levels]; it gives each image's foreground, 0 or 255."""
    import pybgs

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        path = Path("config", f"{WAY}.xml")
        path.parent.mkdir()
        path.write_text(CONFIG.format(threshold=threshold))
        model = pybgs.SuBSENSE()
    return lambda image: np.asarray(model.apply(image), dtype=np.uint8)


SETTINGS = SubsenseSettings()
QUICK = replace(SETTINGS, seeds=1, thresholds=(30.0,))
COST_S = 240.0
