"""Open the real devices as one Rig; every exit halts the head and releases all devices."""

import contextlib
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cotarget.config import HardwareConfig, RigConfig
from cotarget.drivers import DRIVERS
from cotarget.drivers.board import BoardSettings, make_board
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.interlock import addresses_of, rig_lock
from cotarget.errors import ConfigError, DeviceError, choices
from cotarget.plugins import FORM, Answer, Reporting, calling, check_attribute, is_own, load
from cotarget.rig import (
    CameraSpec,
    Frame,
    HeadSpec,
    PanTiltLimits,
    PanTiltState,
    Rig,
    RigSpec,
    Unit,
    UnitSpec,
    ZoomSpec,
    ZoomState,
)
from cotarget.schema import missing_key, validate

# Python's thread switch interval [s], instead of 5 ms: a driver's thread that waits for its turn delays every command.
# Measurements: docs/design-notes.md.
SWITCH_INTERVAL = 5e-4
KEY = "driver"


def _is_frame(answer: object) -> bool:
    return (
        isinstance(answer, Frame)
        and isinstance(answer.image, np.ndarray)
        and answer.image.dtype == np.uint8
        and answer.image.shape[2:] == (3,)
        and isinstance(answer.t, Real)
    )


def _is_state(answer: object, kind: type[Any], *numbers: str) -> bool:
    return isinstance(answer, kind) and all(isinstance(getattr(answer, name), Real) for name in (*numbers, "t"))


def _is_focal_length(answer: Any) -> bool:
    return isinstance(answer, Real) and 0 < float(answer) < math.inf


def _are_numbers(answer: Any, count: int) -> bool:
    numbers = list(answer) if isinstance(answer, tuple | list | np.ndarray) else []
    return len(numbers) == count and all(isinstance(each, Real) for each in numbers)


def _are_two(attribute: Any, kind: type[Any]) -> bool:
    return isinstance(attribute, tuple) and len(attribute) == 2 and all(isinstance(each, kind) for each in attribute)


class Role(NamedTuple):
    """What a device of a table of [hardware] has to have."""

    spec: type[Any]  # what its settings describe
    attributes: Mapping[str, Answer]  # its attributes, and what they have to be
    methods: Mapping[str, Answer | None]  # its methods, and what they have to return; None for nothing


FRAME = Answer(_is_frame, "a Frame with its time, whose image is (H, W, 3) BGR of uint8")
SIZE = Answer(
    lambda size: _are_two(size, Integral) and min(size) > 0,
    "(width, height) [px], a tuple of two whole numbers above zero",
)
FOCAL_RANGE = Answer(
    lambda ends: _are_two(ends, Real) and 0 < ends[0] <= ends[1], "(shortest, longest) focal length [px], a tuple"
)
ROLES: Mapping[str, Role] = {
    "head": Role(
        HeadSpec,
        {"limits": Answer(lambda limits: isinstance(limits, PanTiltLimits), "a PanTiltLimits of cotarget.rig")},
        {
            "state": Answer(lambda answer: _is_state(answer, PanTiltState, "pan", "tilt"), "a PanTiltState of numbers"),
            "move": Answer(lambda answer: _are_numbers(answer, 2), "pan and tilt as commanded [rad]"),
            "halt": None,
            "close": None,
        },
    ),
    "fixed": Role(CameraSpec, {"size": SIZE}, {"read": FRAME, "close": None}),
    "zoom": Role(
        ZoomSpec,
        {"size": SIZE, "still_size": SIZE, "focal_range": FOCAL_RANGE},
        {
            "read": FRAME,
            "capture": FRAME,
            "state": Answer(
                lambda answer: _is_state(answer, ZoomState) and _is_focal_length(answer.focal_px),
                "a ZoomState, with a focal length above zero",
            ),
            "zoom": Answer(_is_focal_length, "the focal length that the lens will reach, above zero [px]"),
            "close": None,
        },
    ),
    "ptz": Role(UnitSpec, {}, {"close": None}),  # its zoom camera and its head have what those need
}


@dataclass(frozen=True)
class Device:
    """A device of rig.toml: the driver that opens it, and its checked settings."""

    role: str  # "head", "fixed", "zoom" or "ptz"
    driver: Any  # class that opens the device; docs/drivers.md says what it has
    settings: Any  # an instance of ``driver.Settings``
    own: bool  # whether the driver is a user's own

    @property
    def where(self) -> str:
        """The device's table in rig.toml."""
        return f"hardware.{self.role}"

    @property
    def spec(self) -> Any:
        """What the settings say of the device.

        Raises:
            ConfigError: they do not describe such a device.
        """
        with calling(self.where):
            spec, wanted = self.settings.spec, ROLES[self.role].spec
        if not isinstance(spec, wanted):
            raise ConfigError(f"{self.where}.{KEY}: spec of its Settings is no {wanted.__name__} of cotarget.rig")
        if wanted is UnitSpec and not (isinstance(spec.zoom, ZoomSpec) and isinstance(spec.head, HeadSpec)):
            raise ConfigError(f"{self.where}.{KEY}: spec of its Settings is no UnitSpec of a ZoomSpec and a HeadSpec")
        return spec

    @property
    def address(self) -> str:
        """The device's own address, such as its port; empty if the settings name none."""
        return next(iter(addresses_of(self.settings)), "")

    def refuse_missing(self) -> None:
        """Refuse settings that lack what opening the device needs.

        Raises:
            ConfigError: a key is missing.
        """
        if missing := missing_key(self.settings):
            key, example = missing
            raise ConfigError(
                f'{self.where}.{key}: is missing; the hardware backend needs it, for example {key} = "{example}"'
            )

    def probe(self) -> str | None:
        """Describe the device in one line, by queries that change nothing; None if its driver has no probe.

        Raises:
            ConfigError: the settings lack what is needed to find the device.
            DeviceError: the device is not there, or does not answer.
        """
        self.refuse_missing()
        if not hasattr(self.driver, "probe"):
            return None
        lock = rig_lock(*addresses_of(self.settings)) if self.role in ("head", "ptz") else contextlib.nullcontext()
        with lock, self._naming():
            return str(self.driver.probe(self.settings))

    def open(self, *arguments: Any) -> Any:
        """Open the device.

        Raises:
            ConfigError: the device differs from its settings.
            DeviceError: the device cannot be opened, or an attribute is not what it has to be.
        """
        with self._naming():
            device = self.driver(self.settings, *arguments)
        return self._reporting(device, self.role) if self.own else device

    @contextlib.contextmanager
    def _naming(self) -> Iterator[None]:
        """Call the driver; its errors name the device's own table, which may be another than its messages say."""
        try:
            with calling(self.where) if self.own else contextlib.nullcontext():
                yield
        except (ConfigError, DeviceError) as error:
            if (text := re.sub(r"^hardware\.\w+\b", self.where, str(error))) == str(error):
                raise
            raise (ConfigError if isinstance(error, ConfigError) else DeviceError)(text) from error

    def open_unit(self, *arguments: Any) -> Unit:
        """Open a device that is a zoom camera and a head in one housing. Raises as `open` does."""
        with contextlib.ExitStack() as opened:
            unit = opened.enter_context(contextlib.closing(self.open(*arguments)))
            with calling(self.where):
                lacks = [name for name in ("zoom", "head") if not hasattr(unit, name)]
            if lacks:
                raise self._lacking(lacks[0])
            zoom, head = (self._reporting(getattr(unit, part), part, f".{part}") for part in ("zoom", "head"))
            opened.pop_all()
        return Unit(zoom, head, unit.close)

    def _reporting(self, device: Any, role: str, part: str = "") -> Any:
        """Check that a user's own device has what a role needs; close it if it has not, but no part of a unit."""
        attributes, methods = ROLES[role].attributes, dict(ROLES[role].methods)
        if part:
            del methods["close"]
        with calling(self.where):
            lacks = [name for name in (*attributes, *methods) if not hasattr(device, name)]
        if lacks:
            raise self._lacking(lacks[0], part)
        own = Reporting(device, self.where, methods)
        with contextlib.ExitStack() as opened:
            if not part:
                opened.enter_context(contextlib.closing(own))
            for name, answer in attributes.items():
                check_attribute(device, name, self.where, answer)
            opened.pop_all()
        return own

    def _lacking(self, name: str, part: str = "") -> ConfigError:
        """Make the error for a driver, or a part of it, that lacks an attribute."""
        what = f"{self.driver.__name__}{part}"
        return ConfigError(f"{self.where}.{KEY}: {what} has no {name}; docs/drivers.md says what it needs")


def device_of(role: str, table: Mapping[str, Any]) -> Device:
    """Find the driver that a table of [hardware] names, and check the table; no device is opened.

    Args:
        role: "head", "fixed", "zoom" or "ptz".
        table: the table.

    Raises:
        ConfigError: there is no such driver, or it refuses the table.
    """
    where, known = f"hardware.{role}", DRIVERS[role]
    name = table.get(KEY, None if role == "ptz" else next(iter(known)))
    own = isinstance(name, str) and is_own(name)
    if not own and name not in known:
        also = f"{name!r} is neither {FORM} nor" if name else f"is missing; give {FORM} or"
        raise ConfigError(f"{where}.{KEY}: {also} one of: {choices(known)}")
    driver = load(name if own else known[name], f"{where}.{KEY}")
    if not is_dataclass(settings := getattr(driver, "Settings", None)) or not hasattr(settings, "spec"):
        raise ConfigError(f"{where}.{KEY}: {name} has no Settings, a dataclass of its keys in rig.toml with a spec")
    rest = {key: value for key, value in table.items() if key != KEY}
    with calling(where):
        return Device(role, driver, validate(driver.Settings, rest, where, beside=(KEY,)), own)


def devices(hardware: HardwareConfig) -> dict[str, Device]:
    """Find and check the head, the fixed and the zoom camera; no device is opened.

    A device of [hardware.ptz] is the head, and there is no zoom camera besides.

    Raises:
        ConfigError: a table is refused.
    """
    check_hardware(hardware)
    if not hardware.ptz:
        return {role: device_of(role, getattr(hardware, role)) for role in ("head", "fixed", "zoom")}
    return {"head": device_of("ptz", hardware.ptz), "fixed": device_of("fixed", hardware.fixed)}


def board_settings(hardware: HardwareConfig) -> BoardSettings:
    """Check the board's table.

    Raises:
        ConfigError: it is refused.
    """
    return validate(BoardSettings, hardware.board, "hardware.board")


def check_hardware(hardware: HardwareConfig) -> None:
    """Check every table of [hardware] that says something; no device is opened.

    Raises:
        ConfigError: a table is refused.
    """
    for role in ROLES:
        if table := getattr(hardware, role):
            if hardware.ptz and role in ("head", "zoom"):
                raise ConfigError(
                    f"hardware.{role}: [hardware.ptz] is zoom camera and head in one; leave this table out"
                )
            device_of(role, table)
    board_settings(hardware)


def rig_spec(config: RigConfig) -> RigSpec:
    """Describe the configured devices without opening them.

    Raises:
        ConfigError: a table of [hardware] is refused.
    """
    return _spec(devices(config.hardware))


def _spec(found: Mapping[str, Device]) -> RigSpec:
    fixed, head = found["fixed"].spec, found["head"].spec
    zoom, head = (head.zoom, head.head) if "zoom" not in found else (found["zoom"].spec, head)
    return RigSpec(fixed, zoom, head, real_time=True)


class Missing:
    """Stands in for a device that rig.toml does not configure: every call but a halt is an error that says so.

    Args:
        error: what each call raises.
        known: attributes, as the default settings describe them.
    """

    def __init__(self, error: ConfigError, known: Mapping[str, Any]) -> None:
        self._error = error
        self.__dict__.update(known)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def refuse(*arguments: Any, **options: Any) -> Any:
            raise self._error

        return refuse

    def halt(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


def open_hardware(config: RigConfig, file: Path | None = None, partial: bool = False) -> Rig:
    """Open the devices of a configuration; the head comes last and does not move where another device is missing.

    Shortens the thread switch interval of this process (`SWITCH_INTERVAL`). No second program may open the rig of
    ``file``, its rig.toml.

    Args:
        config: the configuration.
        file: its rig.toml.
        partial: whether devices that are not configured may be missing, see `Rig.missing`.

    Raises:
        ConfigError: a device is not named, or differs from the configuration.
        DeviceError: a device could not be opened, or another program uses it.
    """
    found, missing = devices(config.hardware), dict[str, ConfigError]()
    for role, device in found.items():
        try:
            device.refuse_missing()
        except ConfigError as error:
            missing |= dict.fromkeys(("zoom", "head") if device.role == "ptz" else (role,), error)
    if missing and (not partial or missing.keys() >= found.keys()):
        raise min(missing.items(), key=lambda each: not getattr(config.hardware, each[0], None))[1]
    sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_INTERVAL))
    clock, spec = MonotonicClock(), _spec(found)
    with contextlib.ExitStack() as opened:

        def opening(role: str, known: Sequence[str], *arguments: Any) -> Any:
            if role in missing:
                described = getattr(spec, role)
                return Missing(missing[role], {name: getattr(described, name) for name in known})
            return opened.enter_context(contextlib.closing(found[role].open(clock, *arguments)))

        opened.enter_context(rig_lock(*addresses_of(found["head"].settings), file=file))
        board = opened.enter_context(contextlib.closing(make_board(board_settings(config.hardware))))
        fixed = opening("fixed", ("size",))
        if found["head"].role == "ptz" and "head" not in missing:
            unit = opened.enter_context(contextlib.closing(found["head"].open_unit(clock, config.safety)))
            zoom, head = unit.zoom, unit.head
        else:
            zoom = opening("zoom", ("size", "still_size", "focal_range"))
            head = opening("head", ("limits",), config.safety)
        reported = replace(
            spec,
            fixed=replace(spec.fixed, size=fixed.size),
            zoom=replace(spec.zoom, size=zoom.size, focal_range=zoom.focal_range, still_size=zoom.still_size),
            head=replace(spec.head, limits=head.limits),
        )
        return Rig(
            fixed, zoom, head, clock, board, reported, opened.pop_all().close, config, missing=frozenset(missing)
        )
