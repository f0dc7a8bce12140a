"""Other programs against the RTSP server: ffmpeg and OpenCV's VideoCapture."""

import contextlib
import shutil
import subprocess

import cv2
import numpy as np
import pytest

from cotarget.emulators.rtsp import RTSP_FAULTS, EncodedStream, Encoder, RtspServer
from cotarget.emulators.serve import Faults
from tests.emulators.test_foreign_axis import RATE_HZ, SIZE, consecutive, number_of, numbered
from tests.support.emulated_camera import Film

pytestmark = pytest.mark.foreign
DEADLINE_S = 60.0  # a program that takes longer hangs


@contextlib.contextmanager
def emulated(password="pass"):
    """The server, and its address with user and password."""
    faults = Faults(RTSP_FAULTS)
    with (
        Film(numbered, 1 / RATE_HZ) as film,
        contextlib.closing(Encoder(film.feed, stream := EncodedStream(), RATE_HZ, faults=faults)),
        RtspServer(stream, user="root", password="pass", faults=faults) as server,
    ):
        yield server.url.replace("://", f"://root:{password}@")


def ffmpeg(url, *options):
    program = shutil.which("ffmpeg")
    assert program, "ffmpeg is missing: apt-get install ffmpeg"
    command = [program, "-nostdin", "-loglevel", "error", *options, "-i", url, "-frames:v", "30"]
    command += ["-f", "rawvideo", "-pix_fmt", "bgr24", "-fps_mode", "passthrough", "-"]
    return subprocess.run(command, capture_output=True, timeout=DEADLINE_S, check=False)


@pytest.mark.parametrize("options", [["-rtsp_transport", "tcp"], []], ids=["tcp", "tcp after udp was refused"])
def test_ffmpeg_reads_the_stream(options):
    with emulated() as url:
        done = ffmpeg(url, *options)
    assert done.returncode == 0, done.stderr.decode()
    frames = np.frombuffer(done.stdout, np.uint8).reshape(30, SIZE[1], SIZE[0], 3)
    assert consecutive([number_of(frame) for frame in frames])


def test_ffmpeg_is_refused_with_a_wrong_password():
    with emulated("wrong") as url:
        done = ffmpeg(url, "-rtsp_transport", "tcp")
    assert done.returncode != 0
    assert b"401 Unauthorized" in done.stderr


def test_several_videocaptures_read_the_stream():
    with emulated() as url, contextlib.ExitStack() as opened:
        captures = [cv2.VideoCapture(url, cv2.CAP_FFMPEG) for _ in range(3)]
        for capture in captures:
            opened.callback(capture.release)
        assert all(capture.isOpened() for capture in captures)
        reads = [[capture.read() for _ in range(25)] for capture in captures]
    for read in reads:
        assert all(good for good, _ in read)
        assert consecutive([number_of(image) for _, image in read])
