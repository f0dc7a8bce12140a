"""Result files: one file per job, written atomically, so that an interrupted sweep can resume.

    DIR/NAME/jobs/000007.json            rows of one job, with settings, seed and version of the code; pictures as PNG
                                         in base64
    DIR/NAME/jobs/000007.traceback.txt   traceback of a failed job
    DIR/NAME/jobs/shared.json            time and renders that the preparation took
    DIR/NAME/result.json, rows.csv, figure.png, and the pictures of the first job that has any
    DIR/sessions.json                    when jobs were done, by which workers, and how long they took
    DIR/report.html

Numbers are written so that they are read back exactly; NaN and Infinity are written as Python does.
"""

import base64
import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cotarget
import experiments
from cotarget.errors import ConfigError
from cotarget.files import assets_dir, write_atomically
from experiments.engine.harness import Row, Settings
from experiments.engine.versions import versions

FORMAT = 2  # format of the job files
JOBS = "jobs"  # folder of the job files
JOB_FILES = "[0-9]*.json"  # files that a killed run leaves half-written begin with a dot
LOCK = ".lock"  # lock file of the run that writes
ONLY_HOW_MANY = ("seeds", "processes")  # settings that change no row
SHORT = 8
REMEDY = "take another folder with --out, or begin anew with --fresh"
AS_BEFORE = "ask as before (--quick, --seed-base, --set), "
KEEP = ", or keep it all the same with --any-code"
SHARED = "shared.json"
# Modules on which no row depends: they select, record and report.
NO_ROWS = (
    "__main__",
    *("paper/gallery", "paper/teaser"),
    *("engine/arguments", "engine/bounds", "engine/cases", "engine/command", "engine/outcome", "engine/report"),
    *("engine/runner", "engine/sessions"),
)


@dataclass(frozen=True)
class Record:
    """Result of one job.

    Attributes:
        number: seed of the job.
        seconds: wall time [s].
        cpu_s: processor time [s]; see `Spent`.
        version: version of the code that did the job, from `code_version`.
        renders: number of pictures that MuJoCo drew; see `Spent`.
        rows: rows of the job; None if it failed.
        failed: reason of the failure in one line.
        traceback: traceback of the failure.
        pictures: PNGs by name.
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


@dataclass(frozen=True)
class Spent:
    """Time and renders that some work took.

    Attributes:
        seconds: wall time [s].
        cpu_s: processor time, including processes that it started and waited for [s].
        renders: number of pictures that MuJoCo drew, in any process.
    """

    seconds: float = 0.0
    cpu_s: float = 0.0
    renders: int = 0


NOTHING = Spent()


def fingerprint() -> str:
    """Compute the package's version with hashes of what rows depend on: the code and the libraries' versions.

    Of scenes and targets only the MJCF files are hashed; their meshes and textures are made by a program that is
    hashed.
    """
    found, here = hashlib.sha256(), Path(experiments.__file__ or "").parent
    for folder in (Path(cotarget.__file__ or "").parent, here, here.parent / "benchmarks", assets_dir()):
        for path in sorted(path for kind in ("*.py", "*.xml") for path in folder.rglob(kind)):
            if folder != here or path.relative_to(here).with_suffix("").as_posix() not in NO_ROWS:
                found.update(path.relative_to(folder.parent).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    libraries = hashlib.sha256(json.dumps(versions()).encode())
    return f"{cotarget.__version__}+{found.hexdigest()[:SHORT]}.{libraries.hexdigest()[:SHORT]}"


@functools.cache
def code_version() -> str:
    """Give the first `fingerprint` of this process; call it before the process loads the code that it is of."""
    return fingerprint()


def differing(one: str, other: str) -> str:
    """Give the first difference of two fingerprints: "version" of the package, "code" or "libraries"; empty if none."""
    parts: Mapping[str, Callable[[str], str]] = {
        "version": lambda v: v.partition("+")[0],
        "code": lambda v: v.rpartition(".")[0],
        "libraries": str,
    }
    return next((what for what, part in parts.items() if part(one) != part(other)), "")


def identity(settings: Settings) -> dict[str, Any]:
    """Give the settings that a job's rows depend on, as JSON reads them back."""
    told = {key: value for key, value in dataclasses.asdict(settings).items() if key not in ONLY_HOW_MANY}
    read: dict[str, Any] = json.loads(json.dumps(told, default=str))
    return read


@contextlib.contextmanager
def taken(folder: Path) -> Iterator[None]:
    """Lock a folder against other runs that write results; make it where it does not exist.

    Raises:
        ConfigError: another run holds the lock.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"{folder}: another run is writing its results there; wait for it, or take another folder with --out"
            ) from None
        except OSError:  # not every file system supports locks
            pass
        yield


class Jobs:
    """Job files of one experiment with given settings.

    Args:
        folder: folder of the experiment.
        name: name of the experiment in messages.
        settings: settings of all jobs.
    """

    def __init__(self, folder: Path, name: str, settings: Settings) -> None:
        self._folder, self._name, self._identity = folder / JOBS, name, identity(settings)

    def read(self, *, any_code: bool = False) -> dict[int, Record]:
        """Read all job files, by number.

        Raises:
            ConfigError: a file cannot be read, or is of another version or of other settings.
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
            other = differing(version, code_version())
            if other == "version" or (other and not any_code):
                keep = "" if other == "version" else KEEP
                told = f"is of cotarget {version}, this is {code_version()}, of other {other}"
                raise ConfigError(f"{path}: {told}; {REMEDY}{keep}")
            if settings != self._identity:
                raise ConfigError(f"{path}: {self._differing(settings)}; {AS_BEFORE}{REMEDY}")
            names = [part.name for part in dataclasses.fields(Record) if part.name != "number"]
            try:
                told["pictures"] = {
                    name: base64.b64decode(png, validate=True) for name, png in told["pictures"].items()
                }
                yield Record(told["seed"], **{name: told[name] for name in names})
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise ConfigError(f"{path}: lacks something ({type(error).__name__}); delete it, or {REMEDY}") from None

    def _differing(self, settings: dict[str, Any]) -> str:
        keys = [key for key in {**self._identity, **settings} if self._identity.get(key) != settings.get(key)]
        there, here = (json.dumps(each.get(keys[0])) for each in (settings, self._identity))
        return f"is of {self._name} with {keys[0]} = {there}, here it is {here}"

    def write(self, record: Record) -> None:
        """Write a job's file atomically.

        Raises:
            ConfigError: the file cannot be written.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        told = {**self._head, "seed": record.number}
        told |= {key: value for key, value in dataclasses.asdict(record).items() if key != "number"}
        told["pictures"] = {name: base64.b64encode(png).decode() for name, png in record.pictures.items()}
        traceback = self._folder / f"{record.number:06d}.traceback.txt"
        if record.failed:
            write_atomically(traceback, record.traceback.encode())
        write_atomically(self._folder / f"{record.number:06d}.json", (json.dumps(told) + "\n").encode())
        if not record.failed:
            traceback.unlink(missing_ok=True)

    @property
    def _head(self) -> dict[str, Any]:
        return {"format": FORMAT, "experiment": self._name, "settings": self._identity}

    def write_shared(self, spent: Spent) -> None:
        """Record what the preparation of the shared object took.

        Raises:
            ConfigError: the file cannot be written.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        write_atomically(
            self._folder / SHARED, (json.dumps({**self._head, **dataclasses.asdict(spent)}) + "\n").encode()
        )

    def read_shared(self) -> Spent:
        """Read what the preparation took; zero where that is unknown."""
        try:
            told = json.loads((self._folder / SHARED).read_text(encoding="utf-8"))
            return Spent(**{part.name: told[part.name] for part in dataclasses.fields(Spent)})
        except (OSError, ValueError, KeyError, TypeError):
            return NOTHING

    def forget(self) -> None:
        """Delete the files of all jobs."""
        for pattern in (JOB_FILES, "[0-9]*.traceback.txt", SHARED):
            for path in self._folder.glob(pattern):
                path.unlink()
