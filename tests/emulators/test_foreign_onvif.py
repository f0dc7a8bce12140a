"""PyPI's onvif-zeep-async, which Home Assistant and Frigate use, against the emulated ONVIF dome."""

import asyncio
import time

import pytest

from tests.support.onvif_dome import STEP_DEG, OnvifUnit
from tests.support.plants import PASSWORD, USER

pytestmark = pytest.mark.foreign
DEADLINE_S = 60.0  # a program that takes longer hangs
NEAR_DEG = 2 * STEP_DEG


def with_client(unit, work, password=PASSWORD, adjust_time=False):
    """Run ``work`` on a connected `onvif.ONVIFCamera` with its media and PTZ services, and its profile's token."""
    from onvif import ONVIFCamera

    async def session():
        camera = ONVIFCamera(unit.server.host, unit.server.port, USER, password, adjust_time=adjust_time)
        try:
            await camera.update_xaddrs()
            media, ptz = await camera.create_media_service(), await camera.create_ptz_service()
            profiles = await media.GetProfiles()
            return await work(camera, media, ptz, profiles[0])
        finally:
            await camera.close()

    return asyncio.run(asyncio.wait_for(session(), DEADLINE_S))


async def settled(unit):
    end = time.monotonic() + DEADLINE_S
    await asyncio.sleep(0.1)
    while unit.turning():
        assert time.monotonic() < end
        await asyncio.sleep(0.02)


def test_it_reads_what_the_dome_says_of_itself():
    async def work(camera, media, ptz, profile):
        device = await camera.create_devicemgmt_service()
        assert (await device.GetDeviceInformation())["Model"] == "Emulated dome"
        services = await device.GetServices({"IncludeCapability": False})
        assert {each["Namespace"].split("/")[-2] for each in services} == {"device", "media", "ptz"}
        assert profile.VideoEncoderConfiguration.Resolution.Width == 320
        setup = {"Stream": "RTP-Unicast", "Transport": {"Protocol": "RTSP"}}
        address = await media.GetStreamUri({"StreamSetup": setup, "ProfileToken": profile.token})
        assert address.Uri == unit.stream.url
        options = await ptz.GetConfigurationOptions({"ConfigurationToken": profile.PTZConfiguration.token})
        space = options.Spaces.AbsolutePanTiltPositionSpace[0]
        assert (space.XRange.Min, space.YRange.Max) == (-1.0, 1.0)
        nodes = await ptz.GetNodes()
        assert nodes[0].SupportedPTZSpaces.ContinuousPanTiltVelocitySpace[0].XRange.Max == 1.0
        assert (await ptz.GetConfigurations())[0].DefaultPTZTimeout.total_seconds() == 5.0

    with OnvifUnit() as unit:
        with_client(unit, work)


def test_it_moves_the_dome_absolutely_relatively_and_continuously_and_stops_it():
    async def work(camera, media, ptz, profile):
        token = profile.token
        position = {"PanTilt": {"x": 0.25, "y": -0.5}, "Zoom": {"x": 0.5}}
        await ptz.AbsoluteMove({"ProfileToken": token, "Position": position})
        await settled(unit)
        assert (unit.pan.degrees(), unit.tilt.degrees()) == pytest.approx((50.0, 0.0), abs=NEAR_DEG)  # 10 + 160 / 4
        status = await ptz.GetStatus({"ProfileToken": token})
        assert (status.Position.PanTilt.x, status.Position.PanTilt.y) == pytest.approx((0.25, -0.5), abs=1e-3)
        assert status.Position.Zoom.x == pytest.approx(0.5, abs=0.02)
        assert status.MoveStatus.PanTilt == "IDLE"
        await ptz.RelativeMove({"ProfileToken": token, "Translation": {"PanTilt": {"x": -0.125, "y": 0.0}}})
        await settled(unit)
        assert unit.pan.degrees() == pytest.approx(30.0, abs=NEAR_DEG)
        await ptz.ContinuousMove({"ProfileToken": token, "Velocity": {"PanTilt": {"x": -0.5, "y": 0.0}}})
        await asyncio.sleep(0.5)
        assert (await ptz.GetStatus({"ProfileToken": token})).MoveStatus.PanTilt == "MOVING"
        await ptz.Stop({"ProfileToken": token, "PanTilt": True, "Zoom": True})
        await settled(unit)
        assert -40.0 < unit.pan.degrees() < 25.0

    with OnvifUnit() as unit:
        with_client(unit, work)


def test_it_signs_by_the_domes_clock():
    async def work(camera, media, ptz, profile):
        return profile.token

    with OnvifUnit("clock-10h") as unit:
        assert with_client(unit, work, adjust_time=True) == "profile_1"


def test_it_is_refused_with_a_wrong_password():
    async def work(camera, media, ptz, profile):
        raise AssertionError("let in")

    with OnvifUnit() as unit, pytest.raises(Exception, match="Sender not Authorized"):
        with_client(unit, work, "wrong")
