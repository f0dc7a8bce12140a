"""Sensor noise and JPEG coding of a simulated camera; the same seed and frame number give the same image."""

import functools

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.config import SimCamera, SimEffects
from cotarget.rig import Image

# Fresh Gaussian noise for every frame costs more than the frame; a few prepared fields with random shifts do not.
NOISE_FIELDS = 8
NOISE_MARGIN = 64  # excess of a field over the image [px], from which the shift is drawn


class Sensor:
    """Adds a camera's noise and JPEG coding to a perfect image."""

    def __init__(self, camera: SimCamera, effects: SimEffects, seed: tuple[int, ...]) -> None:
        self._seed = seed
        self._quality = camera.jpeg_quality if effects.jpeg else None
        self._noise = camera.noise if effects.noise else 0.0

    def expose(self, image: Image, index: int) -> Image:
        """Add noise and coding to a frame.

        Args:
            image: perfect image, (H, W, 3).
            index: number of the frame, which alone determines its noise.
        """
        if self._noise > 0:
            h, w = image.shape[:2]
            rng = np.random.default_rng((*self._seed, index))
            field = _noise_fields(self._seed, (w, h), self._noise)[rng.integers(NOISE_FIELDS)]
            y, x = rng.integers(NOISE_MARGIN, size=2)
            # Less 128, bytes are signed as the noise is; OpenCV adds equal types several times as fast.
            noisy = cv2.add((image ^ 128).view(np.int8), field[y : y + h, x : x + w])
            image = noisy.view(np.uint8) ^ 128
        if self._quality is not None:
            coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._quality])[1]
            image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)
        return image


@functools.lru_cache(maxsize=4)  # 9 MB each for 640x480; worlds with the same seed share them
def _noise_fields(seed: tuple[int, ...], size: tuple[int, int], sigma: float) -> list[npt.NDArray[np.int8]]:
    """Prepare fields of Gaussian noise, rounded to whole grey levels."""
    rng = np.random.default_rng(seed)
    shape = (size[1] + NOISE_MARGIN, size[0] + NOISE_MARGIN, 3)
    fields = (rng.normal(0.0, sigma, shape) for _ in range(NOISE_FIELDS))
    return [np.clip(np.rint(field), -127, 127).astype(np.int8) for field in fields]
