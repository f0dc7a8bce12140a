"""Run an ONNX file by OpenCV, or by onnxruntime where OpenCV cannot.

OpenCV does not say which input a file declares, and runs a file of another input with wrong results. So the declaration
is read from the file, by the field numbers of onnx.proto.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from cotarget.errors import ConfigError, install_extra
from cotarget.geometry import Array

FLOAT32 = 1  # in onnx.proto
LONGEST_VARINT = 10  # [bytes]

Outputs = Mapping[str, Array]
Run = Callable[[Array], Outputs]


class OnnxFile:
    """A network that takes images as 1 x 3 x height x width.

    Attributes:
        path: the file.
        side: width and height of the input [px], (2,).
        runtime: what runs it, "OpenCV" or "onnxruntime".
    """

    def __init__(self, path: Path, input_px: tuple[int, int] | None = None) -> None:
        """Load a file and run it once.

        Args:
            path: the file.
            input_px: width and height of the input, where the file leaves them open [px].

        Raises:
            ConfigError: there is no such file, it cannot be run, or takes something else.
        """
        if not path.is_file():
            raise ConfigError(f"{path}: no such file; network.model is a network as an ONNX file")
        self.path = path
        declared = _image_input(path)
        self.side = np.array(_size(path, declared, input_px))
        grey = np.full((1, 3, *self.side[::-1]), 0.5, np.float32)
        reasons = []
        for runtime, load in (("OpenCV", _by_opencv), ("onnxruntime", _by_onnxruntime)):
            try:
                run = load(path, declared.name)
                run(grey)
            except ImportError:
                reasons.append(f"onnxruntime, of the extra onnx, may: {install_extra('onnx')}")
            except Exception as error:  # the errors of both share no class
                reasons.append(f"{runtime} cannot run it ({_one_line(error)})")
            else:
                self.runtime, self._run = runtime, run
                return
        raise ConfigError(f"{path}: {'; '.join(reasons)}")

    def run(self, blob: Array) -> Outputs:
        """Run the network.

        Args:
            blob: input, (1, 3, H, W), float32.

        Returns:
            Outputs by name, float64; one without elements is (0,).

        Raises:
            ConfigError: it cannot be run.
        """
        try:
            return self._run(blob)
        except Exception as error:
            raise ConfigError(f"{self.path}: {self.runtime} cannot run it ({_one_line(error)})") from None


def _by_opencv(path: Path, name: str) -> Run:
    with _silent():
        net = cv2.dnn.readNetFromONNX(str(path))
    names = list(net.getUnconnectedOutLayersNames())

    def run(blob: Array) -> Outputs:
        with _silent():
            net.setInput(blob)
            outputs = net.forward(names)
        return dict(zip(names, map(_numbers, outputs), strict=True))

    return run


def _by_onnxruntime(path: Path, name: str) -> Run:
    import onnxruntime  # type: ignore[import-untyped,unused-ignore]

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # fatal
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = [each.name for each in session.get_outputs()]

    def run(blob: Array) -> Outputs:
        return dict(zip(names, map(_numbers, session.run(names, {name: blob})), strict=True))

    return run


def _numbers(output: Any) -> Array:
    """Copy an output to float64; OpenCV gives None for one without elements."""
    return np.zeros(0) if output is None or not np.size(output) else np.array(output, dtype=float)


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep OpenCV from printing what it also raises."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _one_line(error: Exception) -> str:
    return " ".join(str(getattr(error, "err", None) or error).split())


# The declaration


class _Input(NamedTuple):
    """An input: its name, element type and shape; 0 where the shape is open."""

    name: str
    kind: int
    shape: list[int]


def _image_input(path: Path) -> _Input:
    """Read what a file takes.

    Raises:
        ConfigError: it is no ONNX file, or takes something else than an image.
    """
    try:
        inputs = _inputs(memoryview(path.read_bytes()))
    except (ValueError, IndexError, TypeError):
        inputs = []
    if not inputs:
        raise ConfigError(f"{path}: is no ONNX file")
    if len(inputs) > 1:
        names = ", ".join(each.name for each in inputs)
        raise ConfigError(f"{path}: has inputs {names}; export it with the image as its only one")
    (image,) = inputs
    if len(image.shape) != 4 or image.shape[0] not in (0, 1) or image.shape[1] not in (0, 3) or image.kind != FLOAT32:
        shape = " x ".join(str(n or "?") for n in image.shape)
        kind = "" if image.kind == FLOAT32 else ", which is not float32"
        raise ConfigError(f"{path}: takes {shape}{kind}; export it for 1 x 3 x height x width, float32")
    return image


def _size(path: Path, image: _Input, wanted: tuple[int, int] | None) -> tuple[int, int]:
    """Width and height of the input [px]."""
    height, width = image.shape[2:]
    if wanted is None and 0 in (width, height):
        example = f"[{width or 640}, {height or 640}]"
        raise ConfigError(f"{path}: leaves the size of its input open; write network.input_px = {example}, for example")
    size = (width, height) if wanted is None else wanted
    if any(own not in (0, n) for own, n in zip((width, height), size, strict=True)):
        takes = " x ".join(str(n or "any") for n in (width, height))
        raise ConfigError(f"{path}: takes images of {takes} px; correct network.input_px")
    return size


def _inputs(model: memoryview) -> list[_Input]:
    """Read the inputs of an ONNX file that have no value in it."""
    (graph,) = _fields(model, 7)
    for node in _fields(graph, 1):  # OpenCV ends the process at a name that is no text
        for text in (text for field in (1, 2, 3, 4) for text in _fields(node, field)):
            bytes(text).decode()
    own = {bytes(name).decode() for tensor in _fields(graph, 5) for name in _fields(tensor, 8)}
    found = []
    for value in _fields(graph, 11):
        (name,) = _fields(value, 1)
        for tensor in (tensor for kind in _fields(value, 2) for tensor in _fields(kind, 1)):
            dims = [dim for shape in _fields(tensor, 2) for dim in _fields(shape, 1)]
            lengths = [next(iter(_fields(dim, 1)), 0) for dim in dims]
            kind = next(iter(_fields(tensor, 1)), 0)
            found.append(_Input(bytes(name).decode(), kind, [n if n < 2**31 else 0 for n in lengths]))
    return [each for each in found if each.name not in own]


def _fields(message: memoryview, number: int) -> Iterator[Any]:
    """Give the values of a field of a protocol buffer: integers, and messages as bytes."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        kind, start = key & 7, at
        value: Any = None
        if kind == 0:
            value, at = _varint(message, at)
        elif kind == 2:
            length, start = _varint(message, at)
            at = start + length
            value = message[start:at]
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4
        else:
            raise ValueError(kind)
        if at > len(message):
            raise ValueError(at)
        if key >> 3 == number:
            yield value


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """Read an integer of seven bits a byte; return it, and where the next field begins."""
    value = 0
    for i in range(LONGEST_VARINT):  # a damaged file has one without end
        byte = message[at + i]
        value |= (byte & 0x7F) << 7 * i
        if byte < 0x80:
            return value, at + i + 1
    raise ValueError(at)
