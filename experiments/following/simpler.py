"""Models of the related work: where each sends the head for a pixel of the fixed view and a depth.

All but the look-up table are calibrations with parts that are neglected or known crudely. Lenses, head axes and depth
are known to all as to the full model. Of the two mountings, of the zoom camera beside the fixed one and on its head,
each model knows

                               rotations      positions
    offset ignored             as calibrated  none: the whole rig is at one point
    parallel axes              none           as calibrated between the fixed camera and the head, whose axes go through
                                              the zoom camera (Choi)
    planar translation         none           the same without its part along the fixed camera's axis
                                              (Bodor, Dinh, Lalonde, Marchesotti)
    planar, turns known        as calibrated  the same: the cost of the plane alone
    crude known offset         by protractor  by tape measure, with the scatter of CRUDE (Hampapur, Stillman, Zhou)
    look-up table              pan and tilt are learnt at pixels of a grid from targets at one depth, each centred with
                               the scatter of `Centring`, and interpolated; it ignores the depth

A user of such a rig can point it at one target and set pan and tilt to zero there. So each model but the full one and
the table, which is learnt that way, is also tested `zeroed` on a target in the middle of the fixed view. That removes
most of the effect of unknown rotations, and of an unknown offset at that depth.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import RectBivariateSpline

from cotarget.calibration import Calibration
from cotarget.geometry import Array, RigidTransform, Rotation
from experiments.calibration.pointing import without_offsets
from experiments.calibration.synthetic.aims import aim, aimed
from experiments.calibration.synthetic.rig import SIZE, Truth, middle_of
from experiments.following.mounted import at

Model = Callable[[Array, Array], Array]  # pixels (n, 2) and depths (n,) [m] -> pan and tilt (n, 2) [rad]
FULL, IGNORED, PARALLEL, PLANAR = "full model", "offset ignored", "parallel axes", "planar translation"
PLANAR_TURNED, CRUDE_OFFSET, TABLE = "planar, turns known", "crude known offset", "look-up table"
TURNED = (IGNORED, PARALLEL, PLANAR, PLANAR_TURNED, CRUDE_OFFSET)  # models that two angles may correct
ZEROED = {name: f"{name}, zeroed" for name in TURNED}
MODELS = (FULL, *TURNED, TABLE, *ZEROED.values())


@dataclass(frozen=True)
class Crude:
    """Standard deviation of measurements by tape measure and protractor, along or about each axis."""

    between: float = 0.02  # offset between the cameras [m]
    lever: float = 0.01  # position of the camera on the head [m]
    turn: float = np.radians(1.0)  # rotation of either [rad]


@dataclass(frozen=True)
class Centring:
    """How the look-up table is learnt and the zeros are set."""

    grid: tuple[int, int] = (9, 7)  # columns and rows of pixels, from edge to edge of the fixed image
    depth: float = 10.0  # depth of the table's targets [m]
    zero_depth: float = 50.0  # depth of the target for the zeros [m]
    # Standard deviation of each axis when a person or a servo centres a target, about one step of the head [rad].
    scatter: float = np.radians(0.05)


@dataclass(frozen=True)
class Models:
    """All models of a rig."""

    models: Mapping[str, Model]  # models by name
    zeros: Mapping[str, Array]  # offsets of pan and tilt of the zeroed models, (2,) [rad]

    def poses(self, pixels: Array, depths: Array) -> dict[str, Array]:
        """Give pan and tilt by each of MODELS for pixels (n, 2) and depths (n,) [m], (n, 2) [rad]."""
        found = {name: model(pixels, depths) for name, model in self.models.items()}
        return found | {ZEROED[name]: found[name] + zero for name, zero in self.zeros.items()}


CRUDE = Crude()
CENTRING = Centring()


def models_of(
    truth: Truth,
    calibration: Calibration,
    rng: np.random.Generator,
    crude: Crude = CRUDE,
    centring: Centring = CENTRING,
) -> Models:
    """Make every model of a rig.

    The table is learnt and crude measurements are made on the rig itself. The calibration is the full model, and the
    source of what the others know.
    """
    beside = -calibration.zoom_head.T_base_fixed.inv().translation  # position of the head, seen from the fixed camera
    still = RigidTransform.identity()
    planar = _between(calibration, RigidTransform.from_translation([*beside[:2], 0.0]), still)
    believed = {
        FULL: calibration,
        IGNORED: without_offsets(calibration),
        PARALLEL: _between(calibration, RigidTransform.from_translation(beside), still),
        PLANAR: planar,
        PLANAR_TURNED: in_plane(calibration),
        CRUDE_OFFSET: _between(
            calibration,
            scattered(truth.gamma, crude.between, crude.turn, rng),
            scattered(truth.hand, crude.lever, crude.turn, rng),
        ),
    }
    models: dict[str, Model] = {name: _by(found) for name, found in believed.items()}
    models[TABLE] = learnt(truth, rng, centring)
    others = rng.spawn(len(TURNED))  # do not change the caller's random numbers
    zeros = {name: zero_of(models[name], truth, each, centring) for name, each in zip(TURNED, others, strict=True)}
    return Models(models, zeros)


def _between(calibration: Calibration, T_zoom0_fixed: RigidTransform, T_head_zoom: RigidTransform) -> Calibration:
    """Give the calibration with other transforms between the cameras and the head."""
    head = replace(calibration.zoom_head, T_zoom0_fixed=T_zoom0_fixed, T_head_zoom=T_head_zoom)
    return replace(calibration, zoom_head=head)


def _by(calibration: Calibration) -> Model:
    return lambda pixels, depths: aim(calibration, calibration.fixed.ray(pixels) * depths[:, None])


def in_plane(calibration: Calibration) -> Calibration:
    """Move the head's centre into the fixed camera's image plane, and the zoom camera to that centre."""
    fixed_base = calibration.zoom_head.T_base_fixed.inv()
    centre = fixed_base.translation * [1.0, 1.0, 0.0]
    base_fixed = RigidTransform.from_components(centre, fixed_base.rotation).inv()
    hand = RigidTransform.from_rotation(calibration.zoom_head.hand_eye().rotation)
    return _between(calibration, hand.inv() * base_fixed, hand)


def scattered(T: RigidTransform, shift: float, turn: float, rng: np.random.Generator) -> RigidTransform:
    """Add measurement scatter to a transform: of each axis [m] and of the rotation about each axis [rad]."""
    wrong = Rotation.from_rotvec(rng.normal(0, turn, 3))
    return RigidTransform.from_components(T.translation + rng.normal(0, shift, 3), wrong * T.rotation)


def learnt(truth: Truth, rng: np.random.Generator, centring: Centring = CENTRING) -> Model:
    """Learn a look-up table over the fixed image on the rig itself; cubic interpolation on its grid."""
    columns, rows = (np.linspace(0.0, side - 1.0, count) for side, count in zip(SIZE, centring.grid, strict=True))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    q = centred(truth, pixels, centring.depth, rng, centring.scatter)
    splines = [RectBivariateSpline(rows, columns, each.reshape(len(rows), len(columns))) for each in q.T]
    return lambda pixels, depths: np.stack([spline.ev(pixels[:, 1], pixels[:, 0]) for spline in splines], axis=-1)


def zero_of(model: Model, truth: Truth, rng: np.random.Generator, centring: Centring = CENTRING) -> Array:
    """Measure a model's error of pan and tilt at one target in the middle of the rig's fixed view, (2,) [rad]."""
    middle = (np.array([SIZE]) - 1.0) / 2
    q = centred(truth, middle, centring.zero_depth, rng, centring.scatter)
    return np.asarray(q - model(middle, np.array([centring.zero_depth])))[0]


def centred(truth: Truth, pixels: Array, depth: float, rng: np.random.Generator, scatter: float) -> Array:
    """Give pan and tilt that centre targets at pixels (n, 2) and a depth [m], with scatter, (n, 2) [rad]."""
    q = aimed(truth, at(truth, pixels, depth), np.append(middle_of(truth.zoom), 1.0))
    return np.asarray(q + rng.normal(0, scatter, q.shape))
