"""The estimate in 3D: one filter a target, fed by both cameras, each measurement with its own time.

What was compared, on simulated tracks with the rig's geometry (four or five seeds; median error of the prediction 0.2 s
ahead in the close-up, in % of its width, for a book that stands but for a second, a person and a bird; "honest" where
squared errors are about as large as the covariance says):

- no prediction: 0.6, 5.3, 37; constant velocity in the image: 2.9, 2.5, 7.5;
- velocity as a random walk: 1.1, 1.6, 6.1, honest; Singer's acceleration: 0.9, 1.4, 2.6, honest with the time constants
  in `settings`; acceleration almost constant (5 s): 0.7, 1.4, 2.5, but two to three times too sure of book and person;
- a coordinated turn laid through Singer's velocity and acceleration: no better at 0.2 s, nor at 0.6 s for the bird;
- two Singer models that take turns (IMM): 0.6, 1.3, 2.3; not honest for the bird, and at twice the cost.

Singer's won: one model, honest for person and bird; of the book only while it stands, for being put elsewhere within a
second takes ten times its usual acceleration. Where a target surprises, its acceleration's variance is raised by as
much. What limits the prediction 0.2 s ahead is the measurements' noise: with a tenth of it, 0.6 and 1.1 % in place of
1.5 and 2.8 are left for person and bird; 0.6 s ahead it is the turns, 3.4 and 12.5 in place of 5.9 and 16.5.

A pan that points wrongly and a depth that is wrong look alike along the baseline. Pointing needs only their sum, and
has it; the depth by itself is as good as the calibration.
"""

from cotarget.estimation.measurement_model import Appearance, Estimate
from cotarget.estimation.motion_model import EstimationSettings, MotionSettings, estimation_settings_for
from cotarget.estimation.target_filter import TargetFilter

__all__ = [
    "Appearance",
    "Estimate",
    "EstimationSettings",
    "MotionSettings",
    "TargetFilter",
    "estimation_settings_for",
]
