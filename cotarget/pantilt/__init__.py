"""Pan-tilt kinematics: forward, the exact inverse for any wanted pixel, and the paper's shortcut beside it.

The head turns as T_base_head = Rot(Y, pan) Trans(0, 0, dz) Rot(cos(eps) X + sin(eps) Y, tilt) Trans(0, 0, -dz); an
ideal head has dz = eps = 0. A target x_base is on the ray d of the zoom camera when some range r makes

    T_base_head(pan, tilt) T_head_zoom (r d) = x_base                                                  (Eqs. 2, 6)
"""

from cotarget.pantilt.head import IDEAL_HEAD, HeadGeometry, base_head, miss, towards, zoom_fixed
from cotarget.pantilt.inverse import Pointing, nearest, solve
from cotarget.pantilt.shortcut import shortcut

__all__ = [
    "IDEAL_HEAD",
    "HeadGeometry",
    "Pointing",
    "base_head",
    "miss",
    "nearest",
    "shortcut",
    "solve",
    "towards",
    "zoom_fixed",
]
