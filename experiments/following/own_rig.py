"""The rig of an experiment: the default one, or offsets, cameras and head of a user's rig.toml; and its calibration.

The experiment sets scene, seed, targets, models and paths itself; everything else is taken from the file.
"""

import dataclasses
import fcntl
import functools
import hashlib
import os
import pickle
from dataclasses import dataclass
from pathlib import Path

from cotarget.backends import load_config
from cotarget.calibration import Calibration
from cotarget.calibration.calibrate import calibrate
from cotarget.config import RigConfig, read_text
from cotarget.errors import ConfigError
from cotarget.files import write_atomically
from cotarget.safety.safe_rig import guard
from cotarget.sim.world import SimWorld
from experiments.engine import SHARED, Settings


@dataclass(frozen=True)
class RigText:
    """Content and path of a rig.toml when it was read; it is not read again."""

    text: str = ""  # content of the file; empty for the default rig
    path: str = ""  # absolute path of the file, for relative paths in it; empty for the default rig

    def config(self, scene: str, targets: tuple[str, ...], seed: int) -> RigConfig:
        """Configure the rig in a scene with targets."""
        config = load_config(self.path, self.text) if self.path else RigConfig()
        sim = dataclasses.replace(config.sim, scene=scene, targets=targets, seed=seed, models={}, paths={})
        return dataclasses.replace(config, sim=sim)


@functools.cache
def calibrated_rig(rig: RigText, seed: int) -> Calibration:
    """Calibrate a rig from rendered boards indoors; experiments of one run on this machine share the result."""
    if (folder := os.environ.get(SHARED)) is None:
        return _calibrate(rig, seed)
    path = Path(folder) / f"{hashlib.sha256(repr((rig, seed)).encode()).hexdigest()}.pickle"
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # wait for a process that is calibrating the same rig
        if not path.exists():
            write_atomically(path, pickle.dumps(_calibrate(rig, seed)))
    found: Calibration = pickle.loads(path.read_bytes())
    return found


def _calibrate(rig: RigText, seed: int) -> Calibration:
    config = rig.config("indoor", (), seed)
    with guard(SimWorld(config).rig, config.safety) as opened:
        return calibrate(opened, config.board, seed=seed)


@dataclass(frozen=True)
class OwnRig(Settings):
    """Settings with an optional rig of the user's own.

    Raises:
        ConfigError: the file cannot be read, is invalid, has changed, or is not of a simulated rig.
    """

    rig: str = ""  # path of a rig.toml of a simulated rig; empty for the default rig
    rig_toml: str = ""  # content of that file, so that results of another file are not reused; set by the class

    def __post_init__(self) -> None:
        said = ""
        if self.rig:
            said = read_text(Path(self.rig))
            _check(said, Path(self.rig))
        if self.rig_toml not in ("", said):
            raise ConfigError(
                f"rig_toml: is not what rig = '{self.rig}' says; give the path of a rig.toml as rig alone"
            )
        object.__setattr__(self, "rig_toml", said)
        _ = self.text  # computed now, because processes on other machines or in other folders cannot read the file

    @functools.cached_property
    def text(self) -> RigText:
        """Content and path of the file."""
        return RigText(self.rig_toml, str(Path(self.rig).absolute())) if self.rig else RigText()

    def config(self, scene: str, targets: tuple[str, ...], seed: int) -> RigConfig:
        """Configure the rig in a scene with targets, from the file as it was when these settings were made."""
        return self.text.config(scene, targets, seed)


def _check(text: str, path: Path) -> None:
    """Refuse a file that is not the configuration of a simulated rig."""
    config = load_config(path, text)
    if config.backend != "sim":
        raise ConfigError(f"{path}: backend = '{config.backend}' cannot be tried here; give a rig.toml with 'sim'")
