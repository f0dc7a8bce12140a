"""The emulated VISCA camera driven by PyPI's visca-over-ip, in an environment where it is installed.

The library binds the camera's port on all addresses for inquiries, so that the emulator has that port on 127.0.0.2.
"""

import time

import pytest

from tests.support.plants import LiveDome, wait_for

pytestmark = [pytest.mark.foreign, pytest.mark.wire]
PORT, OTHER_HOST = 52381, "127.0.0.2"


def test_visca_over_ip_turns_zooms_and_reads_back():
    library = pytest.importorskip("visca_over_ip")
    with LiveDome(host=OTHER_HOST, ports=(PORT, 0, 0)) as live:
        camera = library.Camera(OTHER_HOST, PORT)
        try:
            camera.pantilt(pan_speed=24, tilt_speed=18, pan_position=-1440, tilt_position=144)  # -100 and 10 degrees
            wait_for(lambda: live.at() == (-1440, 144))
            assert camera.get_pantilt_position() == (-1440, 144)
            camera.zoom_to(0.5)
            wait_for(lambda: live.lens.position() > 0)
            time.sleep(0.6)  # the lens travels
            assert camera.get_zoom_position() == 0x2000
            camera.pantilt(pan_speed=-10, tilt_speed=0)
            wait_for(live.turning)
            camera.pantilt(pan_speed=0, tilt_speed=0)
            wait_for(lambda: not live.turning())
            camera.set_power(False)
            assert not live.camera.is_on
            with pytest.raises(library.exceptions.ViscaException, match="Command not executable"):
                camera.pantilt_home()
            camera.set_power(True)
            camera.pantilt_home()
            wait_for(lambda: live.at() == (0, 0))
        finally:
            camera.close_connection()
