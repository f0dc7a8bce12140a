"""Debian's gphoto2 on the emulated PowerShot S5 IS: libgphoto2's own Canon code zooms, looks and shoots."""

import os
import re
import shutil
import subprocess
import time

import cv2
import numpy as np
import pytest

from cotarget.emulators.canon_s5is import S5isServer
from cotarget.emulators.plant import Feed
from tests.support.emulated_camera import LensModel, publish

pytestmark = pytest.mark.foreign
TIMEOUT_S = 60  # gphoto2's own waits add up to a few seconds
# Grey levels by which the decoded JPEG of an even area may differ, colours too.
GREY = 4.0
STILL_SIZE = (3264, 2448)
# Lines that gphoto2 printed of a real camera (camlibs/ptp2/cameras/canon-s5.txt): in both modes, and in shooting mode.
ALWAYS = (
    "Model: Canon PowerShot S5 IS",
    "Generic Image Capture, No Open Capture, Canon Capture",
    "Event Emulate Mode(0xd045):(readwrite) (type=0x4) Enumeration [1,2,3,4,5,6,7] value:",
    "Size of Output Data from Camera(0xd02e):(read only) (type=0x6) 524288",
    "a[6] 2448,3264,11,0,0,0,",
)
SHOOTING = (
    "Capture Transfer Mode(0xd029):(readwrite) (type=0x4) Enumeration [1,2,3] value:",
    "Image Quality(0xd006):(readwrite) (type=0x2) Enumeration [5,3,2] value:",
    "Image Size(0xd008):(readwrite) (type=0x2) Enumeration [0,1,3,7,2] value:",
    "Zoom(0xd02a):(readwrite) (type=0x4) Range [0 - 134, step 1] value:",
    "Av Open Apex(0xd038):(read only) (type=0x4) 27",
    "EZoom Start Position(0xd03d):(read only) (type=0x4) 129",
)
KEYS = {"focuslock", "datetime", "ownername", "capturetarget", "capture", "imagequality", "imagesize", "iso"}
KEYS |= {"whitebalance", "zoom", "assistlight", "flashmode", "shootingmode", "aperture", "shutterspeed", "meteringmode"}


def scene(size, position):
    """Blue above, and below a grey that tells the lens's position; in the right half green."""
    width, height = size
    image = np.full((height, width, 3), position, np.uint8)
    image[: height // 2] = (255, 0, 0)
    image[:, width // 2 :] = (0, 200, 0)
    return image


def assert_shows(path, size, position):
    image = cv2.imread(str(path))
    assert image.shape == (size[1], size[0], 3)
    width, height = size
    expected = {(1, 1): (255, 0, 0), (1, 3): (position,) * 3, (3, 1): (0, 200, 0), (3, 3): (0, 200, 0)}
    for (u, v), colour in expected.items():
        np.testing.assert_allclose(image[height * v // 4, width * u // 4], colour, atol=GREY)


class View(Feed):
    """What a lens shows when it is asked for, and not some time before: `scene`."""

    def __init__(self, lens):
        super().__init__()
        self.lens, self.index = lens, 0

    def newest(self, after=-1, timeout=0.0):
        self.index = max(self.index, after) + 1
        publish(self, self.index, scene((640, 480), self.lens.position()))
        return super().newest(after, timeout)


@pytest.fixture
def camera():
    """An emulated camera that sees `scene`, with its lens as an attribute."""
    lens = LensModel()
    with S5isServer(View(lens), lambda: scene(STILL_SIZE, lens.position()), lens) as server:
        server.lens = lens
        yield server


@pytest.fixture
def gphoto2(camera, tmp_path):
    """Runs gphoto2 with settings of its own."""
    program = shutil.which("gphoto2")
    assert program, "gphoto2 is missing: apt-get install gphoto2"
    port = f"ptpip:127.0.0.1:{camera.port}:{camera.port}"

    def run(*arguments):
        return subprocess.run(
            [program, "--camera", "PTP/IP Camera", "--port", port, "--force-overwrite", *arguments],
            env={**os.environ, "HOME": str(tmp_path), "LANG": "C"},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )

    return run


def said(done):
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_it_is_recognised_as_an_s5_is(gphoto2):
    playing = said(gphoto2("--summary"))
    shooting = said(gphoto2("--set-config", "capture=1", "--summary"))
    for line in ALWAYS:
        assert line in playing, line
        assert line in shooting, line
    for line in SHOOTING:
        assert line not in playing, line
        assert line in shooting, line


def test_its_settings(gphoto2):
    assert "/zoom" not in said(gphoto2("--list-config"))
    keys = {
        line.rpartition("/")[2] for line in said(gphoto2("--set-config", "capture=1", "--list-config")).splitlines()
    }
    assert keys >= KEYS
    everything = said(gphoto2("--list-all-config"))  # it goes on shooting; each setting is read
    assert "Error" not in everything
    assert "/zoom" in everything
    said(gphoto2("--set-config", "capture=0"))
    assert "/zoom" not in said(gphoto2("--list-config"))


def test_it_zooms(gphoto2, camera):
    for position, lens in ((64, 64), (0, 0), (105, 105), (128, 128), (131, 128)):
        zoom = said(gphoto2("--set-config", "capture=1", "--set-config", f"zoom={position}", "--get-config", "zoom"))
        assert re.search(r"^Current: (\d+)$", zoom, re.MULTILINE)[1] == str(position)
        assert re.search(r"^Bottom: 0\nTop: 134\nStep: 1$", zoom, re.MULTILINE)
        assert camera.lens.position() == lens
    moves = len(camera.lens.commands)
    refused = gphoto2("--set-config", "zoom=200")
    assert refused.returncode != 0
    assert "Bad parameters" in refused.stdout + refused.stderr
    assert len(camera.lens.commands) == moves


def test_it_gives_previews_and_stills(gphoto2, camera, tmp_path):
    zoomed = ("--set-config", "capture=1", "--set-config", "zoom=90")
    said(gphoto2(*zoomed, "--capture-preview", "--capture-image-and-download"))
    assert camera.lens.position() == 90
    assert_shows(tmp_path / "capture_preview.jpg", (320, 240), 90)
    assert_shows(tmp_path / "capt0000.jpg", STILL_SIZE, 90)


def test_it_takes_a_still_in_play_mode(gphoto2, tmp_path):
    said(gphoto2("--capture-image-and-download", "--filename", "still.jpg"))
    assert_shows(tmp_path / "still.jpg", STILL_SIZE, 0)


@pytest.mark.parametrize("fault", ["busy", "hung", "gone", "power-off"])
def test_faults_end_in_an_error_message(gphoto2, camera, fault):
    said(gphoto2("--set-config", "capture=1"))
    camera.faults.set(fault)
    failed = gphoto2("--set-config", "capture=1", "--set-config", "zoom=50")
    assert failed.returncode != 0
    assert "*** Error" in failed.stdout + failed.stderr
    assert 50 not in camera.lens.commands
    camera.faults.set(fault, False)
    deadline = time.monotonic() + TIMEOUT_S
    while gphoto2("--set-config", "capture=1", "--set-config", "zoom=51").returncode:
        assert time.monotonic() < deadline
    assert camera.lens.position() == 51
