"""Record a run: a table of its Steps, and every call on its rig with the result.

`step_row` makes a line of the table. `Recorder` makes the folder of a recording, and wraps a rig's devices to log their
calls. `RecordWriter` writes log and images on its own thread, so that the run does not wait for the disk.
"""

import collections
import contextlib
import dataclasses
import inspect
import json
import logging
import math
import platform
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import cotarget.errors
from cotarget.config import RigConfig, config_table
from cotarget.control.orders import Order, order_row
from cotarget.control.selection import TargetSelector, selector_table
from cotarget.errors import ConfigError, CotargetError, EmergencyStopError
from cotarget.pipeline import Step
from cotarget.recording.format import (
    CALIBRATION,
    CALLS,
    COMPLETE,
    FIXED,
    LOG,
    META,
    POLICY,
    SCHEMA,
    TEMPLATE,
    ZOOM,
    Event,
    argument_numbers,
    event_line,
    is_same,
    result_numbers,
    spec_table,
)
from cotarget.rig import Board, Camera, Clock, Frame, Image, PanTilt, Rig, ZoomCamera

log = logging.getLogger(__name__)

# The log and its images

# Images that may wait for the disk [bytes]; one of 640x480 takes 0.92 MB. Beyond this, frames of the zoom camera are
# logged without their image. The fixed camera's images are always kept: a replay needs them, so the run waits.
ZOOM_ROOM = 64_000_000
ROOM = 128_000_000
# Huffman coding alone, because noise has no repetitions, and the one useful filter; see docs/design-notes.md.
PNG_OPTIONS = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
if hasattr(cv2, "IMWRITE_PNG_FILTER"):  # older versions of OpenCV always use that filter
    PNG_OPTIONS += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]


@dataclass(eq=False)
class _ImageFile:
    """An image on its way to the disk; ``image`` is None once it is written, or if it is dropped."""

    name: str
    image: Image | None
    size_bytes: int = 0
    dropped: bool = False


class RecordWriter:
    """Write events in order, each image before the line that names it.

    Attributes:
        dropped: number of the zoom camera's images that were dropped because the disk was too slow.
        failure: why writing has ended; empty while it works.
    """

    def __init__(self, directory: Path) -> None:
        """Begin the log in a folder; raise OSError if that cannot be written."""
        self.dropped = 0
        self.failure = ""
        self._directory = directory
        for name in (FIXED, ZOOM):
            (directory / name).mkdir()
        self._log = (directory / LOG).open("xb", buffering=0)  # unbuffered: a written line survives the program's death
        self._queue: collections.deque[tuple[Event | dict[str, Any], _ImageFile | None]] = collections.deque()
        self._changed = threading.Condition()
        self._waiting = 0
        self._closing = False
        self._last: dict[str, tuple[float, Image, _ImageFile]] = {}
        self._numbers = {FIXED: 0, ZOOM: 0}
        self._thread = threading.Thread(target=self._work, name="recording", daemon=True)
        self._thread.start()

    def put(self, event: Event | dict[str, Any], camera: str = "", frame: Frame | None = None) -> None:
        """Queue a line of the log; the image of an event's frame goes to the camera's folder and must not change."""
        with self._changed:
            file = None
            if frame is not None and not self.failure:
                assert isinstance(event, Event)
                last_t, last, _ = self._last.get(camera, (-math.inf, None, None))
                if frame.t > last_t and frame.repeated != (last is not None and is_same(frame.image, last)):
                    event = replace(event, repeated=frame.repeated)
                file = self._file_of(camera, frame.image, frame.t)
            if not self.failure:  # checked again: it may have failed during the wait for room
                self._queue.append((event, file))
                self._changed.notify_all()

    @property
    def waiting(self) -> int:
        """Number of events that are not on disk yet."""
        return len(self._queue)

    def close(self) -> None:
        """Write the events in the queue, then end the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join()
        self._log.close()

    def _file_of(self, camera: str, image: Image, t: float) -> _ImageFile:
        """Make an image's file, or return the last one if the frame is the same."""
        if camera in self._last:
            last_t, last_image, last = self._last[camera]
            if last_t == t and (last_image is image or np.array_equal(last_image, image)):
                return last
        file = _ImageFile(f"{camera}/{self._numbers[camera]:06d}.png", image)
        self._numbers[camera] += 1
        if camera == ZOOM and self._waiting + image.nbytes > ZOOM_ROOM:
            file = replace(file, image=None, dropped=True)
            if self.dropped == 0:
                log.warning("the disk is too slow for the recording: images of the zoom camera are left out")
            self.dropped += 1
        else:
            self._changed.wait_for(lambda: not self._waiting or self._waiting + image.nbytes <= ROOM or self.failure)
            self._waiting += image.nbytes
        self._last[camera] = (t, image, file)
        return file

    def _work(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._queue or self._closing)
                    if not self._queue:
                        return
                    event, file = self._queue[0]
                self._write(event, file)
                self._queue.popleft()  # only now, so that the queue holds all that is not written yet
        except (OSError, cv2.error) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error).strip()
            log.warning("the recording ends here; it cannot be written: %s", reason)
            self._fail(reason)
        except BaseException as error:
            self._fail(f"{type(error).__name__}: {error}")  # releases a caller that waits for this thread
            raise

    def _fail(self, reason: str) -> None:
        with self._changed:
            self.failure = reason
            self._queue.clear()
            self._changed.notify_all()

    def _write(self, event: Event | dict[str, Any], file: _ImageFile | None) -> None:
        if file is not None:
            if file.image is not None:
                file.size_bytes = write_png(self._directory / file.name, file.image)
                with self._changed:
                    self._waiting -= file.image.nbytes
                    file.image = None
                    self._changed.notify_all()
            if not file.dropped:
                assert isinstance(event, Event)
                event = replace(event, image=file.name, size_bytes=file.size_bytes)
        text = event_line(event) if isinstance(event, Event) else json.dumps(event, allow_nan=False)
        self._log.write(text.encode() + b"\n")


def write_png(path: Path, image: Image) -> int:
    """Write an image, which appears under its name when complete; return its size on disk [bytes]."""
    data = cv2.imencode(".png", image, PNG_OPTIONS)[1].tobytes()
    part = path.with_suffix(".part")
    part.write_bytes(data)
    part.replace(path)
    return len(data)


# The recorded rig

PROTOCOLS = {"fixed": Camera, "zoom": ZoomCamera, "head": PanTilt, "clock": Clock, "board": Board}


class _CallLog:
    """Log of the calls on all devices of a rig, made in the run's thread.

    Attributes:
        writer: writes them; None while nothing is recorded.
    """

    def __init__(self, clock: Clock) -> None:
        self.writer: RecordWriter | None = None
        self._clock, self._thread = clock, threading.get_ident()

    def call(self, name: str, method: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        """Call a device, and log the result or the error; a frame is logged with its image."""
        aside, writer = threading.get_ident() != self._thread, self.writer
        if writer is None or (aside and name == "clock.now"):  # the watchdog's thread reads the clock all the time
            return method(*arguments)
        args = argument_numbers(name, arguments)
        try:
            answer = method(*arguments)
        except Exception as error:
            failure = (type(error).__name__, str(error))
            event = Event(name, self._clock.now(), args, error=failure, error_class=known_class(error), aside=aside)
            writer.put(event)
            raise
        result = result_numbers(answer)
        at = answer if name == "clock.now" else self._clock.now()
        frame = answer if isinstance(answer, Frame) else None
        number = None if frame is None else frame.number
        writer.put(Event(name, at, args, result, aside=aside, number=number), name.split(".")[0], frame)
        return answer


class _LoggedDevice:
    """A device whose calls in `CALLS` are logged; other attributes are the device's."""

    def __init__(self, name: str, device: Any, log: _CallLog) -> None:
        self._device = device
        for call in CALLS:
            of, method = call.split(".")
            if of == name and call != "head.refused":
                setattr(self, method, self._logged(call, method, log))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    def _logged(self, call: str, method: str, log: _CallLog) -> Callable[..., Any]:
        signature = inspect.signature(getattr(PROTOCOLS[call.split(".")[0]], method))

        def logged(*args: Any, **kwargs: Any) -> Any:
            bound = signature.bind(self, *args, **kwargs)
            bound.apply_defaults()
            return log.call(call, getattr(self._device, method), bound.args[1:])

        return logged


class _RefusalLog:
    """A guarded head whose refused moves are logged; other attributes are the head's."""

    def __init__(self, head: PanTilt, clock: Clock, calls: _CallLog) -> None:
        self._head, self._clock, self._calls = head, clock, calls

    def __getattr__(self, name: str) -> Any:
        return getattr(self._head, name)

    def move(self, *args: Any, **kwargs: Any) -> tuple[float, float]:
        """Command the head; log a refusal."""
        try:
            return self._head.move(*args, **kwargs)
        except EmergencyStopError as error:
            if (writer := self._calls.writer) is not None:
                failure = (type(error).__name__, str(error))
                writer.put(Event("head.refused", self._clock.now(), error=failure))
            raise


class RecordedRig:
    """A rig whose calls are recorded while a recorder is on; of the rig itself, `devices` has the logged devices.

    Args:
        rig: a rig without a safety layer, which the caller closes.

    Raises:
        ConfigError: the rig is guarded; the log must hold the commands that the devices receive.
    """

    def __init__(self, rig: Rig) -> None:
        if rig.guard is not None:
            raise ConfigError(
                "a guarded rig is not recorded: open it by open_rig(..., guarded=False), and guard what wrap returns"
            )
        self._rig, self._calls = rig, _CallLog(rig.clock)
        devices: dict[str, Any] = {name: _LoggedDevice(name, getattr(rig, name), self._calls) for name in PROTOCOLS}
        self.devices = replace(rig, **devices)

    def with_refusals(self, rig: Rig) -> Rig:
        """Return the guarded rig that also logs the moves which the safety layer refuses, for a run that goes on."""
        return replace(rig, head=_RefusalLog(rig.head, rig.clock, self._calls))

    def begin(self, writer: RecordWriter) -> None:
        """Record from now on."""
        writer.put({"rig": spec_table(self._rig.spec)})
        self._calls.writer = writer

    def end(self) -> None:
        """Record no more."""
        self._calls.writer = None


def known_class(error: Exception) -> str:
    """Return the name of an error's nearest base class in `cotarget.errors`; empty if there is none, or it is there."""
    known = next((kind for kind in type(error).__mro__ if getattr(cotarget.errors, kind.__name__, None) is kind), None)
    return "" if known in (None, type(error)) else known.__name__


# Steps and the recording's folder

COLUMNS = (
    "index", "t_s", "t_fixed_s", "t_zoom_s", "state", "reason", "track", "u_px", "v_px", "width_px", "height_px",
    "depth_m", "range_m", "pan_commanded_deg", "tilt_commanded_deg", "focal_commanded_px", "pan_deg", "tilt_deg",
    "focal_px", "utc", "skipped",
)  # fmt: skip


def utc_text(epoch: datetime, t: float) -> str:
    """Format the wall-clock time of a time on a clock that showed 0 at ``epoch``."""
    return (epoch + timedelta(seconds=t)).isoformat(timespec="milliseconds")


def step_row(step: Step, epoch: datetime | None = None) -> list[object]:
    """Make a Step's line of the table with `COLUMNS`.

    The column ``utc`` is empty without ``epoch``, the wall-clock time at which the rig's clock showed 0.
    """
    track, aim, (pan, tilt, focal) = step.target, step.aim, step.commanded
    box = ["", "", "", "", ""] if track is None else [track.id, *track.center_px, *track.size_px]
    row = (
        [step.index, step.t, step.fixed.t, step.zoom.t, step.state, step.reason, *box]
        + (["", ""] if aim is None else [aim.depth, aim.range])
        + [math.degrees(pan), math.degrees(tilt), focal]
        + [math.degrees(step.head.pan), math.degrees(step.head.tilt), step.lens.focal_px]
        + ["" if epoch is None else utc_text(epoch, step.fixed.t), step.skipped]
    )
    return [cell + 0.0 if isinstance(cell, float) else cell for cell in row]  # no -0.0


class Recorder(contextlib.AbstractContextManager["Recorder", None]):
    """Record a run into a folder that `cotarget.recording.replay` can open as a rig; a context manager.

    Wrap the rig below the safety layer, and close it before the recorder:

        with Recorder(folder, config, calibration, target) as recorder:
            with guard(recorder.wrap(open_rig(config, guarded=False)), config.safety) as rig: ...
    """

    def __init__(
        self,
        directory: Path,
        config: RigConfig,
        calibration: Path,
        target: str,
        selector: TargetSelector | None = None,
        policy: Path | None = None,
    ) -> None:
        """Make the folder, and store configuration, calibration and target.

        Args:
            directory: folder of the recording; it must not exist yet, or be empty.
            config: of the rig; its passwords are not recorded.
            calibration: path of calibration.json, which is copied.
            target: name of the target that will be followed.
            selector: selects among several targets; None for the first that comes.
            policy: file of the learnt policy that drives head and lens, which is copied; None for none.

        Raises:
            ConfigError: the folder is not empty, a file cannot be read or written, or there is no such target.
        """
        self._directory = directory
        self._wrapped = False
        try:
            self._made = not directory.exists()
            directory.mkdir(parents=True, exist_ok=True)
            if any(directory.iterdir()):
                raise ConfigError(f"{directory}: is not empty; give a new folder for the recording")
        except OSError as error:
            raise ConfigError(f"{directory}: cannot hold a recording: {error.strerror}") from None
        try:
            self._write_beginning(config, calibration, target, selector, policy)
            self._writer = RecordWriter(directory)
        except BaseException as error:
            self._remove()
            if isinstance(error, OSError):
                raise ConfigError(f"{error.filename or directory}: cannot be recorded: {error.strerror}") from None
            raise

    @property
    def dropped(self) -> int:
        """Number of the zoom camera's images dropped so far, because the disk was too slow."""
        return self._writer.dropped

    @property
    def waiting(self) -> int:
        """Number of calls that are not on disk yet; a crash loses only these."""
        return self._writer.waiting

    def wrap(self, rig: Rig) -> Rig:
        """Return the rig with devices that log every call and its result; only one rig is recorded.

        Closing it closes the rig, as does a failure here.

        Raises:
            ConfigError: the rig is guarded; the log must hold the commands that the devices receive.
        """
        try:
            recorded = RecordedRig(rig)
            self.begin(recorded)
        except BaseException:
            rig.close()
            raise
        return recorded.devices

    def begin(self, recorded: RecordedRig) -> None:
        """Record a rig from now on; only one is recorded."""
        assert not self._wrapped, "a recording is of one rig"
        recorded.begin(self._writer)
        self._wrapped = True

    def add(self, order: Order) -> None:
        """Log an operator's order, in the run's thread before it is obeyed."""
        self._writer.put(order_row(order))

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        """Write the rest of the queue and how the run ended; remove the recording if no rig was wrapped.

        Raises:
            CotargetError: the recording is incomplete, as on a full disk.
        """
        ending = COMPLETE if kind is None else f"{kind.__name__}: {error}".removesuffix(": ")
        self._writer.put({"end": ending, "dropped": self._writer.dropped})
        self._writer.close()
        if not self._wrapped:
            self._remove()
        elif self._writer.failure and kind is None:
            raise CotargetError(f"{self._directory}: the recording is cut short: {self._writer.failure}")

    def _write_beginning(
        self,
        config: RigConfig,
        calibration: Path,
        target: str,
        selector: TargetSelector | None,
        policy: Path | None,
    ) -> None:
        chosen = config.target(target)
        if chosen.template is not None:
            copy = TEMPLATE + chosen.template.suffix
            (self._directory / copy).write_bytes(chosen.template.read_bytes())
            chosen = dataclasses.replace(chosen, template=Path(copy))
        # Not shutil.copy: on a full disk its error names the file that it reads.
        (self._directory / CALIBRATION).write_bytes(calibration.read_bytes())
        if policy is not None:
            (self._directory / POLICY).write_bytes(policy.read_bytes())
        table = {
            "schema": SCHEMA,
            "cotarget": version("cotarget"),
            "python": platform.python_version(),
            "machine": platform.machine(),
            "opencv": cv2.__version__,
            "numpy": np.__version__,
            "when": datetime.now(UTC).isoformat(timespec="seconds"),
            "target": target,
            "whom": selector_table(selector),
            "config": config_table(dataclasses.replace(config, targets={**config.targets, target: chosen})),
        }
        part = self._directory / f"{META}.part"
        part.write_text(json.dumps(table, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        part.replace(self._directory / META)

    def _remove(self) -> None:
        """Remove all files of this recording: they cannot be replayed, and would block the next attempt."""
        for folder in (FIXED, ZOOM):
            with contextlib.suppress(OSError):
                (self._directory / folder).rmdir()
        for path in self._directory.iterdir():
            if path.name in (META, f"{META}.part", LOG, CALIBRATION, POLICY) or path.stem == TEMPLATE:
                path.unlink(missing_ok=True)
        if self._made:
            with contextlib.suppress(OSError):
                self._directory.rmdir()
