from .backends import load_config as load_config
from .backends import open_rig as open_rig
from .calibration.calibrate import calibrate as calibrate
from .calibration.file import Calibration as Calibration
from .calibration.handeye import HandEye as HandEye
from .calibration.handeye import solve_hand_eye as solve_hand_eye
from .config import RigConfig as RigConfig
from .config import SimConfig as SimConfig
from .config import TargetProfile as TargetProfile
from .detection import ExternalDetector as ExternalDetector
from .errors import CalibrationError as CalibrationError
from .errors import ConfigError as ConfigError
from .errors import CotargetError as CotargetError
from .errors import DeviceError as DeviceError
from .evaluation import observe as observe
from .evaluation import true_calibration as true_calibration
from .metrics import score as score
from .pipeline import FollowSettings as FollowSettings
from .pipeline import State as State
from .pipeline import Step as Step
from .pipeline import follow as follow
from .rig import Detection as Detection
from .rig import Frame as Frame
from .rig import Rig as Rig
from .safety.signals import handle_signals as handle_signals
from .sim.world import SimWorld as SimWorld
from .targeting import Aim as Aim
from .targeting import Reach as Reach
from .targeting import WantedSize as WantedSize
from .targeting import aim as aim

__version__: str
__all__ = [
    "Aim",
    "Calibration",
    "CalibrationError",
    "ConfigError",
    "CotargetError",
    "Detection",
    "DeviceError",
    "ExternalDetector",
    "FollowSettings",
    "Frame",
    "HandEye",
    "Reach",
    "Rig",
    "RigConfig",
    "SimConfig",
    "SimWorld",
    "State",
    "Step",
    "TargetProfile",
    "WantedSize",
    "aim",
    "calibrate",
    "follow",
    "handle_signals",
    "load_config",
    "observe",
    "open_rig",
    "score",
    "solve_hand_eye",
    "true_calibration",
]
