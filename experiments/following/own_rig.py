"""A rig of one's own for an experiment: the offsets, cameras and head of a rig.toml in the place of the default ones.

The experiment says by itself what the rig looks at: of the file everything counts but scene, seed and targets, and
their models and paths.
"""

import dataclasses
import functools
from dataclasses import dataclass
from pathlib import Path

from cotarget.config import RigConfig, config_of, read_text
from cotarget.errors import ConfigError
from experiments.engine import harness


@dataclass(frozen=True)
class RigText:
    """What a rig.toml said when it was read, and where it was; it is not read again.

    Attributes:
        text: of the file; empty for the default rig.
        path: of it, absolute, for relative paths in it; empty for the default rig.
    """

    text: str = ""
    path: str = ""

    def config(self, scene: str, targets: tuple[str, ...], seed: int) -> RigConfig:
        """The rig in a scene with targets."""
        config = config_of(self.text, Path(self.path)) if self.path else RigConfig()
        sim = dataclasses.replace(config.sim, scene=scene, targets=targets, seed=seed, models={}, paths={})
        return dataclasses.replace(config, sim=sim)


@dataclass(frozen=True)
class OwnRig(harness.Settings):
    """How many seeds, and of which rig.

    Attributes:
        rig: path of a rig.toml of a simulated rig; empty for the default rig.
        rig_toml: what that file says, so that the results of another one are not taken for these; not to be given.

    Raises:
        ConfigError: the file cannot be read, says something impossible or other than before, or is of no simulated rig.
    """

    rig: str = ""
    rig_toml: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        said = ""
        if self.rig:
            said = read_text(Path(self.rig))
            _check(said, Path(self.rig))
        if self.rig_toml not in ("", said):
            raise ConfigError(
                f"rig_toml: is not what rig = '{self.rig}' says; give the path of a rig.toml as rig alone"
            )
        object.__setattr__(self, "rig_toml", said)
        _ = self.text  # worked out now: it goes along to processes in other folders and on other machines

    @functools.cached_property
    def text(self) -> RigText:
        """What the file says, and where it is."""
        return RigText(self.rig_toml, str(Path(self.rig).absolute())) if self.rig else RigText()

    def config(self, scene: str, targets: tuple[str, ...], seed: int) -> RigConfig:
        """The rig in a scene with targets, as its file was when these settings were made."""
        return self.text.config(scene, targets, seed)


def _check(text: str, path: Path) -> None:
    """Refuse what is no simulated rig's rig.toml."""
    config = config_of(text, path)
    if config.backend != "sim":
        raise ConfigError(f"{path}: backend = '{config.backend}' cannot be tried here; give a rig.toml with 'sim'")
