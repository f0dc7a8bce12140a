"""The paper's own solution of pan and tilt, which takes a depth for the range; kept to be compared with."""

from typing import Literal

import numpy as np

from cotarget.geometry import Array, RigidTransform
from cotarget.pantilt.inverse import TURN, Pointing


def shortcut(
    x_fixed: Array,
    T_zoom0_fixed: RigidTransform,
    T_head_zoom: RigidTransform,
    reading: Literal["table", "example"],
) -> Pointing:
    """The paper's own solution, which takes a depth for the range; kept to be compared with.

    P is a rotation, so |x_head| must equal |x_base|; a depth in place of the range does not satisfy that, and the
    rows of (7) contradict each other: (13) and (16) use the first two and the third only chooses the sign.

    Args:
        x_fixed: targets in the fixed camera's frame [m], (..., 3).
        T_zoom0_fixed: Gamma.
        T_head_zoom: T.
        reading: which depth is z: "table" (Table 1) that in x_fixed, "example" (Section 4.2) that in x_zoom0.

    Returns:
        Pan, tilt and that depth, (...); nan where |b| > r1 or |a| > r2.
    """
    x_fixed = np.asarray(x_fixed, float)
    x_zoom0 = T_zoom0_fixed.apply(x_fixed.reshape(-1, 3)).reshape(x_fixed.shape)
    x_base = T_head_zoom.apply(x_zoom0.reshape(-1, 3)).reshape(x_fixed.shape)
    z = (x_fixed if reading == "table" else x_zoom0)[..., 2]
    x_head = z[..., None] * T_head_zoom.rotation.as_matrix()[:, 2] + np.asarray(T_head_zoom.translation)  # (6)
    (x, y, z1), (a, b, c) = np.moveaxis(x_head, -1, 0), np.moveaxis(x_base, -1, 0)
    with np.errstate(invalid="ignore"):
        tilt = np.arctan2(y, z1) - np.arcsin(b / np.hypot(y, z1))  # (13)
        z2 = np.sin(tilt) * y + np.cos(tilt) * z1  # (14)
        swing = np.arccos(a / np.hypot(x, z2))
        pans = np.stack([np.arctan2(z2, x) + swing, np.arctan2(z2, x) - swing], axis=-1)  # (16)
        off = np.abs(-np.sin(pans) * x[..., None] + np.cos(pans) * z2[..., None] - c[..., None])
        pan = np.where(off[..., 0] <= off[..., 1], pans[..., 0], pans[..., 1])
    return Pointing((pan + np.pi) % TURN - np.pi, tilt, np.where(np.isfinite(pan), z, np.nan))
