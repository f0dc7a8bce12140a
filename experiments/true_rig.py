"""The calibration that is exactly true of a simulated rig."""

import numpy as np

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.pantilt import HeadGeometry
from cotarget.sim.world import SimWorld


def true_calibration(world: SimWorld, stops: int = 8) -> Calibration:
    """What a calibration of a world's rig without any error would be, at focal lengths even in the logarithm."""
    sim, truth = world.config.sim, world.truth()
    nominal = tuple(float(f) for f in np.geomspace(*truth.focal_range, stops))
    lenses = [truth.zoom_lens_for(f) for f in nominal]
    fixed, *zooms = (
        Intrinsics(lens.size, lens.focal_px, lens.center_px, lens.distortion) for lens in (truth.fixed_lens, *lenses)
    )
    real = sim.effects.axes
    return Calibration(
        fixed=fixed,
        zoom=ZoomLens(nominal, tuple(zooms), tuple(lens.pupil for lens in lenses)),
        T_zoom0_fixed=sim.T_zoom0_fixed,
        T_head_zoom=sim.T_head_zoom,
        head=HeadGeometry(sim.head.axis_offset_mm / 1000 * real, np.radians(sim.head.squareness_deg) * real),
        pitch_mm=sim.zoom.pitch_mm,
    )
