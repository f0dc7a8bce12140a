"""The models of the related work: where each would send the head for a pixel of the wide view and a depth.

All but the look-up table are calibrations of which something is left out or known crudely. Lenses, the head's axes and
the depth are known to all as to the full model; of the two mountings, of the zoom camera beside the wide one and on its
head, each knows

                               turns          places
    offset ignored             as calibrated  none: all of the rig is in one place
    parallel axes              none           as calibrated between the wide camera and the head, whose axes go through
                                              the zoom camera (Choi)
    planar translation         none           the same without its part along the wide camera's axis
                                              (Bodor, Dinh, Lalonde, Marchesotti)
    planar, turns known        as calibrated  that: what the plane alone costs
    crude known offset         by protractor  by tape measure, with the scatter of CRUDE (Hampapur, Stillman, Zhou)
    look-up table              pan and tilt are learnt at pixels of a grid from targets at one depth, each centred with
                               the scatter of `Centring`, and interpolated; it ignores the depth

Whoever has such a rig can look at one target and set pan and tilt to zero there. Each model but the full one, and the
table, which is learnt that way, is therefore there twice: as it is, and `zeroed` on a target in the middle of the wide
view, which takes away the most of unknown turns, and of an unknown offset at that depth.
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
TURNED = (IGNORED, PARALLEL, PLANAR, PLANAR_TURNED, CRUDE_OFFSET)  # which may be right but for two angles
ZEROED = {name: f"{name}, zeroed" for name in TURNED}
MODELS = (FULL, *TURNED, TABLE, *ZEROED.values())


@dataclass(frozen=True)
class Crude:
    """What tape measure and protractor scatter by, one standard deviation along or about each axis.

    Attributes:
        between: of the offset between the cameras [m].
        lever: of the camera's place on the head [m].
        turn: of either's turn [rad].
    """

    between: float = 0.02
    lever: float = 0.01
    turn: float = np.radians(1.0)


@dataclass(frozen=True)
class Centring:
    """How a look-up table is learnt, and pan and tilt are set to zero.

    Attributes:
        grid: columns and rows of pixels, from edge to edge of the wide image.
        depth: of the table's targets [m].
        zero_depth: of the target for the zeros [m].
        scatter: of each axis when a target is brought to the middle [rad]; a person's, or a servo's, about one step
            of the head.
    """

    grid: tuple[int, int] = (9, 7)
    depth: float = 10.0
    zero_depth: float = 50.0
    scatter: float = np.radians(0.05)


@dataclass(frozen=True)
class Models:
    """All models of a rig.

    Attributes:
        models: as they are.
        zeros: what is added to pan and tilt of those that are zeroed besides, (2,) [rad].
    """

    models: Mapping[str, Model]
    zeros: Mapping[str, Array]

    def poses(self, pixels: Array, depths: Array) -> dict[str, Array]:
        """Pan and tilt of every one of MODELS for pixels (n, 2) and depths (n,) [m], (n, 2) [rad]."""
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
    """Every model of a rig.

    Args:
        truth: the rig, on which the table is learnt and which is measured crudely.
        calibration: of that rig; the full model, and what the others know.
        rng: draws the scatter.
        crude: how the offsets are measured.
        centring: how the table is learnt, and the zeros are set.
    """
    beside = -calibration.T_base_fixed.inv().translation  # the head's place as the wide camera has it, free of turns
    still = RigidTransform.identity()
    planar = replace(
        calibration,
        T_zoom0_fixed=RigidTransform.from_translation([*beside[:2], 0.0]),
        T_head_zoom=still,
    )
    believed = {
        FULL: calibration,
        IGNORED: without_offsets(calibration),
        PARALLEL: replace(calibration, T_zoom0_fixed=RigidTransform.from_translation(beside), T_head_zoom=still),
        PLANAR: planar,
        PLANAR_TURNED: in_plane(calibration),
        CRUDE_OFFSET: replace(
            calibration,
            T_zoom0_fixed=scattered(truth.gamma, crude.between, crude.turn, rng),
            T_head_zoom=scattered(truth.hand, crude.lever, crude.turn, rng),
        ),
    }
    models: dict[str, Model] = {name: _by(found) for name, found in believed.items()}
    models[TABLE] = learnt(truth, rng, centring)
    others = rng.spawn(len(TURNED))  # which leave the numbers that the caller draws as they are
    zeros = {name: zero_of(models[name], truth, each, centring) for name, each in zip(TURNED, others, strict=True)}
    return Models(models, zeros)


def _by(calibration: Calibration) -> Model:
    return lambda pixels, depths: aim(calibration, calibration.fixed.ray(pixels) * depths[:, None])


def in_plane(calibration: Calibration) -> Calibration:
    """The calibration with the head's centre in the wide camera's image plane, and its camera there too."""
    fixed_base = calibration.T_base_fixed.inv()
    centre = fixed_base.translation * [1.0, 1.0, 0.0]
    base_fixed = RigidTransform.from_components(centre, fixed_base.rotation).inv()
    hand = RigidTransform.from_rotation(calibration.hand_eye().rotation)
    return replace(calibration, T_zoom0_fixed=hand.inv() * base_fixed, T_head_zoom=hand)


def scattered(T: RigidTransform, shift: float, turn: float, rng: np.random.Generator) -> RigidTransform:
    """A transform as it is measured, with a scatter of each axis [m] and of the turn about each [rad]."""
    wrong = Rotation.from_rotvec(rng.normal(0, turn, 3))
    return RigidTransform.from_components(T.translation + rng.normal(0, shift, 3), wrong * T.rotation)


def learnt(truth: Truth, rng: np.random.Generator, centring: Centring = CENTRING) -> Model:
    """A look-up table over the wide image, learnt on the rig itself; cubic between the pixels of its grid."""
    columns, rows = (np.linspace(0.0, side - 1.0, count) for side, count in zip(SIZE, centring.grid, strict=True))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    q = centred(truth, pixels, centring.depth, rng, centring.scatter)
    splines = [RectBivariateSpline(rows, columns, each.reshape(len(rows), len(columns))) for each in q.T]
    return lambda pixels, depths: np.stack([spline.ev(pixels[:, 1], pixels[:, 0]) for spline in splines], axis=-1)


def zero_of(model: Model, truth: Truth, rng: np.random.Generator, centring: Centring = CENTRING) -> Array:
    """What a model's pan and tilt lack at one target in the middle of the wide view of the rig itself, (2,) [rad]."""
    middle = (np.array([SIZE]) - 1.0) / 2
    q = centred(truth, middle, centring.zero_depth, rng, centring.scatter)
    return np.asarray(q - model(middle, np.array([centring.zero_depth])))[0]


def centred(truth: Truth, pixels: Array, depth: float, rng: np.random.Generator, scatter: float) -> Array:
    """Pan and tilt at which targets at these pixels (n, 2) and a depth [m] were brought to the middle, (n, 2) [rad]."""
    q = aimed(truth, at(truth, pixels, depth), np.append(middle_of(truth.zoom), 1.0))
    return np.asarray(q + rng.normal(0, scatter, q.shape))
