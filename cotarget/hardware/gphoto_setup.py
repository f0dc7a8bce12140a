"""Makes an opened gphoto2 camera ready: in shooting mode, with the configured settings, and a lens that can be sent."""

import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import TypeVar

from cotarget.errors import ConfigError
from cotarget.hardware.gphoto import BAD_PARAMETERS, CAMERA_BUSY, CameraLink, LinkError, Setting
from cotarget.hardware.gphoto_port import shortened
from cotarget.hardware.lens import LensTable
from cotarget.hwconfig import HardwareZoom
from cotarget.rig import Clock

log = logging.getLogger(__name__)

# gphoto2's names: what switches a camera to shooting, and where its stills go. They stay out of its card, because a
# still in memory is sent at once, and so that a card does not fill up.
SHOOTING, TARGET, MEMORY = "capture", "capturetarget", "Internal RAM"
# A busy camera is told apart from a wrong value by its ranges, which are checked before: both come back as -2.
BUSY = frozenset({BAD_PARAMETERS, CAMERA_BUSY})
BUSY_PAUSE_S, BUSY_PATIENCE_S = 0.1, 3.0
LATEST = 2**31  # date that libgphoto2 can tell [s since 1970]

T = TypeVar("T")


@dataclass(frozen=True)
class ZoomSetting:
    """The setting that moves the lens.

    Attributes:
        name: gphoto2's.
        lens: what its positions mean.
        values: how each position is written.
    """

    name: str
    lens: LensTable
    values: Mapping[int, str | float]


def patiently(clock: Clock, call: Callable[[], T]) -> T:
    """Do a call again for a while, as long as the camera is busy."""
    deadline = clock.now() + BUSY_PATIENCE_S
    while True:
        try:
            return call()
        except LinkError as error:
            if error.code not in BUSY or clock.now() >= deadline:
                raise
        clock.sleep_until(clock.now() + BUSY_PAUSE_S)


def set_up(link: CameraLink, config: HardwareZoom, clock: Clock, camera: str) -> ZoomSetting:
    """Bring an opened camera to where it follows.

    Args:
        link: open.
        config: what is wanted.
        clock: the rig's.
        camera: its name, for messages.

    Raises:
        ConfigError: the camera has no such setting or value, or cannot be zoomed as configured.
        LinkError: a call failed.
    """
    if SHOOTING in link.names():
        patiently(clock, lambda: link.put(SHOOTING, 1))
    names = link.names()  # PowerShots show their lens only when they shoot
    # Even where it shows memory already: what was never set it shows so, and has PowerShots use the card.
    own = TARGET not in names or TARGET in config.settings
    if not own and MEMORY in patiently(clock, lambda: link.get(TARGET)).choices:
        patiently(clock, lambda: link.put(TARGET, MEMORY))
    for name, value in config.settings.items():
        _apply(link, clock, camera, names, name, value)
    return _zoom_setting(link, config, clock, camera, names)


def _apply(link: CameraLink, clock: Clock, camera: str, names: Collection[str], name: str, value: str) -> None:
    if name not in names:
        known = shortened(names, name)
        raise ConfigError(f"hardware.zoom.settings: the {camera} has no setting '{name}'; valid here: {known}")
    setting = patiently(clock, lambda: link.get(name))
    _check(setting, f"hardware.zoom.settings.{name}", value)
    patiently(clock, lambda: link.put(name, value))
    got = patiently(clock, lambda: link.get(name)).value
    if setting.kind == "date":  # it goes on
        return
    if got != value and not (isinstance(got, float) and got == float(value)):
        log.warning("the %s took '%s' for its setting '%s' as '%s'", camera, value, name, got)


def _check(setting: Setting, where: str, value: str) -> None:
    """Refuse a value that a setting cannot have."""
    if setting.readonly:
        raise ConfigError(f"{where}: this camera's can only be read; it is '{setting.value}'")
    if setting.kind == "choice" and value not in setting.choices:
        raise ConfigError(f"{where}: '{value}' is not one of: {shortened(setting.choices, value)}")
    if setting.kind == "switch" and value not in ("0", "1"):
        raise ConfigError(f"{where}: '{value}' is not one of: 0, 1")
    if setting.kind == "range":
        number = _number(value)
        if number is None or not setting.low <= number <= setting.high:
            raise ConfigError(f"{where}: '{value}' is not within {setting.low:g} to {setting.high:g}")
    if setting.kind == "date" and not (value.isascii() and value.isdigit() and int(value) < LATEST):
        raise ConfigError(f"{where}: '{value}' is no time in whole seconds since 1970")


def _zoom_setting(
    link: CameraLink, config: HardwareZoom, clock: Clock, camera: str, names: Collection[str]
) -> ZoomSetting:
    """What moves the lens, checked against the table of its focal lengths."""
    name, (first, last) = config.zoom_key, (config.lens[0][0], config.lens[-1][0])
    if name not in names:
        known = shortened(names, name)
        raise ConfigError(
            f"hardware.zoom: the {camera} has no setting '{name}'; it cannot be zoomed; its settings are: {known}"
        )
    setting = patiently(clock, lambda: link.get(name))
    values = _positions(setting)
    if not values:
        raise ConfigError(
            f"hardware.zoom.zoom_key: '{name}' of the {camera} is neither a range nor a list of positions, "
            f"but '{setting.value}'"
        )
    if setting.readonly:
        raise ConfigError(f"hardware.zoom.zoom_key: '{name}' of the {camera} can only be read; it cannot be zoomed")
    if first < min(values) or last > max(values):
        raise ConfigError(
            f"hardware.zoom.lens: positions {first} to {last} exceed those of the {camera}'s '{name}', "
            f"{min(values)} to {max(values)}"
        )
    inside = tuple(sorted(position for position in values if first <= position <= last))
    if len(inside) < 2:
        raise ConfigError(f"hardware.zoom.lens: the {camera} cannot be sent to positions between {first} and {last}")
    return ZoomSetting(name, LensTable(config.lens, inside, config.pitch_mm), values)


def _positions(setting: Setting) -> dict[int, str | float]:
    """Where a setting can send a lens, and how that is written; empty where it is no lens's."""
    if setting.kind == "range":
        step = setting.step if setting.step > 0 else 1.0
        count = int((setting.high - setting.low) / step) + 1
        return {round(setting.low + i * step): setting.low + i * step for i in range(count)}
    numbers = {choice: _number(choice) for choice in setting.choices}
    return {round(number): choice for choice, number in numbers.items() if number is not None}


def position_in(setting: Setting) -> float | None:
    """The lens's position that a setting shows [1]; None where it shows none."""
    return _number(setting.value)


def _number(value: str | float) -> float | None:
    try:
        return float(value)
    except ValueError:
        return None
