"""Render the animated picture of the README: a bird in the fixed camera's image beside its close-up.

python -m experiments.paper.teaser [--out docs/pictures/teaser.webp]
"""

import io
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import PIL.Image  # comes with matplotlib

import cotarget as ct
from cotarget.cli.main import Parser
from cotarget.config import SimEffects
from cotarget.drawing import write_text
from cotarget.errors import CotargetError
from cotarget.files import write_atomically
from cotarget.rig import Image
from experiments.paper.gallery import PICTURES

PROGRAM = "python -m experiments.paper.teaser"
TEASER = PICTURES / "teaser.webp"
FROM_S, TO_S = 2.2, 8.6  # of the run: the bird comes in at 2.4 s and flies through the whole image
FIRST_S = 5.0  # of the run: the picture begins with a close-up, which is all that some viewers show
WIDTH_PX = 400  # of each camera's image; a page of GitHub shows both beside each other
BOX_MARGIN_PX, BOX_COLOR = 5, (0, 140, 255)
EVERY = 2  # frame of the cameras
ENCODER = {"quality": 70, "method": 6}  # of WebP; the method trades time for size


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = Parser(prog=PROGRAM, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=TEASER, metavar="FILE", help="the picture, a .webp")
    out: Path = parser.parse_args(arguments).out
    try:
        effects = SimEffects(noise=False, jpeg=False)  # these would take most of the file
        config = ct.RigConfig(sim=ct.SimConfig(scene="outdoor", targets=("bird",), effects=effects))
        rate_hz, images = config.sim.fixed.rate_hz / EVERY, list(pictures(config))
        first = round((FIRST_S - FROM_S) * rate_hz)
        write_atomically(out, animated_webp(images[first:] + images[:first], rate_hz))
    except CotargetError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 1
    print(f"{out}  {out.stat().st_size // 1024} kB")
    return 0


def pictures(config: ct.RigConfig) -> Iterator[Image]:
    """Calibrate a rig, follow a bird, and give both cameras' images side by side."""
    with ct.open_rig(config) as rig:
        calibration = ct.calibrate(rig)
    with ct.open_rig(config) as rig:  # from the start, while the bird is still outside
        for step in ct.follow(rig, calibration, "bird", seconds=TO_S):
            if step.index >= FROM_S * config.sim.fixed.rate_hz and step.index % EVERY == 0:
                yield side_by_side(step)


def side_by_side(step: ct.Step) -> Image:
    """Draw the detection's box into the fixed camera's image, and put the zoom camera's beside it."""
    fixed, zoom = small(step.fixed.image), small(step.zoom.image)
    if step.target is not None:
        scale = WIDTH_PX / step.fixed.image.shape[1]
        box = step.target.box
        center, half = (box.center_px + 0.5) * scale - 0.5, box.size_px * scale / 2 + BOX_MARGIN_PX
        (left, top), (right, bottom) = np.round([center - half, center + half]).astype(int).tolist()
        cv2.rectangle(fixed, (left, top), (right, bottom), BOX_COLOR, 2)
    write_text(fixed, "fixed camera", (10, 22))
    write_text(zoom, "zoom camera", (10, 22))
    return np.hstack([fixed, zoom])


def small(image: Image) -> Image:
    """Reduce an image to the width shown."""
    size = (WIDTH_PX, round(image.shape[0] * WIDTH_PX / image.shape[1]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def animated_webp(images: Sequence[Image], rate_hz: float) -> bytes:
    """Encode BGR images as an animated WebP that repeats for ever."""
    data = io.BytesIO()
    first, *others = (PIL.Image.fromarray(image[..., ::-1]) for image in images)
    # Pillow refreshes the whole image every few frames; FFmpeg's encoder leaves traces of the bird in the sky.
    duration_ms = round(1000 / rate_hz)
    first.save(data, "WEBP", save_all=True, append_images=others, duration=duration_ms, loop=0, **ENCODER)
    return data.getvalue()


if __name__ == "__main__":
    sys.exit(main())
