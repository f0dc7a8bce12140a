"""Results on disk: a file a job, written at once and whole, so that a sweep that was broken off goes on.

    DIR/NAME/jobs/000007.json            what one job gave, with its settings, its seed and the version of the code;
                                         pictures as PNG in base64
    DIR/NAME/jobs/000007.traceback.txt   where one failed
    DIR/NAME/result.json, rows.csv, figure.png, and the pictures of the first job that has any
    DIR/sessions.json                    when jobs were done, by whom and for how long
    DIR/report.html

Numbers are written so that they are read back as they were; NaN and Infinity stand as Python writes them.
"""

import base64
import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cotarget
import experiments
from cotarget.assets import assets_dir
from cotarget.errors import ConfigError
from cotarget.outputs import write_whole
from experiments.harness import Row, Settings, versions

FORMAT = 2  # of the files
JOBS = "jobs"  # their folder
JOB_FILES = "[0-9]*.json"  # what a killed run has left half-written begins with a dot
LOCK = ".lock"  # held by the run that writes
ONLY_HOW_MANY = ("seeds", "processes")  # settings that change no job, only how many there are and who does them
SHORT = 8  # digits of a fingerprint
REMEDY = "take another folder with --out, or begin anew with --fresh"
KEEP = ", or keep it all the same with --any-code"


@dataclass(frozen=True)
class Record:
    """What came of one job.

    Attributes:
        number: its seed.
        seconds: that it took [s].
        cpu_s: processor time of it [s]; what it leaves to other processes does not count.
        version: of the code that did it, as `code_version` gives it.
        renders: pictures that MuJoCo drew for it, in its own process.
        rows: that it gave; None where it failed.
        failed: why, in one line.
        traceback: where.
        pictures: that it made, PNGs by name.
    """

    number: int
    seconds: float
    cpu_s: float
    version: str
    renders: int
    rows: list[Row] | None
    failed: str = ""
    traceback: str = ""
    pictures: Mapping[str, bytes] = field(default_factory=dict)


@functools.cache
def code_version() -> str:
    """The package's version and a fingerprint of what rows depend on: the code and the libraries' versions.

    Of the scenes and targets the descriptions count; their meshes and pictures are made by a program that does.
    """
    found = hashlib.sha256(json.dumps(versions()).encode())
    for folder in (*(Path(module.__file__ or "").parent for module in (cotarget, experiments)), assets_dir()):
        for path in sorted(path for kind in ("*.py", "*.xml") for path in folder.rglob(kind)):
            found.update(path.relative_to(folder.parent).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return f"{cotarget.__version__}+{found.hexdigest()[:SHORT]}"


def is_same_version(one: str, other: str, *, any_code: bool) -> bool:
    """Whether results of two versions may stand side by side.

    Args:
        one: what `code_version` gave.
        other: likewise.
        any_code: whether the fingerprints may differ.
    """
    return one.partition("+")[0] == other.partition("+")[0] if any_code else one == other


def identity(settings: Settings) -> dict[str, Any]:
    """The settings that a job's rows depend on, as JSON has them."""
    told = {key: value for key, value in dataclasses.asdict(settings).items() if key not in ONLY_HOW_MANY}
    read: dict[str, Any] = json.loads(json.dumps(told, default=str))
    return read


@contextlib.contextmanager
def taken(folder: Path) -> Iterator[None]:
    """Keep other runs from writing results into a folder, which is made where there is none, as long as this lasts.

    Raises:
        ConfigError: another run does.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"{folder}: another run is writing its results there; wait for it, or take another folder with --out"
            ) from None
        except OSError:  # not every file system knows locks
            pass
        yield


class Jobs:
    """The files of one experiment's jobs with one choice of settings.

    Args:
        folder: of the experiment.
        name: how it is called in messages.
        settings: that all jobs share.
    """

    def __init__(self, folder: Path, name: str, settings: Settings) -> None:
        self._folder, self._name, self._identity = folder / JOBS, name, identity(settings)

    def read(self, *, any_code: bool = False) -> dict[int, Record]:
        """What is there, by number.

        Raises:
            ConfigError: a file cannot be read, or is of another version, or of other settings.
        """
        return {record.number: record for record in self._records(any_code)}

    def _records(self, any_code: bool) -> Iterator[Record]:
        for path in sorted(self._folder.glob(JOB_FILES)):
            try:
                told = json.loads(path.read_text(encoding="utf-8"))
                kind, settings, version = told["format"], told["settings"], told["version"]
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise ConfigError(f"{path}: cannot be read ({type(error).__name__}); delete it, or {REMEDY}") from None
            if kind != FORMAT:
                raise ConfigError(f"{path}: is of format {kind}, this is format {FORMAT}; {REMEDY}")
            if not is_same_version(version, code_version(), any_code=any_code):
                keep = "" if any_code or not is_same_version(version, code_version(), any_code=True) else KEEP
                raise ConfigError(f"{path}: is of cotarget {version}, this is {code_version()}; {REMEDY}{keep}")
            if settings != self._identity:
                raise ConfigError(f"{path}: {self._differing(settings)}; {REMEDY}")
            names = [part.name for part in dataclasses.fields(Record) if part.name != "number"]
            told["pictures"] = {name: base64.b64decode(png) for name, png in told["pictures"].items()}
            yield Record(told["seed"], **{name: told[name] for name in names})

    def _differing(self, settings: dict[str, Any]) -> str:
        keys = [key for key in {**self._identity, **settings} if self._identity.get(key) != settings.get(key)]
        there, here = (json.dumps(each.get(keys[0])) for each in (settings, self._identity))
        return f"is of {self._name} with {keys[0]} = {there}, here it is {here}"

    def write(self, record: Record) -> None:
        """Put a job's file there, whole or not at all.

        Raises:
            ConfigError: it cannot be written.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        told = {"format": FORMAT, "experiment": self._name, "settings": self._identity, "seed": record.number}
        told |= {key: value for key, value in dataclasses.asdict(record).items() if key != "number"}
        told["pictures"] = {name: base64.b64encode(png).decode() for name, png in record.pictures.items()}
        traceback = self._folder / f"{record.number:06d}.traceback.txt"
        if record.failed:
            write_whole(traceback, record.traceback.encode())
        write_whole(self._folder / f"{record.number:06d}.json", (json.dumps(told) + "\n").encode())
        if not record.failed:
            traceback.unlink(missing_ok=True)

    def forget(self) -> None:
        """Delete the files of all jobs."""
        for pattern in (JOB_FILES, "[0-9]*.traceback.txt"):
            for path in self._folder.glob(pattern):
                path.unlink()
