"""Two cameras that cooperate: a wide one finds a small target, a zoom camera on a pan-tilt unit shows it large.

The pipeline: a rig is calibrated from pictures of a board (`cotarget.calibration`). Then, for each frame of the wide
camera, a detector finds the target (`cotarget.detection`), a tracker keeps its identity (`cotarget.tracking.tracker`),
a
filter estimates where it is in 3D from its known size and from both views (`cotarget.estimation`,
`cotarget.estimation.zoom_matching`), the exact inverse gives pan, tilt and focal length (`cotarget.targeting`,
`cotarget.pantilt`),
and a servo sends head and lens there, ahead of all delays (`cotarget.control.controller`). `cotarget.pipeline.follow`
does all that
and yields one `cotarget.pipeline.Step` a frame; whatever draws, scores or records reads Steps.

The pipeline sees only a `cotarget.rig.Rig`: two cameras, a pan-tilt unit, a clock, and a board for calibration. Whether
that is simulated, real or a recording is up to the rig.toml (`cotarget.config`) that `cotarget.backends.open_rig`
opens.

Where to read:

- To use it: `cotarget.rig`, `cotarget.config`, `cotarget.calibration.calibrate_rig`, `cotarget.pipeline`, and
  `cotarget.safety.SafeRig`, which belongs in front of every rig that moves.
- For the method: `cotarget.geometry` for frames and conventions, then `cotarget.camera`, `cotarget.pantilt`,
  `cotarget.targeting`; equation numbers are those of the paper *Cooperative Targeting* (Shakeri and Zhang).
- For one's own target: `cotarget.detection` for the detector, `cotarget.config.SimConfig` for its model.
- For experiments: `cotarget.sim.world.SimWorld` gives a rig and the truth about it, `cotarget.metrics` the scores,
  `cotarget.env` gymnasium environments.
- For devices: `cotarget.drivers` and, to rehearse without them, `cotarget.emulators`.

Coordinates: `T_a_b` maps from frame b to frame a; metres, radians and seconds unless a name says otherwise; pixels are
(u, v) with (0, 0) in the middle of the top left one.
"""

__version__ = "0.1.0"
