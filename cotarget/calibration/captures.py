"""Captures on disk: images, their index, and the log of the session; and folders of plain photos.

- index.json: schema; board; pitch_mm (or null); captures, one object per image with file, camera, board (number of the
  placement), pan and tilt [rad], focal_px (null for the fixed camera), t [s]. It is replaced atomically after every
  image, so that an interrupted session can be used up to there.
- session.json: schema; versions; config, the rig's whole configuration without passwords (null where none was given).
- commands.jsonl: one object per line and command, written before the next command: t [s], the time of the command; do;
  asked; got. "turn" asks for pan and tilt [rad] and gets those that the head goes to; "zoom" asks for a focal length
  [px] and gets the one that the lens goes to; "present" asks for T_fixed_board and gets null.
"""

import json
import math
import platform
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Ge

from cotarget.calibration.file import check_schema, read_object
from cotarget.calibration.model import CameraName, Capture
from cotarget.config import BoardConfig, RigConfig, WrittenBoard, config_table
from cotarget.errors import CalibrationError, ConfigError
from cotarget.files import write_atomically
from cotarget.rig import Image
from cotarget.schema import Positive, model, validate

SCHEMA = 1
SESSION, COMMANDS = "session.json", "commands.jsonl"
VERSIONS = ("numpy", "scipy", "opencv-python-headless")  # packages on which corners and fits depend


def write_session(directory: Path, config: RigConfig | None) -> None:
    """Write session.json and an empty commands.jsonl."""
    versions = {"cotarget": version("cotarget"), "python": platform.python_version()}
    table = {
        "schema": SCHEMA,
        "versions": versions | {name: _version(name) for name in VERSIONS},
        "config": None if config is None else config_table(config),
    }
    write_atomically(directory / SESSION, json.dumps(table, indent=2).encode() + b"\n")
    write_atomically(directory / COMMANDS, b"")


def write_command(directory: Path, t: float, do: str, asked: Any, got: Any = None) -> None:
    """Append a command to commands.jsonl."""
    path = directory / COMMANDS
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"t": t, "do": do, "asked": asked, "got": got}) + "\n")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:  # such as another build of OpenCV
        return None


INDEX = "index.json"
# zlib's fastest level: noise hardly compresses, and the time is better spent on the search for corners.
PNG_OPTIONS = (cv2.IMWRITE_PNG_COMPRESSION, 1)
LARGEST_ANGLE = 2 * math.pi  # a head stays within one turn to each side [rad]; a larger angle is in degrees


@dataclass(frozen=True)
class CaptureIndex:
    """Content of index.json."""

    board: BoardConfig
    pitch_mm: float | None  # pixel size of the zoom camera [mm]
    captures: tuple[Capture, ...]  # with the file's name as their source and an empty image


@model
class CaptureTable:
    """An image of index.json; the fixed camera may have null for the head's angles, which is 0."""

    file: str
    camera: CameraName
    board: Annotated[int, Ge(0)]
    focal_px: Positive | None
    t: float
    pan: float | None = None
    tilt: float | None = None

    def __post_init__(self) -> None:
        if Path(self.file).is_absolute() or ".." in Path(self.file).parts:
            raise ValueError(f"file: {self.file!r} is not inside the folder of the index")
        for key, angle in (("pan", self.pan), ("tilt", self.tilt)):
            if angle is None and self.camera == "zoom":
                raise ValueError(f"{key}: is missing; an image of the zoom camera needs the head's pan and tilt")
            if angle is not None and abs(angle) > LARGEST_ANGLE:
                raise ValueError(f"{key}: {angle:g} is more than a whole turn in radians; it looks like degrees")

    def capture(self) -> Capture:
        """Make the capture, with an empty image."""
        return Capture(
            NO_IMAGE, self.camera, self.board, self.pan or 0.0, self.tilt or 0.0, self.focal_px, self.t, self.file
        )


@model
class IndexTable:
    """Content of index.json."""

    schema: int
    board: WrittenBoard
    pitch_mm: Positive | None
    captures: tuple[CaptureTable, ...]

    def __post_init__(self) -> None:
        if not self.captures:
            raise ValueError("captures: is empty")


NO_IMAGE: Image = np.zeros((0, 0, 3), np.uint8)


def write_image(path: Path, image: Image) -> None:
    """Write a PNG atomically."""
    ok, data = cv2.imencode(".png", image, PNG_OPTIONS)
    if not ok:
        raise CalibrationError(f"{path}: OpenCV cannot encode the image")
    write_atomically(path, data.tobytes())


def write_index(directory: Path, index: CaptureIndex) -> None:
    """Write index.json atomically."""
    keys = ("camera", "board", "pan", "tilt", "focal_px", "t")
    rows = ",\n    ".join(
        json.dumps({"file": capture.source} | {key: getattr(capture, key) for key in keys}, allow_nan=False)
        for capture in index.captures
    )
    text = (
        f'{{\n  "schema": {SCHEMA},\n  "board": {json.dumps(vars(index.board))},\n'
        f'  "pitch_mm": {json.dumps(index.pitch_mm)},\n  "captures": [\n    {rows}\n  ]\n}}\n'
    )
    write_atomically(directory / INDEX, text.encode())


def read_index(directory: Path) -> CaptureIndex:
    """Read index.json; an error names the file and the key."""
    path = directory / INDEX
    if not directory.is_dir():
        raise CalibrationError(f"{directory}: no such folder; give a folder of captures")
    table = read_object(path, "give a folder of captures, as cotarget calibrate --captures DIR makes one")
    check_schema(path, table, SCHEMA)
    try:
        index = validate(IndexTable, table, "")
        captures = tuple(row.capture() for row in index.captures)
        _check_files(directory, captures)
    except (ConfigError, CalibrationError) as error:
        raise CalibrationError(f"{path}: {error}") from None
    return CaptureIndex(index.board.config(), index.pitch_mm, captures)


def read_images(directory: Path, captures: Sequence[Capture]) -> Iterator[Capture]:
    """Read the images of captures one by one; all images of a camera must have one size."""
    sizes: dict[CameraName, tuple[str, tuple[int, int]]] = {}
    for capture in captures:
        assert capture.source is not None
        image = read_image(directory / capture.source)
        size = (image.shape[1], image.shape[0])
        first, expected = sizes.setdefault(capture.camera, (capture.source, size))
        if size != expected:
            raise CalibrationError(
                f"{directory / capture.source}: is {size[0]}x{size[1]} px where {first} of the same camera is "
                f"{expected[0]}x{expected[1]}"
            )
        yield replace(capture, image=image)


def read_image(path: Path) -> Image:
    """Read an image as BGR and as the sensor has it, like live ones; an EXIF orientation does not turn it."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from None
    image = (
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION) if data else None
    )
    if image is None:
        raise CalibrationError(f"{path}: is not an image that OpenCV reads")
    return np.asarray(image, dtype=np.uint8)


def pair_photos(directory: Path, fixed_glob: str, zoom_glob: str) -> tuple[list[Capture], list[str]]:
    """Pair plain photos of two cameras by the last number in their names.

    Returns captures with empty images and the number as the placement, and the names of files without a partner.
    """
    if not directory.is_dir():
        raise CalibrationError(f"{directory}: no such folder; give a folder of photos")
    found: dict[CameraName, dict[int, str]] = {
        "fixed": _numbered(directory, fixed_glob),
        "zoom": _numbered(directory, zoom_glob),
    }
    if twice := sorted(set(found["fixed"].values()) & set(found["zoom"].values())):
        raise CalibrationError(
            f"{directory}: {twice[0]} matches both '{fixed_glob}' and '{zoom_glob}'; tell them apart"
        )
    both = sorted(found["fixed"].keys() & found["zoom"].keys())
    captures = [
        Capture(NO_IMAGE, camera, number, source=names[number]) for camera, names in found.items() for number in both
    ]
    unpaired = [name for names in found.values() for number, name in sorted(names.items()) if number not in both]
    return captures, unpaired


def matching(directory: Path, pattern: str) -> list[Path]:
    """List the files that match a pattern, sorted, without hidden ones, such as the rest of an interrupted write."""
    try:
        return sorted(path for path in directory.glob(pattern) if path.is_file() and not path.name.startswith("."))
    except (ValueError, NotImplementedError):
        raise CalibrationError(f"'{pattern}': is not a pattern of file names; give one like 'left*.jpg'") from None


def _numbered(directory: Path, pattern: str) -> dict[int, str]:
    """Map the last number in each file's name to the name."""
    paths = matching(directory, pattern)
    if not paths:
        raise CalibrationError(f"{directory}: no file matches '{pattern}'")
    names: dict[int, str] = {}
    for path in paths:
        digits = re.findall(r"\d+", path.stem)
        if not digits:
            raise CalibrationError(f"{path}: has no number in its name by which to pair it")
        number = int(digits[-1])
        if number in names:
            raise CalibrationError(f"{path}: has the same number as {names[number]}, {number}; pairs need one each")
        names[number] = path.relative_to(directory).as_posix()
    return names


def _check_files(directory: Path, captures: Sequence[Capture]) -> None:
    """Refuse an index that lists a file twice, or one that is not in the folder."""
    first: dict[str, int] = {}
    for i, capture in enumerate(captures):
        assert capture.source is not None
        name = Path(capture.source).as_posix()
        if name in first:
            raise CalibrationError(f"captures[{i}].file: {name} is captures[{first[name]}] already")
        first[name] = i
        if not (directory / name).is_file():
            raise CalibrationError(f"captures[{i}].file: {name}: no such file in the folder")
