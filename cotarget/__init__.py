"""Two cooperating cameras: find a small target in a fixed camera, show it large in a zoom camera on a pan-tilt head.

    import cotarget as ct

    with ct.open_rig("rig.toml") as rig:
        calibration = ct.calibrate(rig)
        for step in ct.follow(rig, calibration, "bird", seconds=20):
            print(step.t, step.state, step.aim)

The names below are imported on first use; `__init__.pyi` says where each is defined.

Conventions: ``T_a_b`` maps from frame b to frame a. Units are metres, radians and seconds, unless a suffix says
otherwise. Pixels are (u, v), and (0, 0) is the centre of the top-left pixel. Equation numbers are those of *Cooperative
Targeting* (Shakeri and Zhang).
"""

from typing import Any

import lazy_loader

_lazy, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version(__name__)
    return _lazy(name)
