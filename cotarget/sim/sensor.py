"""What a simulated sensor and its link do to an image: noise and JPEG, the same for the same seed and frame."""

import cv2
import numpy as np

from cotarget.config import SimCamera, SimEffects
from cotarget.rig import Image

# Fresh Gaussian noise for every frame costs more than the frame; a few prepared fields, shifted at random, do not.
NOISE_FIELDS = 8
NOISE_MARGIN = 64  # a field is this much larger than the image [px], and the shift is drawn from it


class Sensor:
    """Adds a camera's noise and compression to a perfect image."""

    def __init__(self, camera: SimCamera, effects: SimEffects, seed: tuple[int, ...]) -> None:
        self._seed = seed
        self._quality = camera.jpeg_quality if effects.jpeg else None
        self._fields: list[np.ndarray] = []
        if effects.noise and camera.noise > 0:
            rng = np.random.default_rng(seed)
            w, h = camera.size
            shape = (h + NOISE_MARGIN, w + NOISE_MARGIN, 3)
            fields = (rng.normal(0.0, camera.noise, shape) for _ in range(NOISE_FIELDS))
            self._fields = [np.clip(np.rint(field), -127, 127).astype(np.int8) for field in fields]

    def expose(self, image: Image, index: int) -> Image:
        """The image as it arrives.

        Args:
            image: the perfect image, (H, W, 3).
            index: the frame's number, which alone decides its noise.
        """
        if self._fields:
            rng = np.random.default_rng((*self._seed, index))
            field = self._fields[rng.integers(NOISE_FIELDS)]
            y, x = rng.integers(NOISE_MARGIN, size=2)
            h, w = image.shape[:2]
            image = cv2.add(image, field[y : y + h, x : x + w], dtype=cv2.CV_8U)
        if self._quality is not None:
            coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._quality])[1]
            image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)
        return image
