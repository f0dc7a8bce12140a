"""What rig.toml must not say beyond its [sim] and [hardware] tables: values of the right type that make no sense."""

from typing import TYPE_CHECKING

from cotarget.errors import ConfigError
from cotarget.hwconfig import check_hardware
from cotarget.simchecks import check_numbers, check_sim

if TYPE_CHECKING:
    from cotarget.config import BoardConfig, RigConfig, SafetyConfig

FEWEST_CORNERS, MOST_CORNERS = 3, 100  # of a board, a side


def check_config(config: "RigConfig", recorded: bool = False) -> None:
    """Refuse values of the right type that make no sense.

    Args:
        config: of a rig.
        recorded: as `cotarget.config.parse_config` has it.

    Raises:
        ConfigError: with the key.
    """
    check_numbers(config.sim) if recorded else check_sim(config.sim)
    check_hardware(config.hardware)
    positive: dict[str, float] = {
        "board.square": config.board.square,
        "safety.max_frame_age_s": config.safety.max_frame_age_s,
        "safety.watchdog_s": config.safety.watchdog_s,
    }
    for name, target in config.targets.items():
        positive |= {f"targets.{name}.size": target.size, f"targets.{name}.wanted_px": target.wanted_px}
    for where, value in positive.items():
        if value <= 0:
            raise ConfigError(f"{where}: {value:g} is not greater than zero")
    _check_safety(config.safety, config.rate_hz)
    check_corners(config.board)


def check_corners(board: "BoardConfig") -> None:
    """Refuse a board whose corners are too few or too many, and a chessboard that looks the same upside down.

    Raises:
        ConfigError: with the key.
    """
    columns, rows = board.corners
    if min(columns, rows) < FEWEST_CORNERS:
        raise ConfigError(f"board.corners: {columns}x{rows} has fewer than {FEWEST_CORNERS} corners a side")
    if max(columns, rows) > MOST_CORNERS:
        raise ConfigError(f"board.corners: {columns}x{rows} has more than {MOST_CORNERS} corners a side")
    if board.kind == "chessboard" and (columns + rows) % 2 == 0:
        raise ConfigError(
            f"board.corners: {columns}x{rows} looks the same upside down; "
            f"one count must be odd and the other even, like {columns}x{rows + 1}"
        )


def _check_safety(safety: "SafetyConfig", rate_hz: float) -> None:
    """Refuse limits that are none, a watchdog that halts between two frames, and a stop file without a name."""
    for where, limits in (("safety.pan_deg", safety.pan_deg), ("safety.tilt_deg", safety.tilt_deg)):
        if limits is not None and limits[0] >= limits[1]:
            raise ConfigError(f"{where}: {list(limits)} is not [lowest, highest]")
    if safety.speed_deg_s is not None and safety.speed_deg_s <= 0:
        raise ConfigError(f"safety.speed_deg_s: {safety.speed_deg_s:g} is not greater than zero")
    if safety.watchdog_s * rate_hz <= 1:
        raise ConfigError(
            f"safety.watchdog_s: {safety.watchdog_s:g} s would halt the head between any two frames of the "
            f"fixed camera, of which {rate_hz:g} come a second"
        )
    if safety.stop_file is not None and safety.stop_file.name in ("", ".."):
        raise ConfigError(f"safety.stop_file: '{safety.stop_file}' is a folder; name a file in it, as 'stop'")
