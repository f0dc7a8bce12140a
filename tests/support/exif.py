"""Pictures with an EXIF tag of their orientation, as a camera or phone that was turned writes them."""

import struct

import cv2
import numpy as np

COLOURED = np.zeros((16, 32, 3), np.uint8)
COLOURED[..., 1], COLOURED[:8, :8, 2] = 200, 255  # one corner differs, so that a turn shows


def tagged(orientation, image=COLOURED):
    """A JPEG of an image with a tag from 1 to 8: 3 is upside down, 6 on its side."""
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    exif = b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">HHHIHHI", 1, 0x112, 3, 1, orientation, 0, 0)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]
