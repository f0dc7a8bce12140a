"""Writes what a run did: a table of its Steps, and a recording of all that its rig saw and was told."""

import contextlib
import dataclasses
import json
import math
import platform
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from cotarget import __version__
from cotarget.config import RigConfig
from cotarget.errors import ConfigError, CotargetError
from cotarget.loop import Step
from cotarget.outputs import CsvFile
from cotarget.recordformat import (
    CALIBRATION,
    COMPLETE,
    FIXED,
    LOG,
    META,
    SCHEMA,
    TEMPLATE,
    ZOOM,
    config_table,
)
from cotarget.recordingrig import RecordingRig
from cotarget.recordwriter import RecordWriter
from cotarget.rig import Rig
from cotarget.whom import ANYBODY, Whom, whom_table

COLUMNS = (
    "index", "t_s", "t_fixed_s", "t_zoom_s", "state", "reason", "track", "u_px", "v_px", "width_px", "height_px",
    "depth_m", "range_m", "pan_commanded_deg", "tilt_commanded_deg", "focal_commanded_px", "pan_deg", "tilt_deg",
    "focal_px",
)  # fmt: skip


class StepTable:
    """A table of Steps, one line each; appears under its name only when complete. A context manager."""

    def __init__(self, path: Path | None, *, keep: bool = False) -> None:
        """Prepare to write to ``path``, or nowhere.

        Args:
            path: the file.
            keep: whether the Steps so far are kept where the block ends in an error.

        Raises:
            ConfigError: the file cannot be written.
        """
        self._file = None if path is None else CsvFile(path, COLUMNS, keep=keep)

    def write(self, step: Step) -> None:
        """Append a line.

        Raises:
            ConfigError: the disk is full.
        """
        if self._file is None:
            return
        track, aim, (pan, tilt, focal) = step.target, step.aim, step.commanded
        box = ["", "", "", "", ""] if track is None else [track.id, *track.center_px, *track.size_px]
        row = (
            [step.index, step.t, step.fixed.t, step.zoom.t, step.state, step.reason, *box]
            + (["", ""] if aim is None else [aim.depth, aim.range])
            + [math.degrees(pan), math.degrees(tilt), focal]
            + [math.degrees(step.head.pan), math.degrees(step.head.tilt), step.lens.focal_px]
        )
        self._file.write(cell + 0.0 if isinstance(cell, float) else cell for cell in row)  # no -0.0

    def __enter__(self) -> "StepTable":
        """Give the table itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete the file and give it its name; after an error, remove it or keep what there is.

        Raises:
            ConfigError: the file could not be completed, as on a full disk.
        """
        if self._file is not None:
            self._file.__exit__(kind, error, trace)


class Recorder:
    """Records a run into a folder, so that `cotarget.replay` can open it as a rig. A context manager.

    Wrap the rig below the safety layer and close it before the recorder:

        with Recorder(folder, config, calibration, target) as recorder:
            with SafeRig(recorder.wrap(open_rig(config)), config.safety) as rig:
                ...
    """

    def __init__(
        self, directory: Path, config: RigConfig, calibration: Path, target: str, whom: Whom = ANYBODY
    ) -> None:
        """Make the folder and write down what the run begins with.

        Args:
            directory: the recording's; it must not exist yet, or be empty.
            config: of the rig; passwords in it are not recorded.
            calibration: calibration.json, of which the recording gets a copy.
            target: name of the target that will be followed.
            whom: which one, where there are several.

        Raises:
            ConfigError: the folder is not empty, something cannot be read or written, or there is no such target.
        """
        self._directory = directory
        self._wrapped = False
        try:
            self._made = not directory.exists()
            directory.mkdir(parents=True, exist_ok=True)
            if any(directory.iterdir()):
                raise ConfigError(f"{directory}: is not empty; give a new folder for the recording")
        except OSError as error:
            raise ConfigError(f"{directory}: cannot hold a recording: {error.strerror}") from None
        try:
            self._write_beginning(config, calibration, target, whom)
            self._writer = RecordWriter(directory)
        except BaseException as error:
            self._remove()
            if isinstance(error, OSError):
                raise ConfigError(f"{error.filename or directory}: cannot be recorded: {error.strerror}") from None
            raise

    @property
    def dropped(self) -> int:
        """Images of the zoom camera that were left out so far, because the disk was too slow."""
        return self._writer.dropped

    @property
    def waiting(self) -> int:
        """Answers of the rig that are still on their way to the disk; a crash would lose these and no others."""
        return self._writer.waiting

    def wrap(self, rig: Rig) -> Rig:
        """Give a rig that records; one a recording. The rig is closed with it, and at once if this fails."""
        assert not self._wrapped, "a recording is of one rig"
        self._wrapped = True
        return RecordingRig(rig, self._writer)

    def __enter__(self) -> "Recorder":
        """Give the recorder itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write what still waits and how the run ended; remove a recording of a rig that was never opened.

        Raises:
            CotargetError: the recording is not complete, as on a full disk.
        """
        ending = COMPLETE if kind is None else f"{kind.__name__}: {error}".removesuffix(": ")
        self._writer.put({"end": ending, "dropped": self._writer.dropped})
        self._writer.close()
        if not self._wrapped:
            self._remove()
        elif self._writer.failure and kind is None:
            raise CotargetError(f"{self._directory}: the recording is cut short: {self._writer.failure}")

    def _write_beginning(self, config: RigConfig, calibration: Path, target: str, whom: Whom) -> None:
        chosen = config.target(target)
        if chosen.template is not None:
            copy = TEMPLATE + chosen.template.suffix
            (self._directory / copy).write_bytes(chosen.template.read_bytes())
            chosen = dataclasses.replace(chosen, template=Path(copy))
        # By hand: where the disk is full shutil's copy blames the file that it reads.
        (self._directory / CALIBRATION).write_bytes(calibration.read_bytes())
        table = {
            "schema": SCHEMA,
            "cotarget": __version__,
            "python": platform.python_version(),
            "machine": platform.machine(),
            "opencv": cv2.__version__,
            "numpy": np.__version__,
            "when": datetime.now(UTC).isoformat(timespec="seconds"),
            "target": target,
            "whom": whom_table(whom),
            "config": config_table(dataclasses.replace(config, targets={**config.targets, target: chosen})),
        }
        part = self._directory / f"{META}.part"
        part.write_text(json.dumps(table, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        part.replace(self._directory / META)

    def _remove(self) -> None:
        """Take away what was made: nothing in it can be replayed, and it would be in the way of the next try."""
        for folder in (FIXED, ZOOM):
            with contextlib.suppress(OSError):
                (self._directory / folder).rmdir()
        for path in self._directory.iterdir():
            if path.name in (META, f"{META}.part", LOG, CALIBRATION) or path.stem == TEMPLATE:
                path.unlink(missing_ok=True)
        if self._made:
            with contextlib.suppress(OSError):
                self._directory.rmdir()
