"""Writes what a run of Steps did."""

import csv
import math
from pathlib import Path
from types import TracebackType

from cotarget.errors import ConfigError
from cotarget.loop import Step

COLUMNS = (
    "index", "t_s", "t_fixed_s", "t_zoom_s", "state", "reason", "track", "u_px", "v_px", "width_px", "height_px",
    "depth_m", "range_m", "pan_commanded_deg", "tilt_commanded_deg", "focal_commanded_px", "pan_deg", "tilt_deg",
    "focal_px",
)  # fmt: skip


class StepTable:
    """A table of Steps, one line each; appears under its name only when complete. A context manager."""

    def __init__(self, path: Path | None) -> None:
        """Prepare to write to ``path``, or nowhere.

        Raises:
            ConfigError: the file cannot be written.
        """
        self._path = path
        if path is None:
            return
        self._part = path.with_name(f".{path.name}.part")
        try:
            self._file = self._part.open("w", newline="", encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None
        self._writer = csv.writer(self._file)
        self._writer.writerow(COLUMNS)

    def write(self, step: Step) -> None:
        """Append a line."""
        if self._path is None:
            return
        track, aim, (pan, tilt, focal) = step.target, step.aim, step.commanded
        box = ["", "", "", "", ""] if track is None else [track.id, *track.center_px, *track.size_px]
        self._writer.writerow(
            [step.index, step.t, step.fixed.t, step.zoom.t, step.state, step.reason, *box]
            + (["", ""] if aim is None else [aim.depth, aim.range])
            + [math.degrees(pan), math.degrees(tilt), focal]
            + [math.degrees(step.head.pan), math.degrees(step.head.tilt), step.lens.focal_px]
        )

    def __enter__(self) -> "StepTable":
        """Give the table itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete the file and give it its name; after an error, remove what there is."""
        if self._path is None:
            return
        self._file.close()
        if kind is None:
            self._part.replace(self._path)
        else:
            self._part.unlink(missing_ok=True)
