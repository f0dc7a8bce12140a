"""Write a recorded run as one page that a browser opens from disk: both films, tracks, states, and plots.

Both cameras' pictures stand side by side in one H.264 film, so that they cannot be of two moments, and a seek to the
middle of a frame's time shows exactly that frame. JPEGs would take nine times as much; see docs/design-notes.md. The
page loads nothing: film and table are data in it, and its policy lets nothing else in.
"""

import base64
import contextlib
import io
import json
import tempfile
from pathlib import Path

import numpy as np

from cotarget.files import PartFile, write_all, write_error
from cotarget.page.html import policy, render
from cotarget.page.messages import describe, pictures
from cotarget.pipeline import Step
from cotarget.recording.format import Recording
from cotarget.rig import Image
from cotarget.video import FilmWriter

# Size of a page from which it is cut; a browser takes some seconds to open it, and several times as much memory.
MOST_BYTES = 100_000_000
DECIMALS = 4  # of the numbers in the page
CHUNK = 3 << 20  # bytes that are coded at once, a multiple of 3
END = "</body>"


class RunFile(contextlib.AbstractContextManager["RunFile", None]):
    """Write the page of a run, under its name only when it is complete. A context manager.

    If the run ends early, the page holds the steps until then.
    """

    def __init__(self, path: Path, recording: Recording) -> None:
        """Begin the film.

        Args:
            path: file of the page.
            recording: the run that is replayed.

        Raises:
            CotargetError: the folder cannot be written to.
        """
        self._path, self._recording = path, recording
        beside, hidden = path.parent, f".{path.stem}."
        try:
            self._folder = tempfile.TemporaryDirectory(dir=beside, prefix=hidden, ignore_cleanup_errors=True)
        except OSError as error:
            raise write_error(path, error) from None
        self._film_path = Path(self._folder.name) / "film.mp4"
        self._film = FilmWriter(self._film_path, recording.spec.fixed.rate_hz)
        self._steps: list[str] = []
        self._page, self._skipped = render("run.html"), 0
        self._size = len(self._page)
        self._places: dict[str, list[int]] = {}
        self._begin = 0.0
        self._cut_s: float | None = None

    def see(self, step: Step) -> None:
        """Append a step, unless the page is as large as it may be."""
        if self._cut_s is not None:
            return
        if not self._steps:
            self._begin = step.fixed.t
        at = step.fixed.t - self._begin
        self._skipped += step.skipped
        table = describe(step, self._recording.spec, self._skipped) | {"at": at}
        text = json.dumps(json.loads(json.dumps(table, allow_nan=False), parse_float=_rounded))
        if self._size + len(text) + self._film.size_bytes * 4 / 3 > MOST_BYTES:
            self._cut_s = at
            return
        image, self._places = _side_by_side(pictures(step))
        self._film.write(image, step.fixed.t)
        self._steps.append(text)
        self._size += len(text)

    @property
    def warning(self) -> str:
        """One line if the page lacks a part of the run; empty if not."""
        if self._cut_s is not None:
            return f"{self._path}: {self._cut}"
        return "" if self._steps else f"{self._path}: is not written, because the run has no step"

    @property
    def _cut(self) -> str:
        return f"holds the first {self._cut_s:.1f} s of the run, because a page holds some {MOST_BYTES // 10**6} MB"

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Complete the page and give it its name.

        Raises:
            CotargetError: it cannot be written, for example on a full disk.
        """
        with self._folder:
            part = PartFile(self._path)
            with part.ending(keep=bool(self._steps), error=error):
                self._film.__exit__(None, None, None)
                if self._steps:
                    self._write(part.file)

    def _write(self, file: io.RawIOBase) -> None:
        """Write the page, then the run as data at its end."""
        meta = f'<head>\n<meta http-equiv="Content-Security-Policy" content="{policy(self._page)}; media-src blob:">'
        head, _, tail = self._page.replace("<head>", meta, 1).rpartition(END)
        recording = self._recording
        notes = [*recording.notes, *([] if self._cut_s is None else [f"the page {self._cut}"])]
        run = {
            "name": recording.directory.resolve().name,
            "target": recording.target,
            "when": recording.when,
            "notes": [f"{note[:1].upper()}{note[1:]}." for note in notes],
            "wanted_px": recording.config.target(recording.target).wanted_px,
            "period_s": 1 / recording.spec.fixed.rate_hz,
            "places": self._places,
        }
        write_all(file, f'{head}<script type="application/json" id="run">'.encode())
        steps = ",\n".join(self._steps)  # each is JSON already
        table = f'{json.dumps(run, allow_nan=False)[:-1]}, "steps": [\n{steps}]}}'
        write_all(file, table.replace("<", "\\u003c").encode())  # no text of the run ends the script
        write_all(file, b'</script>\n<script type="text/plain" id="film">')
        with self._film_path.open("rb") as film:
            while data := film.read(CHUNK):
                write_all(file, base64.b64encode(data))
        write_all(file, f"</script>\n{END}{tail}\n".encode())


def _rounded(text: str) -> float:
    return round(float(text), DECIMALS)


def _side_by_side(images: dict[str, Image]) -> tuple[Image, dict[str, list[int]]]:
    """Put images beside each other; return the whole, and where each is: left, top, width, height [px].

    Each begins at an even column, because a colour of the film is that of two by two pixels.
    """
    places, left = dict[str, list[int]](), 0
    for name, image in images.items():
        height, width = image.shape[:2]
        places[name] = [left, 0, width, height]
        left += width + width % 2
    whole = np.zeros((max(image.shape[0] for image in images.values()), left, 3), np.uint8)
    for name, image in images.items():
        x, y, width, height = places[name]
        whole[y : y + height, x : x + width] = image
    return whole, places
