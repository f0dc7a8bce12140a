"""Drivers of real devices, a file each, and the table of their names; docs/drivers.md says how to write one."""

from collections.abc import Mapping

# By table of [hardware]: the names that its key `driver` takes, the default first, and the class that each means. The
# class is imported when a rig.toml names it, and the device's library when the device is opened. A table of
# [hardware.ptz] has no default.
DRIVERS: Mapping[str, Mapping[str, str]] = {
    "fixed": {"axis": "cotarget.drivers.axis:AxisCamera", "stream": "cotarget.drivers.stream:StreamCamera"},
    "zoom": {"gphoto2": "cotarget.drivers.gphoto_camera:GphotoCamera"},
    "head": {"ptu_d46": "cotarget.drivers.ptu_d46:D46Head"},
    "ptz": {"onvif": "cotarget.drivers.onvif:OnvifDome", "visca": "cotarget.drivers.visca:ViscaDome"},
}
