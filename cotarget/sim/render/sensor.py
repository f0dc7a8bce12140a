"""What a simulated sensor and its link do to an image: noise and JPEG, the same for the same seed and frame."""

import functools

import cv2
import numpy as np
import numpy.typing as npt

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
        self._noise = camera.noise if effects.noise else 0.0

    def expose(self, image: Image, index: int) -> Image:
        """The image as it arrives.

        Args:
            image: the perfect image, (H, W, 3).
            index: the frame's number, which alone decides its noise.
        """
        if self._noise > 0:
            h, w = image.shape[:2]
            rng = np.random.default_rng((*self._seed, index))
            field = _noise_fields(self._seed, (w, h), self._noise)[rng.integers(NOISE_FIELDS)]
            y, x = rng.integers(NOISE_MARGIN, size=2)
            image = cv2.add(image, field[y : y + h, x : x + w], dtype=cv2.CV_8U)
        if self._quality is not None:
            coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._quality])[1]
            image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)
        return image


@functools.lru_cache(maxsize=4)  # 9 MB each for 640x480; worlds of one seed in one process share them
def _noise_fields(seed: tuple[int, ...], size: tuple[int, int], sigma: float) -> list[npt.NDArray[np.int8]]:
    """Fields of Gaussian noise, rounded as pixels are."""
    rng = np.random.default_rng(seed)
    shape = (size[1] + NOISE_MARGIN, size[0] + NOISE_MARGIN, 3)
    fields = (rng.normal(0.0, sigma, shape) for _ in range(NOISE_FIELDS))
    return [np.clip(np.rint(field), -127, 127).astype(np.int8) for field in fields]
