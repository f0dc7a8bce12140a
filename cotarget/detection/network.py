"""Detect with a neural network of the user's own, an ONNX file.

`Network` scales an image with its proportions kept (letterbox) or cuts it into tiles, runs the file and reads boxes
from its outputs; `LAYOUTS` has the ways in which networks write boxes. OpenCV runs the file, or onnxruntime where
OpenCV cannot. In rig.toml this detector is called "onnx", with a table [targets.NAME.network].
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from cotarget.config import NetworkConfig
from cotarget.errors import ConfigError
from cotarget.geometry import Array
from cotarget.rig import Image

# Grey level beside the image in the network's input, as YOLO networks are trained.
BORDER = 114
# Two boxes with a larger intersection over union are one target.
SAME_IOU = 0.5
# Part of its side that a tile shares with the next one. Targets up to it are seen whole in a tile.
SHARED = 0.25
# A box that ends as near as this to a side inside the image, at which its tile was cut, may be a part of a target [px].
CUT_PX = 2.0
# Largest coordinate that is taken for a part of the input's size, and not for pixels.
MOST_RELATIVE = 2.0

Outputs = Mapping[str, Array]
Run = Callable[[Array], Outputs]


class Boxes(NamedTuple):
    """Boxes of one input.

    Attributes:
        corners: left, top, right and bottom [px], (n, 4).
        scores: scores for each class, (n, classes); or of each box, (n,).
        labels: class of each box, (n,), where it has one score.
    """

    corners: Array
    scores: Array
    labels: Array | None = None


class Network:
    """Find boxes with an ONNX file; an instance is a function as `ExternalDetector` takes it."""

    def __init__(self, config: NetworkConfig) -> None:
        """Load the file and run it once.

        Raises:
            ConfigError: there is no such file, it cannot be run with that input, or its outputs have another layout.
        """
        self._config = config
        if not config.model.is_file():
            raise ConfigError(f"{config.model}: no such file; network.model is a network as an ONNX file")
        self._side = np.array(_input_size(config))
        blank = np.full((*self._side[::-1], 3), BORDER, np.uint8)
        try:
            self._run = _by_opencv(config.model)
            self._boxes(blank)
        except cv2.error as error:
            self._run = _by_onnxruntime(config.model, " ".join(str(error.err).split()))
            self._boxes(blank)

    def __call__(self, image: Image) -> list[tuple[float, ...]]:
        """Find boxes (left, top, width, height, score) in an image, (H, W, 3) BGR [px].

        Raises:
            ConfigError: the outputs have another layout, or the network has fewer classes.
        """
        corners, scores = (np.concatenate(parts) for parts in zip(*self._parts(image), strict=True))
        sizes = corners[:, 2:] - corners[:, :2]
        boxes = np.column_stack([corners[:, :2], sizes])
        kept = cv2.dnn.NMSBoxes(boxes.tolist(), scores.tolist(), self._config.least_score, SAME_IOU)
        return [(*boxes[i].tolist(), float(scores[i])) for i in kept]

    def _parts(self, image: Image) -> Iterator[tuple[Array, Array]]:
        """Give corners [px] and scores of the whole image, and of its tiles."""
        size, side = np.array(image.shape[1::-1]), self._side
        times = float((side / size).min())
        corners, scores = self._search(image, times)
        if not self._config.tiled or times >= 1:
            yield corners, scores
            return
        large = (corners[:, 2:] - corners[:, :2] > SHARED / 2 * side).any(axis=1)  # others are seen whole in a tile
        yield corners[large], scores[large]
        for left, top in itertools.product(*map(_starts, size.tolist(), side.tolist())):
            tile = image[top : top + side[1], left : left + side[0]]
            low, high = np.array([left, top]), np.array([left + tile.shape[1], top + tile.shape[0]])
            corners, scores = self._search(tile, 1.0)
            corners += np.tile(low, 2)
            cut = (low > 0) & (corners[:, :2] < low + CUT_PX) | (high < size) & (corners[:, 2:] > high - CUT_PX)
            whole = ~cut.any(axis=1)
            yield corners[whole], scores[whole]

    def _search(self, image: Image, times: float) -> tuple[Array, Array]:
        """Find corners [px], (n, 4), and scores, (n,), in an image that is scaled and put in the input's middle."""
        shape = np.array(image.shape[1::-1])
        size = np.clip(np.rint(times * shape), 1, self._side).astype(int)
        scaled = cv2.resize(image, size.tolist(), interpolation=cv2.INTER_AREA if times < 1 else cv2.INTER_LINEAR)
        left, top = (self._side - size) // 2
        picture = np.full((*self._side[::-1], 3), BORDER, np.uint8)
        picture[top : top + size[1], left : left + size[0]] = scaled
        corners, scores = self._boxes(picture)
        corners = (corners - (left, top, left, top)) * np.tile(shape / size, 2)
        corners = np.clip(corners.round(3), 0, np.tile(shape, 2))  # float32 misses the border by a millionth
        inside = (corners[:, 2:] > corners[:, :2]).all(axis=1)
        return corners[inside], scores[inside]

    def _boxes(self, picture: Image) -> tuple[Array, Array]:
        """Run the network on an image of its input's size: corners [px], (n, 4), and scores of the classes, (n,)."""
        config = self._config
        rgb = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.float32)
        blob = ((rgb - np.array(config.mean)) / np.array(config.std)).transpose(2, 0, 1)[None]
        outputs = self._run(np.ascontiguousarray(blob, dtype=np.float32))
        try:
            corners, scores, labels = LAYOUTS[config.layout](outputs, self._side.astype(float))
            is_table = corners.shape == (len(scores), 4)
            if not is_table or not np.isfinite(corners).all() or not ((scores >= 0) & (scores <= 1)).all():
                raise ValueError
        except (ValueError, IndexError, StopIteration):
            shapes = ", ".join(f"{name} {array.shape}" for name, array in outputs.items())
            raise ConfigError(f'{config.model}: gives {shapes}, which is not layout "{config.layout}"') from None
        if labels is not None:
            best = np.where(np.isin(labels, config.classes), scores, 0.0) if config.classes else scores
        elif max(config.classes, default=0) < scores.shape[1]:
            best = scores[:, config.classes or slice(None)].max(axis=1)
        else:
            classes = f"has classes 0 to {scores.shape[1] - 1}, and not {max(config.classes)}"
            raise ConfigError(f"{config.model}: {classes}; correct network.classes")
        good = best >= config.least_score
        return corners[good], best[good]


def _starts(length: int, side: int) -> list[int]:
    """First pixels of tiles that cover a length and share at least SHARED of their side."""
    if length <= side:
        return [0]
    count = 1 + int(np.ceil((length - side) / (side * (1 - SHARED))))
    return [round(start) for start in np.linspace(0, length - side, count)]


# Layouts


def _yolo(outputs: Outputs, side: Array) -> Boxes:
    """(1, 4 + classes, n): centre, size [px] and a score for each class; YOLOv8 and its successors."""
    (table,) = (array[0].T for array in outputs.values())
    return Boxes(_from_centers(table[:, :4]), table[:, 4:])


def _yolov5(outputs: Outputs, side: Array) -> Boxes:
    """(1, n, 5 + classes): centre, size [px], a score for any target, and one for each class; YOLOv5 and YOLOv7."""
    (table,) = (array[0] for array in outputs.values())
    return Boxes(_from_centers(table[:, :4]), table[:, 4:5] * table[:, 5:])


def _yolov10(outputs: Outputs, side: Array) -> Boxes:
    """(1, n, 6): corners [px], score and class; YOLOv10 and others that need no suppression."""
    (table,) = (array[0] for array in outputs.values())
    return Boxes(table[:, :4], table[:, 4], table[:, 5])


def _ssd(outputs: Outputs, side: Array) -> Boxes:
    """Corners (n, 4), labels (n,) and scores (n,), known by their names; or rows of image, label, score and corners.

    Corners are in pixels or in parts of the input's size.
    """
    if len(outputs) == 1:
        (table,) = (array.reshape(-1, 7) for array in outputs.values())
        labels, scores, corners = table[:, 1], table[:, 2], table[:, 3:]
    else:
        corners = _named(outputs, "box").reshape(-1, 4)
        labels, scores = _named(outputs, "label", "class").ravel(), _named(outputs, "score").ravel()
    return Boxes(_in_pixels(corners, side), scores, labels)


def _detr(outputs: Outputs, side: Array) -> Boxes:
    """Boxes (1, n, 4), centre and size in parts of the input's; logits (1, n, classes + 1), the last for no target."""
    logits = _named(outputs, "logit", "label", "class")[0]
    parts = np.exp(logits - logits.max(axis=1, keepdims=True))
    return Boxes(_of_queries(outputs, side), (parts / parts.sum(axis=1, keepdims=True))[:, :-1])


def _rtdetr(outputs: Outputs, side: Array) -> Boxes:
    """As DETR, with logits that are independent, and none for no target; RT-DETR and its successors."""
    logits = _named(outputs, "logit", "label", "class")[0]
    return Boxes(_of_queries(outputs, side), 1 / (1 + np.exp(-logits.clip(-50, 50))))


# By layout, what makes boxes of the outputs and the input's size (width, height).
LAYOUTS: Mapping[str, Callable[[Outputs, Array], Boxes]] = {
    "yolo": _yolo,
    "yolov5": _yolov5,
    "yolov10": _yolov10,
    "ssd": _ssd,
    "detr": _detr,
    "rtdetr": _rtdetr,
}


def _named(outputs: Outputs, *words: str) -> Array:
    """Find the output whose name contains one of some words."""
    return next(array for name, array in outputs.items() if any(word in name.lower() for word in words))


def _of_queries(outputs: Outputs, side: Array) -> Array:
    """Corners of a transformer's boxes [px]."""
    return _from_centers(_named(outputs, "box", "det")[0]) * np.tile(side, 2)


def _from_centers(boxes: Array) -> Array:
    """Corners of boxes given by centre and size, (n, 4)."""
    if boxes.shape[-1] != 4:
        raise ValueError(boxes.shape)
    return np.column_stack([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2])


def _in_pixels(corners: Array, side: Array) -> Array:
    """Corners [px], of corners in pixels or in parts of a size."""
    return corners * np.tile(side, 2) if corners.max(initial=0.0) <= MOST_RELATIVE else corners


# The file


def _input_size(config: NetworkConfig) -> tuple[int, int]:
    """Size (width, height) of the input [px]: that of the file, or that of rig.toml where the file leaves it open.

    Raises:
        ConfigError: the file is no ONNX file, or the sizes disagree, or neither has one.
    """
    try:
        data = memoryview(config.model.read_bytes())
        _, _, height, width = next(shape for shape in _input_shapes(data) if len(shape) == 4)
    except (ValueError, IndexError, TypeError, StopIteration):
        raise ConfigError(f"{config.model}: is no ONNX file of a network that takes an image") from None
    own = (width, height)
    if config.input_px is None and 0 in own:
        raise ConfigError(f"{config.model}: takes images of any size; write network.input_px = [640, 640], for example")
    if config.input_px is None:
        return own
    if any(n not in (0, wanted) for n, wanted in zip(own, config.input_px, strict=True)):
        raise ConfigError(
            f"{config.model}: takes images of {width}x{height} px; correct network.input_px, or leave it out"
        )
    return config.input_px


def _input_shapes(model: memoryview) -> Iterator[list[int]]:
    """Give the shapes of an ONNX file's inputs; an open length is 0. Numbers of the fields are those of onnx.proto."""
    for graph in _fields(model, 7):
        for value in _fields(graph, 11):
            yield [
                next(iter(_fields(dim, 1)), 0)
                for kind in _fields(value, 2)
                for tensor in _fields(kind, 1)
                for shape in _fields(tensor, 2)
                for dim in _fields(shape, 1)
            ]


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
    value = shift = 0
    while True:
        byte = message[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _by_opencv(model: Path) -> Run:
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what it cannot run, it also prints
    try:
        net = cv2.dnn.readNetFromONNX(str(model))
    finally:
        cv2.utils.logging.setLogLevel(level)
    names: Sequence[str] = net.getUnconnectedOutLayersNames()

    def run(blob: Array) -> Outputs:
        net.setInput(blob)
        return dict(zip(names, (np.array(output) for output in net.forward(names)), strict=True))

    return run


def _by_onnxruntime(model: Path, why: str) -> Run:
    """Run a file that OpenCV cannot run, for a reason."""
    try:
        import onnxruntime  # type: ignore[import-untyped,unused-ignore]
    except ImportError:
        text = f"{model}: OpenCV cannot run it ({why}); onnxruntime may: pip install 'cotarget[onnx]'"
        raise ConfigError(text) from None
    try:
        session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors share no class
        raise ConfigError(f"{model}: cannot be run: {' '.join(str(error).split())}") from None
    name = session.get_inputs()[0].name
    names = [each.name for each in session.get_outputs()]

    def run(blob: Array) -> Outputs:
        return dict(zip(names, session.run(names, {name: blob}), strict=True))

    return run
