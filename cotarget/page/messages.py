"""Define what page and server say to each other.

A browser sends small JSON objects, whose models are here; anything else costs it its socket. The server sends text, a
`Status` every 100 ms or a sentence, and pictures: the length of a JSON table, the table, and a JPEG a camera. The page
of a recorded run has the same table for each of its steps.
"""

import json
import math
import struct
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from cotarget.errors import CotargetError
from cotarget.estimation.motion_model import GATE
from cotarget.pipeline import HEAD, Step
from cotarget.rig import Frame, Image, RigSpec

MAX_BYTES = 4096  # of a message of a browser
LONGEST_NAME = 64  # characters
WIDEST_PX = 960  # a wider picture is made smaller before it is sent
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 80]

Part = Annotated[float, Field(ge=-1, le=1)]
Name = Annotated[str, Field(max_length=LONGEST_NAME)]
Pixel = Annotated[float, Field(ge=-1e5, le=1e5)]


class Message(BaseModel):
    """A message of a browser."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


class Hello(Message):
    """The first message: the token, and who the page is; a page that is opened again by reload says the same."""

    do: Literal["hello"]
    token: Name
    who: Name


class Drawn(Message):
    """The page has drawn picture n, and wants the newest."""

    do: Literal["drawn"]
    n: int


class Simple(Message):
    """Stop, clear the stop, or take control."""

    do: Literal["stop", "clear", "take"]


class Record(Message):
    """Begin a recording, or complete it."""

    do: Literal["record"]
    on: bool


class ToHead(Message):
    """Let a head stand, or send it home."""

    do: Literal["stand", "home"]
    of: Name


class Follow(Message):
    """Follow a track, or what is at a pixel of the fixed image, or what the policy selects."""

    do: Literal["follow"]
    of: Name
    track: int | None = None
    click: tuple[Pixel, Pixel] | None = None


class Manual(Message):
    """Turn a head by hand; it quotes the newest tick of the server, so that an old message moves nothing."""

    do: Literal["manual"]
    of: Name
    rates: tuple[Part, Part]
    tick: int


class Zoom(Message):
    """Multiply a head's focal length; it quotes the newest tick too."""

    do: Literal["zoom"]
    of: Name
    factor: Annotated[float, Field(ge=0.5, le=2)]
    tick: int


Incoming = Hello | Drawn | Simple | Record | ToHead | Follow | Manual | Zoom
PARSER: TypeAdapter[Incoming] = TypeAdapter(Annotated[Incoming, Field(discriminator="do")])


class BadMessageError(CotargetError):
    """A browser has sent what is no message."""


def parse(data: str | bytes) -> Incoming:
    """Parse a message of a browser.

    Raises:
        BadMessageError: it is none.
    """
    try:
        return PARSER.validate_json(data)
    except ValueError:  # pydantic's own is one
        raise BadMessageError("this is no message of the page") from None


# Pictures


def pack(step: Step, n: int, spec: RigSpec, skipped: int, made: float) -> bytes:
    """Pack both cameras' pictures of a step and what belongs to them.

    Args:
        step: the step.
        n: number of the picture.
        spec: the rig.
        skipped: frames of the fixed camera that were not worked on since the run began.
        made: when the step was done, by the clock on the wall [s since 1970].
    """
    jpegs = [_jpeg(image) for image in pictures(step).values()]
    table = describe(step, spec, skipped) | {"n": n, "made": made}
    for camera, jpeg in zip(table["cameras"].values(), jpegs, strict=True):
        camera["bytes"] = len(jpeg)
    head = json.dumps(table, allow_nan=False).encode()
    return b"".join([struct.pack(">I", len(head)), head, *jpegs])


def pictures(step: Step) -> dict[str, Image]:
    """Return both cameras' images by name, at most `WIDEST_PX` wide."""
    return {name: _narrowed(frame.image) for name, frame in _frames(step).items()}


def describe(step: Step, spec: RigSpec, skipped: int) -> dict[str, Any]:
    """Describe a step as the page's drawing wants it; arguments as for `pack`."""
    return {
        "t": step.t,
        "cameras": {
            name: {"size": list(frame.image.shape[1::-1]), "age_s": step.t - frame.t}
            for name, frame in _frames(step).items()
        },
        "tracks": [
            [track.id, *_rounded(track.center_px), *_rounded(track.whole_px)] for track in step.tracks if track.reported
        ],
        "heads": {HEAD: _head(step, spec)},
        "steps": step.index + 1,
        "skipped": skipped,
    }


def _frames(step: Step) -> dict[str, Frame]:
    return {"fixed": step.fixed, "zoom": step.zoom}


def _head(step: Step, spec: RigSpec) -> dict[str, Any]:
    """Describe a head: state, aim, limits, and where its camera should show the target."""
    limits, (pan, tilt, focal_px) = spec.head.limits, step.commanded
    return {
        "camera": "zoom",
        "state": step.state,
        "reason": step.reason,
        "track": None if step.target is None else step.target.id,
        "pan_deg": math.degrees(step.head.pan),
        "tilt_deg": math.degrees(step.head.tilt),
        "moving": step.head.moving,
        "pan_range_deg": _degrees(limits.pan.range),
        "tilt_range_deg": _degrees(limits.tilt.range),
        "commanded": [math.degrees(pan), math.degrees(tilt), focal_px],
        "focal_px": step.lens.focal_px,
        "focal_range_px": list(spec.zoom.focal_range),
        "range_m": None if step.aim is None else step.aim.range,
        "predicted": _predicted(step),
        "found": None if step.found is None or step.found.t != step.zoom.t else _rounded(step.found.center_px),
    }


def _predicted(step: Step) -> dict[str, Any] | None:
    """Predict the target in the zoom image: centre, half axes and turn of its ellipse, error, size [px]."""
    seen = step.expected
    if seen is None:
        return None
    variances, axes = np.linalg.eigh(seen.covariance)
    height, width = step.zoom.image.shape[:2]
    center = np.array([width - 1, height - 1]) / 2 + seen.offset_px
    values = np.array([*center, *np.sqrt(np.maximum(variances[::-1], 0.0)), seen.size_px])
    if not np.isfinite(values).all():
        return None
    u, v, longer, shorter, size_px = values.tolist()
    gate, turn = math.sqrt(GATE), math.atan2(axes[1, 1], axes[0, 1])
    half = [gate * longer, gate * shorter]
    return {"at": [u, v], "axes": half, "turn": turn, "error_px": longer, "size_px": size_px}


def _degrees(ends: tuple[float, float]) -> list[float | None]:
    """Both ends of a range [degrees]; None for an axis without an end."""
    return [math.degrees(end) if math.isfinite(end) else None for end in ends]


def _rounded(pair: Any) -> list[float]:
    return [round(float(each), 1) for each in pair]


def _narrowed(image: Image) -> Image:
    """Make an image smaller that is wider than `WIDEST_PX`."""
    height, width = image.shape[:2]
    if width <= WIDEST_PX:
        return image
    size = WIDEST_PX, max(round(height * WIDEST_PX / width), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.uint8)


def _jpeg(image: Image) -> bytes:
    return cv2.imencode(".jpg", image, JPEG)[1].tobytes()
