"""The camera calls of python-gphoto2 that the driver uses.

Some calls of python-gphoto2 hold Python's interpreter lock while they wait for the camera; a hung camera would then
stop every thread, the head's included. Opening, settings, previews and stills release the lock. Disconnecting does not,
so it is called through ctypes. Listing settings and detecting cameras do not wait for a camera.

Two side effects of libgphoto2 are prevented. It writes its settings (where stills go, and this program's identity for
network cameras) to ~/.gphoto/settings or ~/.config/gphoto/settings, which would change the gphoto2 command. Since
2.5.32 a program may answer in place of the file; another HOME would change the whole process. It also closes descriptor
0, see `standard_input_kept`.
"""

import contextlib
import ctypes
import difflib
import functools
import importlib
import os
import re
import socket
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cotarget.errors import ConfigError, DeviceError, MissingPackageError, install_extra

# This program's identity for cameras that pair: constant, so that nothing is stored. "cotarget" twice, in hex.
GUID = ":".join(f"{byte:02x}" for byte in b"cotarget" * 2)
# libgphoto2's result codes, and the size of its buffer for a value [bytes].
FOUND, UNKNOWN, ROOM = 0, -1, 255
GET = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p, ctypes.c_void_p)
PUT = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p)


@functools.cache
def library() -> ctypes.CDLL:
    """Load the libgphoto2 that python-gphoto2 uses; calls through ctypes release the interpreter lock."""
    return ctypes.CDLL(importlib.import_module("gphoto2._camera").__file__)


@functools.cache
def keep_settings_in_memory() -> tuple[object, object]:
    """Answer in place of libgphoto2's settings file from now on; versions before 2.5.32 keep the file.

    Returns:
        The two callbacks, which must live as long as the library.
    """
    memory = {(b"ptp2_ip", b"guid"): GUID.encode()}

    def get(who: bytes, key: bytes, value: int, _user: int) -> int:
        known = memory.get((who, key))
        text = (known or b"")[:ROOM] + b"\0"
        ctypes.memmove(value, text, len(text))
        return UNKNOWN if known is None else FOUND

    def put(who: bytes, key: bytes, value: bytes, _user: int) -> int:
        memory[who, key] = value
        return FOUND

    functions = GET(get), PUT(put)
    for each in (library(), *_drivers()):
        if hasattr(each, "gp_setting_set_get_func"):
            each.gp_setting_set_get_func(functions[0], None)
            each.gp_setting_set_set_func(functions[1], None)
    return functions


@contextlib.contextmanager
def standard_input_kept() -> Iterator[None]:
    """Keep descriptor 0, which libgphoto2 closes whenever it disconnects from a network camera.

    The next socket or serial port to be opened would get the number, and be closed by the next disconnection. The bug
    is known (github.com/gphoto/libgphoto2, pull request 1287).
    """
    try:
        kept = os.dup(0)
    except OSError:  # a program without standard input
        kept = os.open(os.devnull, os.O_RDONLY)
    try:
        yield
    finally:
        if kept:
            os.dup2(kept, 0)
            os.close(kept)


def _drivers() -> list[ctypes.CDLL]:
    """Load the drivers of PTP cameras, for which PyPI's package has a second copy of the library."""
    folder = os.environ.get("CAMLIBS")  # set by python-gphoto2 when it is imported
    return [] if folder is None else [ctypes.CDLL(str(path)) for path in Path(folder).glob("ptp2.so")]


# Ports

# PTP/IP's own TCP port (CIPA DC-005), for commands and for events.
NETWORK_PORT, HIGHEST_PORT = "15740", 65535
NETWORK = re.compile(r"ptpip:([^:\s]+)(?::(\d+))?(?::(\d+))?", re.ASCII)
LISTENING_S = 2.5  # libgphoto2's own time limit to connect [s]
USB = re.compile(r"usb:(?:(\d+),(\d+))?", re.ASCII)


def full_port(port: str) -> str:
    """Complete a port for gphoto2: a network camera's needs its numeric address and both TCP ports.

    Raises:
        ConfigError: the text is no port of gphoto2, or its host is unknown.
    """
    if USB.fullmatch(port):
        return port
    match = NETWORK.fullmatch(port)
    if match is None:
        raise ConfigError(f"hardware.zoom.port: '{port}' is not like usb:, usb:001,005 or ptpip:host:port:port")
    host, commands, events = match[1], match[2] or NETWORK_PORT, match[3] or match[2] or NETWORK_PORT
    if max(int(commands), int(events)) > HIGHEST_PORT:
        raise ConfigError(f"hardware.zoom.port: '{port}' has a TCP port above {HIGHEST_PORT}")
    try:
        address = socket.getaddrinfo(host, None, socket.AF_INET)[0][4][0]  # gphoto2 resolves no names
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"hardware.zoom.port: there is no host '{host}' in '{port}'") from error
    # Without a second port gphoto2 would take 15740 for events, even where the first port differs.
    return f"ptpip:{address}:{commands}:{events}"


def check_listening(port: str) -> None:
    """Refuse a network address where no camera listens; libgphoto2 would print lines of its own to stderr.

    Raises:
        DeviceError: the connection failed.
    """
    _, address, commands, _ = port.split(":")
    try:
        socket.create_connection((address, int(commands)), LISTENING_S).close()
    except OSError as error:
        raise DeviceError(f"hardware.zoom.port: no camera listens at '{port}': {error.strerror or error}") from error


def check_permission(port: str) -> None:
    """Refuse a USB camera without permission for this user; gphoto2 would report a general I/O error.

    Raises:
        DeviceError: there is no permission; the message names the remedy.
    """
    match = USB.fullmatch(port)
    device = Path("/dev/bus/usb", *(match.groups() if match else ()))
    if device.is_char_device() and not os.access(device, os.R_OK | os.W_OK):
        raise DeviceError(
            f"hardware.zoom.port: no permission to use {device}; add yourself to its group (ls -l {device}), "
            "or a udev rule as of libgphoto2's print-camera-list"
        )


def closest(names: Iterable[str], wanted: str, most: int = 12) -> str:
    """List valid choices for a message, those most like ``wanted`` first, at most ``most`` of them."""
    names = sorted(set(names))
    near = [name for name in names if wanted.lower() in name.lower()]
    near += difflib.get_close_matches(wanted, names, n=most, cutoff=0.4)
    shown = list(dict.fromkeys([*near, *names]))[:most]
    more = len(names) - len(shown)
    return (", ".join(shown) or "none") + (f" and {more} more" if more else "")


# Calls

# libgphoto2's result codes, gphoto2/gphoto2-port-result.h and gphoto2-result.h.
BAD_PARAMETERS, IO, TIMEOUT = -2, -7, -10
IO_READ, IO_WRITE, USB_CLEAR_HALT, USB_FIND, USB_CLAIM, IO_LOCK = -34, -35, -51, -52, -53, -60
CAMERA_BUSY = -110
# After these errors the connection is unusable and must be made again.
LOST = frozenset({IO, TIMEOUT, IO_READ, IO_WRITE, USB_CLEAR_HALT, USB_FIND, USB_CLAIM, IO_LOCK})
# gphoto2's model name for any network camera; it cannot detect those.
NETWORK_MODEL = "PTP/IP Camera"
# Remedies for errors that a user can correct; the codes of a network camera do not say what is wrong.
NETWORK_HINT = "; is it a PTP/IP camera, switched on, and used by no other program?"
HINTS = {
    USB_CLAIM: "; another program holds it: unmount it (gio mount -s gphoto2), or end gvfs-gphoto2-volume-monitor",
    USB_FIND: "; it is unplugged, or not the configured model",
    IO: "; it does not answer: is it switched on, and its cable plugged in?",
}


class LinkError(Exception):
    """A call of libgphoto2 failed.

    Attributes:
        code: libgphoto2's result code.
    """

    def __init__(self, code: int, text: str, hint: str = "") -> None:
        super().__init__(f"gphoto2 says [{code}] {text}{hint or HINTS.get(code, '')}")
        self.code = code


@dataclass(frozen=True)
class Setting:
    """A setting of a camera."""

    kind: Literal["range", "switch", "choice", "date", "text"]  # a switch is 0 or 1, a date in seconds since 1970
    value: str | float  # the present one
    low: float = 0.0  # of a range
    high: float = 0.0
    step: float = 1.0
    choices: tuple[str, ...] = ()  # valid values of a choice or switch
    readonly: bool = False


class GphotoLink:
    """A camera through python-gphoto2, used by one thread; each call raises LinkError where libgphoto2 fails.

    Args:
        port: in gphoto2's notation.
        model: gphoto2's name of the model; empty for the camera that is at the port.

    Raises:
        ConfigError: the port is invalid.
    """

    def __init__(self, port: str, model: str) -> None:
        self._port, self._model = full_port(port), model
        self._gp: Any = None
        self._camera: Any = None

    def open(self) -> str:
        """Connect, possibly again after `close`; return the camera's name.

        Raises:
            ConfigError: the model is unknown, or gphoto2 is not installed.
            DeviceError: the camera is not there, or may not be used.
        """
        self._gp = gp = _gphoto2()
        ports, abilities = gp.PortInfoList(), gp.CameraAbilitiesList()
        camera: Any = None
        with standard_input_kept():
            try:
                model, port = self._find(ports, abilities)
                camera = gp.Camera()
                camera.set_abilities(abilities.get_abilities(abilities.lookup_model(model)))
                camera.set_port_info(ports.get_info(ports.lookup_path(port)))
                camera.init()
            except gp.GPhoto2Error as error:
                camera = None  # frees the object, which disconnects, inside of standard_input_kept
                raise LinkError(error.code, error.string, NETWORK_HINT * self._port.startswith("ptpip:")) from error
        self._camera = camera
        return model

    def look(self) -> str:
        """Detect the camera and check the permission for it without opening it; describe it in one line.

        Raises:
            ConfigError: the model is unknown, or gphoto2 is not installed.
            DeviceError: the camera is not there, or may not be used.
        """
        gp = _gphoto2()
        ports, abilities = gp.PortInfoList(), gp.CameraAbilitiesList()
        try:
            model, port = self._find(ports, abilities)
        except gp.GPhoto2Error as error:
            raise DeviceError(f"gphoto2 says [{error.code}] {error.string}") from error
        return f"{model} at {port}" if port.startswith("usb:") else f"something listens at {port}"

    def _find(self, ports: Any, abilities: Any) -> tuple[str, str]:
        """Load both lists and find the camera: its model's name and its full port."""
        ports.load()
        abilities.load()
        port = self._port
        if self._model:
            _check_model(self._model, abilities)
        if port.startswith("ptpip:"):
            check_listening(port)
            return self._model or NETWORK_MODEL, port
        found = [(str(model), str(at)) for model, at in abilities.detect(ports).items() if str(at).startswith("usb:")]
        here = [(self._model or model, at) for model, at in found if port in ("usb:", at)]
        if not here:
            others = f", or write one of: {_listed(found)}" if found else ""
            raise DeviceError(f"hardware.zoom.port: no camera at '{port}'; connect it and switch it on{others}")
        if len(here) > 1:
            raise DeviceError(f"hardware.zoom.port: '{port}' is more than one camera; write one of: {_listed(here)}")
        check_permission(here[0][1])
        return here[0]

    def close(self) -> None:
        """Disconnect, if connected, without blocking other threads while the camera does not answer."""
        camera, self._camera = self._camera, None
        if camera is not None:
            with standard_input_kept():
                library().gp_camera_exit(ctypes.c_void_p(int(camera.this)), None)
                del camera

    def names(self) -> list[str]:
        """List the names of the camera's settings."""
        return [str(name) for name in self._call("list_config").keys()]  # noqa: SIM118 - a CameraList is no dict

    def get(self, name: str) -> Setting:
        """Read a setting."""
        gp, widget = self._gp, self._call("get_single_config", name)
        kind, value, readonly = widget.get_type(), widget.get_value(), bool(widget.get_readonly())
        if kind == gp.GP_WIDGET_RANGE:
            low, high, step = (float(each) for each in widget.get_range())
            return Setting("range", float(value), low, high, step, readonly=readonly)
        if kind in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU):
            choices = tuple(str(choice) for choice in widget.get_choices())
            return Setting("choice", str(value), choices=choices, readonly=readonly)
        if kind == gp.GP_WIDGET_TOGGLE:
            return Setting("switch", float(value), choices=("0", "1"), readonly=readonly)
        if kind == gp.GP_WIDGET_DATE:
            return Setting("date", float(value), readonly=readonly)
        return Setting("text", str(value), readonly=readonly)

    def put(self, name: str, value: str | float) -> None:
        """Write a setting."""
        gp, widget = self._gp, self._call("get_single_config", name)
        kind = widget.get_type()
        if kind == gp.GP_WIDGET_RANGE:
            widget.set_value(float(value))
        elif kind in (gp.GP_WIDGET_TOGGLE, gp.GP_WIDGET_DATE):
            widget.set_value(int(value))
        else:
            widget.set_value(str(value))
        self._call("set_single_config", name, widget)

    def preview(self) -> bytes:
        """Fetch a viewfinder frame, as the camera encodes it."""
        file = self._call("capture_preview")  # owns the data until bytes() has copied them
        return bytes(file.get_data_and_size())

    def shoot(self) -> tuple[str, str]:
        """Take a still; return its folder and name on the camera."""
        path = self._call("capture", self._gp.GP_CAPTURE_IMAGE)
        return str(path.folder), str(path.name)

    def fetch(self, still: tuple[str, str]) -> bytes:
        """Fetch the contents of a still."""
        file = self._call("file_get", *still, self._gp.GP_FILE_TYPE_NORMAL)
        return bytes(file.get_data_and_size())

    def _call(self, name: str, *arguments: object) -> Any:
        assert self._camera is not None, "the camera is not open"
        try:
            return getattr(self._camera, name)(*arguments)
        except self._gp.GPhoto2Error as error:
            raise LinkError(error.code, error.string) from error


def cameras() -> list[str]:
    """List the cameras on this machine's USB as "model at port"; none is opened.

    Raises:
        ConfigError: gphoto2 is not installed.
        DeviceError: the detection failed.
    """
    gp = _gphoto2()
    try:
        return [f"{model} at {port}" for model, port in gp.Camera.autodetect().items()]
    except gp.GPhoto2Error as error:
        raise DeviceError(f"gphoto2 says [{error.code}] {error.string}") from error


def _check_model(model: str, abilities: Any) -> None:
    names = {str(abilities.get_abilities(i).model) for i in range(abilities.count())}
    if model not in names:
        raise ConfigError(f"hardware.zoom.model: gphoto2 knows no '{model}'; it knows {closest(names, model, 5)}")


def _listed(found: list[tuple[str, str]]) -> str:
    return ", ".join(f"{port} ({model})" for model, port in found)


def _gphoto2() -> Any:
    try:
        gphoto2 = importlib.import_module("gphoto2")
    except ImportError as error:
        raise MissingPackageError(
            f"gphoto2 is not installed; the extra hardware has it: {install_extra('hardware')}"
        ) from error
    keep_settings_in_memory()
    return gphoto2
