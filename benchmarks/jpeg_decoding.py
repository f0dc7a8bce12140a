"""Damaged JPEGs that decoders accept, and the time of a decoder that refuses them.

60 pictures are damaged in their data, in several ways. `cotarget.drivers.mjpeg.decode_jpeg` is compared with OpenCV,
which shows what is left of a picture, and with FFmpeg's strict decoder. Times are ratios to cv2.imdecode. One way is
FFmpeg's check of a picture, under two headers, before OpenCV decodes it; a check of lengths takes that.

    python -m benchmarks.jpeg_decoding
"""

import time
from collections.abc import Callable, Sequence

import av
import cv2
import numpy as np

from cotarget.drivers.mjpeg import DamagedError, decode_jpeg
from experiments.tables import columns

PICTURES, ROUNDS = 60, 5
SIZES = ((320, 240), (640, 480))
SPAN = 500  # bytes that are damaged together
Damage = Callable[[bytes, np.random.Generator], bytes]


def picture(size: tuple[int, int], seed: int) -> bytes:
    """Encode soft shapes and some noise, as a camera has them."""
    rng = np.random.default_rng(seed)
    shapes = cv2.resize(rng.integers(0, 255, (size[1] // 16, size[0] // 16, 3), dtype=np.uint8), size)
    image = np.clip(shapes + rng.normal(0, 3, shapes.shape), 0, 255).astype(np.uint8)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


def _begin(jpeg: bytes) -> int:
    """Find where the compressed data begin."""
    start = jpeg.rindex(b"\xff\xda")
    return start + 2 + int.from_bytes(jpeg[start + 2 : start + 4], "big")


def _at_random(harm: Callable[[bytes, int], bytes]) -> Damage:
    """Damage the data from a random place on."""
    return lambda jpeg, rng: harm(jpeg, int(rng.integers(_begin(jpeg), len(jpeg) - SPAN - 2)))


def _flipped(count: int) -> Damage:
    def flip(jpeg: bytes, rng: np.random.Generator) -> bytes:
        data = bytearray(jpeg)
        for at in rng.integers(_begin(jpeg), len(jpeg) - 2, count):
            data[at] ^= int(rng.integers(1, 256))
        return bytes(data)

    return flip


DAMAGES: dict[str, Damage] = {
    "none": lambda jpeg, rng: jpeg,
    f"{SPAN} bytes twice": _at_random(lambda jpeg, at: jpeg[: at + SPAN] + jpeg[at:]),
    f"{SPAN} bytes missing": _at_random(lambda jpeg, at: jpeg[:at] + jpeg[at + SPAN :]),
    f"{SPAN} bytes zero": _at_random(lambda jpeg, at: jpeg[:at] + bytes(SPAN) + jpeg[at + SPAN :]),
    "cut short": _at_random(lambda jpeg, at: jpeg[:at] + jpeg[-2:]),
    "1 byte changed": _flipped(1),
    "3 bytes changed": _flipped(3),
    "10 bytes changed": _flipped(10),
}


def _strict(jpeg: bytes) -> bool:
    try:
        decode_jpeg(jpeg)
    except DamagedError:
        return False
    return True


def _opencv(jpeg: bytes) -> bool:
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) is not None


def _ffmpeg() -> Callable[[bytes], bool]:
    decoder = av.CodecContext.create("mjpeg", "r")
    decoder.options = {"err_detect": "explode"}
    decoder.thread_count = 1  # with more threads a picture comes out only with the next one

    def decodes(jpeg: bytes) -> bool:
        try:
            return len(decoder.decode(av.Packet(jpeg))) == 1
        except (av.error.FFmpegError, ValueError):
            return False

    return decodes


def _milliseconds(decode: Callable[[bytes], object], pictures: Sequence[bytes]) -> float:
    began = time.perf_counter()
    for jpeg in pictures:
        decode(jpeg)
    return 1e3 * (time.perf_counter() - began) / len(pictures)


def main() -> None:
    """Print both tables."""
    check = _ffmpeg()
    ways: dict[str, Callable[[bytes], bool]] = {"decode_jpeg": _strict, "OpenCV": _opencv, "FFmpeg, strict": check}
    lines = []
    for name, damage in DAMAGES.items():
        rng = np.random.default_rng(7)
        pictures = [damage(picture(SIZES[-1], seed), rng) for seed in range(PICTURES)]
        lines.append([name, *(sum(map(way, pictures)) for way in ways.values())])
    print(f"accepted of {PICTURES} pictures\n" + columns(("damage", *ways), lines))
    speeds: dict[str, Callable[[bytes], object]] = {
        "cv2.imdecode": _opencv,
        "decode_jpeg": _strict,
        "FFmpeg's check twice, cv2.imdecode": lambda jpeg: (check(jpeg), check(jpeg), _opencv(jpeg)),
    }
    lines = []
    for size in SIZES:
        pictures = [picture(size, seed) for seed in range(PICTURES)]
        taken = {name: min(_milliseconds(way, pictures) for _ in range(ROUNDS)) for name, way in speeds.items()}
        for name, ms in taken.items():
            lines.append([f"{size[0]}x{size[1]}: {name}", ms, ms / taken["cv2.imdecode"]])
    print("\n" + columns(("way", "ms a picture", "over cv2.imdecode"), lines))


if __name__ == "__main__":
    main()
