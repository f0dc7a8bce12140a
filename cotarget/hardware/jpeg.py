"""JPEGs as they come off a wire: decoded if they are whole, and refused otherwise."""

import threading

import av
import cv2
import numpy as np

from cotarget.rig import Image


class JpegDecoder:
    """Decodes JPEGs; safe to use from any thread.

    OpenCV shows whatever is left of a damaged picture and says so on stderr only. So FFmpeg's decoder looks at it
    first: told to, it refuses data that end early or make no sense. It lets bytes pass that are merely too many.
    """

    def __init__(self) -> None:
        self._checker = av.CodecContext.create("mjpeg", "r")
        self._checker.options = {"err_detect": "explode"}
        self._checker.thread_count = 1  # more of them would give each picture with the next
        self._lock = threading.Lock()

    def decode(self, jpeg: bytes, size: tuple[int, int]) -> Image | None:
        """The image, (H, W, 3) BGR and read-only; None if it is damaged.

        Args:
            jpeg: its bytes.
            size: (width, height) that its header tells [px]; to be trusted before memory is spent on it.
        """
        if not self._whole(jpeg):
            return None
        try:
            # A camera that is told to turn its pictures does so; a note in them to turn them is none of ours.
            flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
            image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), flags)
        except cv2.error:
            return None
        if image is None or image.shape != (size[1], size[0], 3):
            return None
        image.flags.writeable = False
        return image

    def _whole(self, jpeg: bytes) -> bool:
        with self._lock:
            try:
                return len(self._checker.decode(av.Packet(jpeg))) == 1
            except (av.error.FFmpegError, ValueError):
                return False
