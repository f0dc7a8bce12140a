"""A rig of one's own for an experiment: the offsets, cameras and head of a rig.toml in the place of the default ones.

The experiment says by itself what the rig looks at: of the file everything counts but scene, seed and targets, and
their models and paths.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from cotarget.config import RigConfig, load_config
from cotarget.errors import ConfigError
from experiments import harness


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
            _own(self.rig)
            said = Path(self.rig).read_text(encoding="utf-8")
        if self.rig_toml not in ("", said):
            raise ConfigError(
                f"rig_toml: is not what rig = '{self.rig}' says; give the path of a rig.toml as rig alone"
            )
        object.__setattr__(self, "rig_toml", said)

    def config(self, scene: str, targets: tuple[str, ...], seed: int) -> RigConfig:
        """The rig in a scene with targets."""
        config = _own(self.rig) if self.rig else RigConfig()
        sim = dataclasses.replace(config.sim, scene=scene, targets=targets, seed=seed, models={}, paths={})
        return dataclasses.replace(config, sim=sim)


def _own(rig: str) -> RigConfig:
    config = load_config(Path(rig))
    if config.backend != "sim":
        raise ConfigError(f"{rig}: backend = '{config.backend}' cannot be tried here; give a rig.toml with 'sim'")
    return config
