"""Pictures in the layout of the paper's figures: rows of panels with captions below."""

from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from cotarget.drawing import PAPER, captioned
from cotarget.rig import Image

WIDTH_PX = 480  # width of a panel, less than a camera's image: averaged noise takes less disk space
GAP_PX = 6  # gap right of a panel
Panel = tuple[Image, str]


def laid_out(rows: Iterable[Sequence[Panel]]) -> bytes:
    """Arrange rows of captioned panels, all of one aspect ratio and equally many per row, as one PNG."""
    return cv2.imencode(".png", np.vstack([np.hstack([_panel(*each) for each in row]) for row in rows]))[1].tobytes()


def _panel(image: Image, caption: str) -> Image:
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    size = WIDTH_PX, round(WIDTH_PX * image.shape[0] / image.shape[1])
    panel = captioned(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8), caption)
    return np.asarray(cv2.copyMakeBorder(panel, 0, 0, 0, GAP_PX, cv2.BORDER_CONSTANT, value=PAPER), np.uint8)
