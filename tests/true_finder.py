"""Finds a target in the zoom view where it truly is, as the real finder would and without pictures."""

import numpy as np

from cotarget.closeup import CloseupFinder, Found

SIGMA_PX = 1.0  # of what is found
GATE_SIGMAS = 3.0  # as that of the real finder


def true_finder(truth, name, seed):
    """A class to stand for `CloseupFinder` in a simulated world; it finds the middle of the body, where it looks."""

    class TrueFinder(CloseupFinder):
        def see_wide(self, frame, detection, mask=None):
            return None

        def sight_at(self, t):
            return "a sight"

        def find(self, frame, expected):
            view, box = self._view(expected), truth.box(name, "zoom", frame.t)
            if view is None or box is None:
                return None
            rng = np.random.default_rng((seed, round(frame.t * 1e6)))
            at = truth.pixel("zoom", truth.center(name, frame.t), frame.t) + SIGMA_PX * rng.normal(size=2)
            off = at - view.center_px
            inside = (at >= 0).all() and (at <= np.array(frame.image.shape[1::-1]) - 1).all()
            if not inside or off @ np.linalg.solve(view.covariance, off) > GATE_SIGMAS**2:
                return None
            return Found(at, SIGMA_PX, np.full(2, SIGMA_PX), 0.9, 1.0, np.ptp(box, axis=0), frame.t)

    return TrueFinder
