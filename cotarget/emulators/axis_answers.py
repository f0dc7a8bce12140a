"""What an Axis 241Q answers in plain text: its parameters, its inputs, the size of a picture, and a head it has not."""

from collections.abc import Callable, Iterable, Mapping
from http import HTTPStatus

from cotarget.emulators.axis_http import HttpError
from cotarget.emulators.axis_pictures import DEFAULT_COMPRESSION, INPUTS, Size

# The 241Q's last firmware; VAPIX 2 goes with it.
FIRMWARE = "4.48"
# Arguments of ptz.cgi that ask for motion.
PTZ_MOTIONS = ("move", "pan", "tilt", "rpan", "rtilt", "zoom", "rzoom", "center", "areazoom")


def parameters(serial: str, standard: str, sizes: Iterable[str], resolutions: Iterable[str]) -> dict[str, str]:
    """The parameters that `param.cgi` lists, in its order.

    Args:
        serial: number of the unit.
        standard: of the television signal.
        sizes: the names of those that it has.
        resolutions: what each input gives to a client that asks for no size.
    """
    sizes = list(sizes)
    listed = {
        "Brand.Brand": "AXIS",
        "Brand.ProdFullName": "AXIS 241Q Video Server",
        "Brand.ProdNbr": "241Q",
        "Brand.ProdShortName": "AXIS 241Q",
        "Brand.ProdType": "Video Server",
        "Brand.WebURL": "http://www.axis.com",
        "Image.NbrOfConfigs": str(len(INPUTS)),
    }
    for i, resolution in enumerate(resolutions):
        listed |= {
            f"Image.I{i}.Name": f"Video {i + 1}",
            f"Image.I{i}.Source": str(i),
            f"Image.I{i}.Appearance.Resolution": resolution,
            f"Image.I{i}.Appearance.Compression": str(DEFAULT_COMPRESSION),
            f"Image.I{i}.Appearance.ColorEnabled": "yes",
            f"Image.I{i}.Appearance.MirrorEnabled": "no",
            f"Image.I{i}.Appearance.Rotation": "0",
            f"Image.I{i}.Stream.Duration": "0",
            f"Image.I{i}.Stream.FPS": "0",
            f"Image.I{i}.Stream.NbrOfFrames": "0",
        }
    listed["ImageSource.NbrOfSources"] = str(len(INPUTS))
    for i in range(len(INPUTS)):
        listed |= {f"ImageSource.I{i}.Name": f"Video {i + 1}", f"ImageSource.I{i}.Video.DetectedType": standard}
    listed |= {
        "Properties.API.HTTP.AdminPath": "/operator/basic.shtml",
        "Properties.API.HTTP.Version": "2",
        "Properties.Firmware.BuildDate": "Jan 01 2009 12:00",
        "Properties.Firmware.BuildNumber": "1",
        "Properties.Firmware.Version": FIRMWARE,
        "Properties.Image.Format": "jpeg,mjpeg",
        "Properties.Image.Resolution": ",".join(sizes),
        "Properties.PTZ.PTZ": "no",
        "Properties.System.SerialNumber": serial,
    }
    return {f"root.{name}": value for name, value in listed.items()}


def list_parameters(listed: Mapping[str, str], arguments: Mapping[str, str]) -> str:
    """Answer `param.cgi?action=list`, with ``group`` for some only; an unknown group is told of in the text."""
    if arguments.get("action") != "list":
        return f"# Error: Unknown action '{arguments.get('action', '')}'\n"
    lines = []
    for group in arguments.get("group", "root").split(","):
        name = group if group == "root" or group.startswith("root.") else f"root.{group}"
        found = [f"{key}={value}" for key, value in listed.items() if f"{key}.".startswith(f"{name}.")]
        lines += found or [f"# Error: Error -1 getting param in group '{group}'"]
    return "".join(f"{line}\n" for line in lines)


def video_status(video: Callable[[int], bool], arguments: Mapping[str, str]) -> str:
    """Answer `videostatus.cgi?status=1,2`: which inputs have a signal.

    Raises:
        HttpError: the server has no such input (400).
    """
    asked = arguments.get("status", ",".join(map(str, INPUTS))).split(",")
    if not set(asked) <= set(map(str, INPUTS)):
        raise HttpError(HTTPStatus.BAD_REQUEST)
    return "".join(f"Video {number} = {'video' if video(int(number)) else 'no video'}\n" for number in asked)


def image_size(size: Size) -> str:
    """Answer `imagesize.cgi`."""
    return f"image width = {size[0]}\nimage height = {size[1]}\n"


def fixed_ptz(arguments: Mapping[str, str]) -> str | None:
    """Answer `com/ptz.cgi` for a camera that stands still; None where there is nothing to say (204).

    It is at zero and can go nowhere else, and an order to move is refused. The real server's words are not known.
    """
    match arguments.get("query"):
        case "position":
            return "pan=0\ntilt=0\nzoom=1\n"
        case "limits":
            return "MinPan=0\nMaxPan=0\nMinTilt=0\nMaxTilt=0\nMinZoom=1\nMaxZoom=1\n"
        case None:
            moves = any(name in arguments for name in PTZ_MOTIONS)
            return "Error: this camera has no pan, tilt or zoom\n" if moves else None
        case query:
            return f"Error: unknown query '{query}'\n"
