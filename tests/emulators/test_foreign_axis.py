"""Other programs against the emulated Axis 241Q: curl, ffmpeg, OpenCV's VideoCapture and PyPI's axis."""

import asyncio
import contextlib
import shutil
import subprocess

import cv2
import numpy as np
import pytest

from cotarget.emulators.axis_241q import AxisServer
from tests.support.emulated_camera import Film
from tests.support.plants import decoded

pytestmark = pytest.mark.foreign
SIZE = (640, 480)
RATE_HZ = 25.0
# A program that takes longer hangs [s].
DEADLINE_S = 60.0
# JPEG's, and YUV's, error in the mean of a flat area [grey levels].
LEVELS = 4.0
BACKGROUND = (160, 90, 30)
# A picture carries its number as so many black or white squares of this side along its top [px].
BITS, SQUARE = 16, 40
STREAM = "/axis-cgi/mjpg/video.cgi"


def numbered(index):
    image = np.full((SIZE[1], SIZE[0], 3), BACKGROUND, np.uint8)
    for bit in range(BITS):
        image[:SQUARE, bit * SQUARE : (bit + 1) * SQUARE] = 255 if index >> bit & 1 else 0
    return image


def number_of(image):
    """The number that was drawn into a picture, whatever its size now; its background is checked as well."""
    side_u, side_v = image.shape[1] / BITS, image.shape[0] * SQUARE / SIZE[1]
    np.testing.assert_allclose(image[int(2 * side_v) :].mean((0, 1)), BACKGROUND, atol=LEVELS)
    return sum(1 << bit for bit in range(BITS) if image[int(side_v / 2), int((bit + 0.5) * side_u)].mean() > 128)


@contextlib.contextmanager
def emulated(**options):
    with Film(numbered, 1 / RATE_HZ) as film, AxisServer({1: film.feed}, quality=90, **options) as server:
        yield server


def run(*command):
    """What another program writes to stdout; it must be installed, and succeed."""
    program = shutil.which(command[0])
    assert program, f"{command[0]} is missing: apt-get install {command[0]}"
    done = subprocess.run([program, *command[1:]], capture_output=True, timeout=DEADLINE_S, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout


def consecutive(numbers):
    """Whether numbers grow, and nearly always by one: a loaded machine may drop a picture, but repeats none."""
    steps = np.diff(numbers)
    return steps.min() >= 1 and np.median(steps) == 1


def curl(*arguments):
    return run("curl", "--silent", "--show-error", "--fail", "--max-time", "30", *arguments)


@pytest.mark.parametrize("auth", ["digest", "basic"])
def test_curl_authenticates_itself(auth):
    with emulated(user="root", password="pass", auth=auth) as server:
        target = f"{server.url}/axis-cgi/admin/param.cgi?action=list&group=root.Brand"
        assert b"root.Brand.ProdNbr=241Q\n" in curl(f"--{auth}", "--user", "root:pass", target)
        assert b"root.Brand.ProdNbr=241Q\n" in curl("--anyauth", "--user", "root:pass", target)
        for more in (["--user", "root:wrong"], []):
            status = run("curl", "--silent", "--output", "-", "--write-out", "%{http_code}", f"--{auth}", *more, target)
            assert status.endswith(b"401")


def ffmpeg_frames(url, count, size=SIZE):
    raw = run(
        "ffmpeg", "-nostdin", "-loglevel", "error", "-f", "mpjpeg", "-i", url, "-frames:v", str(count),
        "-f", "rawvideo", "-pix_fmt", "bgr24", "-fps_mode", "passthrough", "-",
    )  # fmt: skip
    return np.frombuffer(raw, np.uint8).reshape(count, size[1], size[0], 3)


def test_ffmpeg_authenticates_itself_and_gets_the_size_it_asked_for():
    with emulated(user="root", password="pass") as server:
        url = server.url.replace("://", "://root:pass@")
        frames = ffmpeg_frames(f"{url}/mjpg/1/video.mjpg?resolution=CIF", 5, (352, 288))
    assert consecutive([number_of(frame) for frame in frames])


def test_videocapture_reads_the_stream():
    with emulated() as server:
        capture = cv2.VideoCapture(f"{server.url}{STREAM}?resolution=4CIF", cv2.CAP_FFMPEG)
        try:
            assert capture.isOpened()
            reads = [capture.read() for _ in range(15)]
        finally:
            capture.release()
    assert all(good for good, _ in reads)
    assert reads[0][1].shape == (576, 704, 3)
    assert consecutive([number_of(image) for _, image in reads])


def with_axis(server, work, password="pass"):
    """Run ``work`` on an `axis.AxisDevice` that is connected to the server; both packages must be installed."""
    import axis
    import httpx
    from axis.models.configuration import Configuration

    async def session():
        port = int(server.url.rpartition(":")[2])
        async with httpx.AsyncClient() as client:
            device = axis.AxisDevice(Configuration(client, "127.0.0.1", username="root", password=password, port=port))
            return await asyncio.wait_for(work(device), DEADLINE_S)

    return asyncio.run(session())


def test_pypi_axis_lists_parameters_and_takes_a_picture():
    async def work(device):
        vapix = device.vapix
        assert await vapix.params.brand_handler.update()
        assert await vapix.params.image_handler.update()
        assert (vapix.product_number, vapix.product_type) == ("241Q", "Video Server")
        assert vapix.params.brand_handler["0"].product_full_name == "AXIS 241Q Video Server"
        assert sorted(vapix.params.image_handler.keys()) == ["0", "1", "2", "3"]
        assert vapix.params.image_handler["0"].appearance["Resolution"] == "640x480"
        image = vapix.params.image_handler["1"]
        assert (image.name, image.appearance["Resolution"]) == ("Video 2", "4CIF")
        assert not await vapix.api_discovery.update()  # 404: younger than VAPIX 2
        assert not await vapix.params.io_port_handler.update()  # a group that the list does not have
        number_of(decoded(await vapix.request("get", "/axis-cgi/jpg/image.cgi")))

    with emulated(user="root", password="pass") as server:
        with_axis(server, work)
        with pytest.raises(Exception, match="401") as caught:
            with_axis(server, lambda device: device.vapix.request("get", "/axis-cgi/jpg/image.cgi"), "wrong")
        assert type(caught.value).__name__ == "Unauthorized"
