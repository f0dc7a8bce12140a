"""Keeps libgphoto2 from doing to the user, and to this process, what nobody expects.

It remembers its own settings in memory, instead of in a file of the user's. It would write where stills go, and who we
are to network cameras, to ~/.gphoto/settings or ~/.config/gphoto/settings, and the gphoto2 command would behave
otherwise from then on. Another HOME would keep it from that, but that is the whole process's; since 2.5.32 libgphoto2
lets a program answer in place of the file.
"""

import contextlib
import ctypes
import functools
import importlib
import os
from collections.abc import Iterator
from pathlib import Path

# Who we are to cameras that pair: always the same, so that nothing needs remembering. "cotarget" twice, in hex.
GUID = ":".join(f"{byte:02x}" for byte in b"cotarget" * 2)
# libgphoto2's results, and the bytes that it has for a value.
FOUND, UNKNOWN, ROOM = 0, -1, 255
GET = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p, ctypes.c_void_p)
PUT = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p)


@functools.cache
def library() -> ctypes.CDLL:
    """The libgphoto2 that python-gphoto2 calls; called by ctypes, its functions let other threads run."""
    return ctypes.CDLL(importlib.import_module("gphoto2._camera").__file__)


@functools.cache
def keep_settings_in_memory() -> tuple[object, object]:
    """Answer for libgphoto2's file of settings from now on; the older versions that cannot be told keep their file.

    Returns:
        The two functions, which must live as long as the library.
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

    Whatever opened next would get the number, a socket or a serial port, and be closed by the next disconnection. The
    mistake is known there (github.com/gphoto/libgphoto2, pull request 1287).
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
    """The drivers of PTP cameras: PyPI's package has a second copy of the library for them."""
    folder = os.environ.get("CAMLIBS")  # set by python-gphoto2 when it is imported
    return [] if folder is None else [ctypes.CDLL(str(path)) for path in Path(folder).glob("ptp2.so")]
