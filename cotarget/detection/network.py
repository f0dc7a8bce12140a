"""Detect with a neural network of the user's own, an ONNX file.

`Network` scales an image with its proportions kept (letterbox) or cuts it into tiles, runs the file and reads boxes
from its outputs. `LAYOUTS` has the ways in which networks write boxes. In rig.toml this detector is called "onnx", with
a table [targets.NAME.network].
"""

import itertools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.config import NetworkConfig
from cotarget.detection.onnx_file import OnnxFile, Outputs
from cotarget.errors import ConfigError
from cotarget.geometry import Array, intersection_areas
from cotarget.rig import Image

# Grey level of the letterbox's padding, as YOLO networks are trained.
PADDING = 114
# Two boxes with a larger intersection over union are one target; at most MOST_BOXES boxes are compared.
SAME_IOU, MOST_BOXES = 0.5, 1000
# Least part of its side that a tile shares with the next one. Targets up to it are seen whole in a tile.
SHARED = 0.25
# A box that ends as near as this to a side at which its tile was cut may be a part of a target: [px], and in parts of
# the box, because boxes of networks are not exact.
CUT_PX, CUT_PART = 2.0, 0.15
# A box of a tile and one of the whole image are the same target if they share this part of the smaller.
INSIDE = 0.5
# Largest coordinate that is taken for a normalised one, and not for pixels.
MOST_NORMALISED = 2.0
# How far a score may be from 0 to 1 by rounding.
ROUNDING = 0.01


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
        self._output: str | None = None  # which of several outputs is read, once it is known
        self._file = OnnxFile(config.model, config.input_px)
        width, height = self._file.side.tolist()
        self._boxes(np.full((height, width, 3), PADDING, np.uint8))

    def __str__(self) -> str:
        """File, size of its input and what runs it."""
        width, height = self._file.side.tolist()
        return f"{self._file.path}, {width}x{height} px, run by {self._file.runtime}"

    def __call__(self, image: Image) -> list[tuple[float, ...]]:
        """Find boxes (left, top, width, height, score) in an image, (H, W, 3) BGR [px].

        Raises:
            ConfigError: the network cannot be run, or its outputs have another layout.
        """
        side = self._file.side
        times = float((side / image.shape[1::-1]).min())
        corners, scores = self._search(image, times)
        if self._config.tiled and times < 1:
            tiled, tiled_scores = self._search_tiles(image)
            same = _inside(corners, tiled)
            large = (corners[:, 2:] - corners[:, :2] > SHARED * side).any(axis=1)
            whole = large | ~same.any(axis=1)  # a tile has the better box of a small target
            pieces = same[large].any(axis=0)
            corners = np.concatenate([corners[whole], tiled[~pieces]])
            scores = np.concatenate([scores[whole], tiled_scores[~pieces]])
        boxes = np.column_stack([corners[:, :2], corners[:, 2:] - corners[:, :2]])
        kept = cv2.dnn.NMSBoxes(boxes.tolist(), scores.tolist(), 0.0, SAME_IOU, top_k=MOST_BOXES)
        return [(*boxes[i].tolist(), float(scores[i])) for i in kept]

    def _search_tiles(self, image: Image) -> tuple[Array, Array]:
        """Find corners [px], (n, 4), and scores, (n,), of targets that are whole in a tile."""
        size, side = np.array(image.shape[1::-1]), self._file.side
        found: list[tuple[Array, Array]] = []
        for left, top in itertools.product(*map(_starts, size.tolist(), side.tolist())):
            tile = image[top : top + side[1], left : left + side[0]]
            low, high = np.array([left, top]), np.array([left + tile.shape[1], top + tile.shape[0]])
            corners, scores = self._search(tile, 1.0)
            corners = corners + np.tile(low, 2)
            sides = corners[:, 2:] - corners[:, :2]
            margin = np.maximum(CUT_PX, CUT_PART * sides)
            cut = (low > 0) & (corners[:, :2] < low + margin) | (high < size) & (corners[:, 2:] > high - margin)
            whole = ~(cut | (sides > SHARED * side)).any(axis=1)
            found.append((corners[whole], scores[whole]))
        corners, scores = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return corners, scores

    def _search(self, image: Image, times: float) -> tuple[Array, Array]:
        """Find corners [px], (n, 4), and scores, (n,), in an image that is scaled and put in the input's middle."""
        shape, side = np.array(image.shape[1::-1]), self._file.side
        size = np.clip(np.rint(times * shape), 1, side).astype(int)
        scaled = cv2.resize(image, size.tolist(), interpolation=cv2.INTER_AREA if times < 1 else cv2.INTER_LINEAR)
        left, top = (side - size) // 2
        picture = np.full((*side[::-1], 3), PADDING, np.uint8)
        picture[top : top + size[1], left : left + size[0]] = scaled
        corners, scores = self._boxes(picture)
        corners = (corners - (left, top, left, top)) * np.tile(shape / size, 2)
        corners = np.clip(corners.round(3), 0, np.tile(shape, 2))  # float32 misses the border by a millionth
        inside = (corners[:, 2:] > corners[:, :2]).all(axis=1)
        return corners[inside], scores[inside]

    def _boxes(self, picture: Image) -> tuple[Array, Array]:
        """Run the network on an image of its input's size: corners [px], (n, 4), and scores of the classes, (n,)."""
        config = self._config
        blob = cv2.dnn.blobFromImage(picture, swapRB=True)
        mean, std = (np.array(each, np.float32).reshape(1, 3, 1, 1) for each in (config.mean, config.std))
        outputs = self._file.run((blob - mean) / std)
        if self._output is not None:
            outputs = {self._output: outputs[self._output]}
        boxes = self._read(outputs) if any(array.size for array in outputs.values()) else None
        if boxes is None:
            return np.zeros((0, 4)), np.zeros(0)
        corners, scores, labels = boxes
        if labels is not None:
            best = np.where(np.isin(labels, config.classes), scores, 0.0) if config.classes else scores
        elif max(config.classes, default=0) < scores.shape[1]:
            best = scores[:, config.classes or slice(None)].max(axis=1)
        else:
            classes = f"has classes 0 to {scores.shape[1] - 1}, and not {max(config.classes)}"
            raise ConfigError(f"{config.model}: {classes}; correct network.classes")
        good = (best >= config.least_score) & np.isfinite(corners).all(axis=1)
        return corners[good], best[good].clip(max=1.0)

    def _read(self, outputs: Outputs) -> Boxes | None:
        """Read boxes of all outputs, or of the one that fits the layout, such as beside raw heads.

        Returns:
            The boxes; None if an output without elements may be the one.

        Raises:
            ConfigError: no output fits, or several do.
        """
        config, side = self._config, self._file.side.astype(float)
        if (boxes := _fitting(config.layout, outputs, side)) is not None:
            return boxes
        alone = {name: _fitting(config.layout, {name: array}, side) for name, array in outputs.items()}
        fitting = [name for name, boxes in alone.items() if boxes is not None]
        if len(fitting) == 1:
            self._output = fitting[0]
            return alone[self._output]
        if not fitting and not all(array.size for array in outputs.values()):
            return None
        shapes = ", ".join(f"{name} {array.shape}" for name, array in outputs.items())
        text = f'{config.model}: gives {shapes}; layout "{config.layout}" has {WANTED[config.layout]}'
        several = f"; {' and '.join(fitting)} fit it: keep one by onnx.utils.extract_model" if fitting else ""
        raise ConfigError(text + several)


def _fitting(layout: str, outputs: Outputs, side: Array) -> Boxes | None:
    """Read outputs by a layout; None if they have another one."""
    try:
        boxes = LAYOUTS[layout](outputs, side)
    except (ValueError, IndexError, StopIteration):
        return None
    scores, wanted = boxes.scores, 1 + (boxes.labels is None)
    if boxes.corners.shape != (len(scores), 4) or scores.ndim != wanted or not all(scores.shape[1:]):  # no class
        return None
    return None if ((scores < -ROUNDING) | (scores > 1 + ROUNDING)).any() else boxes


def _inside(whole: Array, tiled: Array) -> npt.NDArray[np.bool_]:
    """Whether boxes share more than INSIDE of the smaller one, (n, m)."""
    (at, size), (center, extent) = (((e[:, :2] + e[:, 2:]) / 2, e[:, 2:] - e[:, :2]) for e in (whole, tiled))
    shared = intersection_areas(at, size, center, extent)
    return np.asarray(shared > INSIDE * np.minimum.outer(size.prod(axis=1), extent.prod(axis=1)))


def _starts(length: int, side: int) -> list[int]:
    """First pixels of tiles that cover a length and share at least SHARED of their side."""
    if length <= side:
        return [0]
    count = 1 + int(np.ceil((length - side) / (side * (1 - SHARED))))
    return [round(start) for start in np.linspace(0, length - side, count)]


# Layouts


def _yolo(outputs: Outputs, side: Array) -> Boxes:
    """(1, 4 + classes, n): centre, size [px] and a score for each class; YOLOv8 and its successors."""
    table = _table(outputs).T
    return Boxes(_from_centers(table[:, :4]), table[:, 4:])


def _yolov5(outputs: Outputs, side: Array) -> Boxes:
    """(1, n, 5 + classes): centre, size [px], objectness and a score for each class; YOLOv5 and YOLOv7."""
    table = _table(outputs)
    if (table[:, 5:] > 1 + ROUNDING).any():
        raise ValueError
    return Boxes(_from_centers(table[:, :4]), table[:, 4:5] * table[:, 5:])


def _yolov10(outputs: Outputs, side: Array) -> Boxes:
    """(1, n, 6): corners [px], score and class; YOLOv10 and others that need no suppression."""
    table = _table(outputs)
    if table.shape[1] != 6 or (np.abs(table[:, 5] - table[:, 5].round()) > ROUNDING).any():
        raise ValueError
    return Boxes(table[:, :4], table[:, 4], table[:, 5])


def _ssd(outputs: Outputs, side: Array) -> Boxes:
    """Corners (n, 4), labels (n,) and scores (n,), known by their names; or rows of image, label, score and corners.

    Corners are normalised or in pixels.
    """
    if len(outputs) == 1:
        (rows,) = outputs.values()
        if rows.shape[-1] != 7:
            raise ValueError
        table = rows.reshape(-1, 7)
        labels, scores, corners = table[:, 1], table[:, 2], table[:, 3:]
    else:
        corners = _named(outputs, "box").reshape(-1, 4)
        labels, scores = _named(outputs, "label", "class").ravel(), _named(outputs, "score").ravel()
    normalised = len(corners) and np.median(corners.max(axis=1)) <= MOST_NORMALISED
    return Boxes(corners * np.tile(side, 2) if normalised else corners, scores, labels)


def _detr(outputs: Outputs, side: Array) -> Boxes:
    """Boxes (1, n, 4), normalised centre and size; and logits (1, n, classes + 1), the last for no target."""
    logits = _named(outputs, "logit", "label", "class")[0]
    parts = np.exp(logits - logits.max(axis=1, keepdims=True))
    boxes = _from_centers(_named(outputs, "box", "det")[0])
    return Boxes(boxes * np.tile(side, 2), (parts / parts.sum(axis=1, keepdims=True))[:, :-1])


def _rtdetr(outputs: Outputs, side: Array) -> Boxes:
    """As DETR, with independent logits and none for no target; or (1, n, 4 + classes), boxes and scores."""
    if len(outputs) == 1:
        table = _table(outputs)
        return Boxes(_from_centers(table[:, :4]) * np.tile(side, 2), table[:, 4:])
    logits = _named(outputs, "logit", "label", "class")[0]
    boxes = _from_centers(_named(outputs, "box", "det")[0])
    return Boxes(boxes * np.tile(side, 2), 1 / (1 + np.exp(-logits.clip(-50, 50))))


# By layout, what the outputs are and what writes them, for messages.
WANTED: Mapping[str, str] = {
    "yolo": "(1, 4 + classes, n), with scores from 0 to 1, as by yolo export with nms=False",
    "yolov5": "(1, n, 5 + classes), with scores from 0 to 1, as by export.py, of YOLOv7 with --grid, without --train",
    "yolov10": "(1, n, 6), with scores from 0 to 1, as by yolo export with nms=True",
    "ssd": "outputs named boxes, labels and scores, as by output_names of torch.onnx.export, or rows of 7 numbers",
    "detr": "outputs named boxes and logits, as by output_names of torch.onnx.export",
    "rtdetr": "outputs named boxes and logits, as by output_names of torch.onnx.export, or (1, n, 4 + classes)",
}
# By layout, what makes boxes of the outputs and the input's size (width, height).
LAYOUTS: Mapping[str, Callable[[Outputs, Array], Boxes]] = {
    "yolo": _yolo,
    "yolov5": _yolov5,
    "yolov10": _yolov10,
    "ssd": _ssd,
    "detr": _detr,
    "rtdetr": _rtdetr,
}


def _table(outputs: Outputs) -> Array:
    """Take the table of the only output, (1, rows, columns)."""
    (array,) = outputs.values()
    if array.ndim != 3 or len(array) != 1:
        raise ValueError(array.shape)
    return array[0]


def _named(outputs: Outputs, *words: str) -> Array:
    """Find the output whose name contains one of some words."""
    return next(array for name, array in outputs.items() if any(word in name.lower() for word in words))


def _from_centers(boxes: Array) -> Array:
    """Corners of boxes given by centre and size, (n, 4)."""
    if boxes.shape[-1] != 4:
        raise ValueError(boxes.shape)
    return np.column_stack([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2])
