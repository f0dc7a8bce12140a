"""Load a user's drivers and detectors, named "module:name" in rig.toml.

The module is beside rig.toml or on Python's path. `locate` replaces a module beside rig.toml by its file, so that the
name is valid in every process and folder; `load` imports it. An error inside the user's code becomes one line that
names file and line.
"""

import contextlib
import functools
import importlib
import importlib.util
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from cotarget.errors import ConfigError, CotargetError, DeviceError, choices

FORM = "module:name"
HERE = f"{Path(__file__).parent}/"
LONGEST = 60  # a longer wrong answer is described by its type in messages [characters]


def is_own(name: str) -> bool:
    """Whether a name is of the form "module:name"."""
    module, _, attribute = name.rpartition(":")
    return bool(module) and attribute.isidentifier()


def locate(name: str, folder: Path) -> str:
    """Replace a module that lies in a folder by its file; any other name stays."""
    if not is_own(name):
        return name
    module, _, attribute = name.rpartition(":")
    file = folder / f"{module.replace('.', '/')}.py"
    return f"{file.resolve()}:{attribute}" if file.is_file() else name


def load(name: str, where: str) -> Any:
    """Import the object that "module:name" means.

    Args:
        name: as written in rig.toml, or as `locate` returned it.
        where: key of rig.toml, for messages.

    Raises:
        ConfigError: there is no such module or object, or its import fails.
    """
    module_name, _, attribute = name.rpartition(":")
    try:
        with calling(where):
            module = _from_file(module_name) if module_name.endswith(".py") else importlib.import_module(module_name)
    except DeviceError as error:
        if isinstance(error.__cause__, ModuleNotFoundError) and error.__cause__.name == module_name.split(".")[0]:
            raise ConfigError(
                f"{where}: there is no module '{module_name}' beside rig.toml or on Python's path"
            ) from None
        raise ConfigError(str(error)) from error.__cause__
    if not callable(found := getattr(module, attribute, None)):
        names = [
            key
            for key, value in vars(module).items()
            if callable(value) and getattr(value, "__module__", None) == module.__name__ and not key.startswith("_")
        ]
        raise ConfigError(f"{where}: {module_name} has no '{attribute}'; it has: {choices(names)}")
    return found


@functools.cache
def _from_file(path: str) -> ModuleType:
    """Import a file as a separate module, which can import modules beside it."""
    file = Path(path)
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    # The name is unique, because dataclasses look up their module by name: the file may be a second webcam.py, or have
    # the name of a library that it imports. Dots would make it a module of a package.
    spec = importlib.util.spec_from_file_location(path.replace(".", "_"), file)
    if spec is None or spec.loader is None or not file.is_file():
        raise ModuleNotFoundError(f"there is no {file}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[spec.name]
        raise
    return module


@contextlib.contextmanager
def calling(what: str) -> Iterator[None]:
    """Turn an error of a user's code into a DeviceError of one line that names file and line."""
    try:
        yield
    except CotargetError:
        raise
    except Exception as error:
        text = " ".join(str(error).split())
        raise DeviceError(f"{what}: {place_of(error)}: {type(error).__name__}{text and f': {text}'}") from error


def place_of(error: Exception) -> str:
    """Return file and line where an error was raised; if a library raised it, those of the user's call into it."""
    if isinstance(error, SyntaxError):
        return f"{error.filename}:{error.lineno}"
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not _is_ours(frame.filename)]
    frames = [frame for frame in frames if not _is_librarys(frame.filename)] or frames
    return f"{frames[-1].filename}:{frames[-1].lineno}" if frames else "?"


def _is_ours(file: str) -> bool:
    return file == __file__ or file.startswith("<frozen") or "importlib" in file


def _is_librarys(file: str) -> bool:
    """Whether a file is of Python's library, of an installed package, or of this one."""
    paths = sysconfig.get_paths()
    return any(file.startswith(f"{paths[name]}/") for name in ("stdlib", "purelib", "platlib")) or file.startswith(HERE)


class Answer(NamedTuple):
    """What a method or attribute of a user's device must return: the check, and its description in messages."""

    is_right: Callable[[Any], bool]
    description: str


def reporting(function: Callable[..., Any], what: str, answer: Answer | None = None) -> Callable[..., Any]:
    """Wrap a user's function so that its errors name file and line, and a wrong answer is an error."""

    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Any:
        with calling(what):
            found = function(*arguments, **keywords)
        if answer is not None and not answer.is_right(found):
            wrong = f"{function.__name__} returned {_short(found)}"
            raise DeviceError(f"{what}: {wrong}; it has to return {answer.description}")
        return found

    return call


def check_attribute(device: Any, name: str, what: str, answer: Answer) -> None:
    """Refuse a wrong attribute of a user's device."""
    with calling(what):
        found = getattr(device, name)
    if not answer.is_right(found):
        raise DeviceError(f"{what}: {name} is {_short(found)}; it has to be {answer.description}")


def _short(wrong: Any) -> str:
    text = " ".join(repr(wrong).split())
    return text if len(text) <= LONGEST else f"a {type(wrong).__name__}"


class Reporting:
    """A user's device whose errors name file and line, and whose answers are checked.

    Args:
        device: the device.
        what: its table in rig.toml, for messages.
        answers: what its methods must return, by name.
    """

    def __init__(self, device: Any, what: str, answers: Mapping[str, Answer | None]) -> None:
        self._device, self._what, self._answers = device, what, answers

    def __getattr__(self, name: str) -> Any:
        with calling(self._what):
            there = hasattr(type(self._device), name) or hasattr(self._device, name)
        if not there:
            raise AttributeError(name)  # so that hasattr works
        with calling(self._what):
            found = getattr(self._device, name)
        return reporting(found, self._what, self._answers.get(name)) if callable(found) else found
