"""What is so in each zoom frame beside what was commanded: the rows of which every figure is made, and steps.csv."""

import csv
import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cotarget.errors import ConfigError
from cotarget.metrics.closeup import Closeup


@dataclass(frozen=True)
class Row:
    """One new zoom frame, and the fixed frame that the loop had acted on when it came.

    What is said of the wide view is at that fixed frame's own time; all else is at the zoom frame's.

    Attributes:
        t_s: middle of the zoom frame's exposure [s].
        t_fixed_s: middle of the fixed frame's exposure [s].
        state: what the loop was doing.
        track: number of the track followed; -1 for none.
        u_px: true position of the target's body centre in the zoom image [px]; nan behind the camera.
        v_px: likewise.
        width_px: width of the zoom image [px].
        height_px: its height [px].
        size_px: true size of the wanted dimension in the zoom image [px]; nan behind the camera.
        wanted_px: size wanted, or what the longest focal length gives where that is less [px].
        visible: fraction of the true silhouette visible in the zoom image.
        in_wide: whether the target is wholly in the wide view.
        u_wide_px: true position in the wide image [px].
        v_wide_px: likewise.
        u_detected_px: middle of the followed track's detection in the wide image [px]; nan where it is not seen alone.
        v_detected_px: likewise.
        decoded: whether the target's marker decodes in the zoom image.
        decoded_wide: whether it decodes in the wide image.
        off_target: numbers of the confirmed tracks that are off every target, as "3 7".
        range_m: true distance from the zoom camera [m].
        depth_m: estimated depth [m]; nan where nothing was aimed at.
        pan_commanded_deg: last command [degrees].
        tilt_commanded_deg: likewise.
        focal_commanded_px: last command, nominal [px].
        pan_deg: true pan at the zoom frame's time [degrees].
        tilt_deg: likewise.
        focal_px: true focal length at the zoom frame's time [px].
        target: name of the target that is followed.
        head_commands: how many the head was sent until then, whether its goal changed or not.
        lens_commands: how many the lens was sent until then.
        on_target: the confirmed tracks that the fixed frame shows alone, each with every target that it is on, the
            nearest first, as "3:bird 3:bird2 7:bird".
    """

    t_s: float
    t_fixed_s: float
    state: str
    track: int
    u_px: float
    v_px: float
    width_px: int
    height_px: int
    size_px: float
    wanted_px: float
    visible: float
    in_wide: bool
    u_wide_px: float
    v_wide_px: float
    u_detected_px: float
    v_detected_px: float
    decoded: bool
    decoded_wide: bool
    off_target: str
    range_m: float
    depth_m: float
    pan_commanded_deg: float
    tilt_commanded_deg: float
    focal_commanded_px: float
    pan_deg: float
    tilt_deg: float
    focal_px: float
    target: str = ""
    head_commands: int = 0
    lens_commands: int = 0
    on_target: str = ""

    @property
    def closeup(self) -> Closeup:
        """What the zoom frame shows."""
        return Closeup(self.u_px, self.v_px, self.width_px, self.height_px, self.size_px, self.wanted_px, self.visible)

    @property
    def inside(self) -> bool:
        """Whether the body centre is inside the zoom image."""
        return self.closeup.inside

    @property
    def size_ratio(self) -> float:
        """True size over the size wanted; 0 for a target behind the camera, which shows nothing of it."""
        return self.closeup.size_ratio

    @property
    def in_frame(self) -> bool:
        """Whether the target is in the close-up."""
        return self.closeup.in_frame

    @property
    def good_closeup(self) -> bool:
        """Whether the whole target is visible at about the wanted size."""
        return self.closeup.good

    @property
    def tpo_px(self) -> float:
        """Target point offset: distance from the image's centre; half the diagonal for a frame without it [px]."""
        return self.closeup.tpo_px

    @property
    def tpo_deg(self) -> float:
        """The same as an angle [degrees]."""
        return math.degrees(math.atan(self.tpo_px / self.focal_px))

    @property
    def tpe_px(self) -> float:
        """Target point error: distance from the detection to the truth in the wide view [px]; nan without one."""
        return math.hypot(self.u_wide_px - self.u_detected_px, self.v_wide_px - self.v_detected_px)


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write steps.csv, one line a zoom frame."""
    names = [f.name for f in dataclasses.fields(Row)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows([getattr(row, name) for name in names] for row in rows)


def read_rows(path: Path) -> list[Row]:
    """Read steps.csv.

    Raises:
        ConfigError: the file is missing, or is not a steps.csv.
    """
    kinds = {f.name: f.type for f in dataclasses.fields(Row)}
    parse: dict[object, Callable[[str], object]] = {int: int, float: float, str: str, bool: _truth_value}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if missing := [name for name in kinds if name not in (reader.fieldnames or ())]:
                raise ValueError(f"it has no column '{missing[0]}'")
            lines = list(reader)
        if any(None in line.values() for line in lines):
            raise ValueError("a line of it was cut off")
        return [
            Row(**{name: parse[kind](line[name]) for name, kind in kinds.items()})  # type: ignore[arg-type]
            for line in lines
        ]
    except (OSError, csv.Error, ValueError) as error:
        raise ConfigError(f"{path}: is not a steps.csv: {error}") from None


def _truth_value(text: str) -> bool:
    if text not in ("True", "False"):
        raise ValueError(f"'{text}' is not True or False")
    return text == "True"
