"""What tests of commands share: a call, the exact calibration of a rig, boards on photos, a film of a bird."""

import json
import math
from unittest.mock import patch

import cv2
import numpy as np

from cotarget import cli
from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.pantilt import HeadGeometry
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.video import FilmWriter

OLD = "what was there before\n"
FILM_HZ = 25.0
# A rig of real devices, none of which is there.
NO_PORT = "/dev/nobody-is-here"
HARDWARE = f"""
backend = "hardware"
[hardware.head]
port = "{NO_PORT}"
[hardware.fixed]
url = "http://127.0.0.1:9"
[hardware.zoom]
port = "usb:"
"""


def call(capsys, *arguments):
    """Exit status, stdout and stderr of a command."""
    with patch("cotarget.parallel.PROGRESS_LINE_S", math.inf):  # a busy machine is no complaint
        try:
            status = cli.main([str(a) for a in arguments])
        except SystemExit as left:
            status = left.code
    said = capsys.readouterr()
    return status, said.out, said.err


def refused(capsys, *arguments):
    """The one line with which a command refuses its arguments or its files."""
    status, out, err = call(capsys, *arguments)
    assert status in (1, 2)
    assert out == ""
    assert err.startswith(f"cotarget {arguments[0]}: "), err
    assert err.endswith("\n")
    assert err.count("\n") == 1, err
    return err.rstrip("\n")


def true_calibration(config, zoom_size=None, with_head=True):
    """The exact calibration of a configured rig."""
    sim = config.sim
    zoom = Intrinsics(zoom_size or sim.zoom.size, sim.zoom.focal_px, sim.zoom.center_px, sim.zoom.distortion)
    return Calibration(
        fixed=FixedCamera(Intrinsics(sim.fixed.size, sim.fixed.focal_px, sim.fixed.center_px, sim.fixed.distortion)),
        zoom_head=ZoomHead(
            ZoomLens((sim.zoom.focal_mm[0] / sim.zoom.pitch_mm,), (zoom,)),
            sim.T_zoom0_fixed,
            sim.T_head_zoom if with_head else None,
            HeadGeometry(sim.head.axis_offset_mm / 1000, math.radians(sim.head.squareness_deg)),
        ),
        pitch_mm=sim.zoom.pitch_mm,
    )


def board_photo():
    """A 9x6 board seen straight on, with a white margin."""
    rows, columns = np.mgrid[:7, :10]
    squares = np.kron((rows + columns) % 2 * 255, np.ones((24, 24))).astype(np.uint8)
    return cv2.cvtColor(cv2.copyMakeBorder(squares, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255), cv2.COLOR_GRAY2BGR)


def capture(file, camera="fixed", **more):
    """A row of an index of captures."""
    return {"file": file, "camera": camera, "board": 0, "pan": 0.0, "tilt": 0.0, "focal_px": None, "t": 0.0, **more}


def write_index(folder, rows):
    """An index of captures in a folder."""
    table = {"schema": 1, "board": {"kind": "chessboard", "corners": [9, 6], "square": 0.1}, "pitch_mm": None}
    (folder / "index.json").write_text(json.dumps(table | {"captures": rows}))


def bird_film(path, count=60, size=(161, 121)):
    """A dark 12 x 6 px bird that crosses a bright sky at 50 px/s; an odd size on purpose."""
    with FilmWriter(path, FILM_HZ) as film:
        for i in range(count):
            image = np.full((size[1], size[0], 3), (220, 190, 160), np.uint8)
            u = 10 + 2 * i
            image[50:56, u - 6 : u + 6] = 30
            film.write(image, i / FILM_HZ)
