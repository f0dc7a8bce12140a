"""Noise of a camera's sensor."""

import cv2
import numpy as np


def noisy(picture, rng, sigma):
    """Add Gaussian noise to an image of any depth, (H, W) or (H, W, 3), and round it to bytes.

    OpenCV draws it five times as fast as numpy, which takes longer for an image than the detection.
    """
    cv2.setRNGSeed(int(rng.integers(2**31)))
    noise = cv2.randn(np.empty((picture.shape[0], picture.size // picture.shape[0]), np.float32), 0, sigma)
    return cv2.add(picture, noise.reshape(picture.shape), dtype=cv2.CV_8U)
