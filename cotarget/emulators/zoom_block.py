"""Zoom blocks: how the zoom numbers of a camera go with its magnification."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ZoomBlock:
    """A zoom block, whose motor is even in the logarithm of the focal length.

    Attributes:
        knots: zoom numbers and magnifications, both rising, from 1 x on.
    """

    knots: tuple[tuple[float, float], ...]

    def share(self, number: float) -> float:
        """Give the motor's position of a zoom number, from 0 to 1."""
        return float(np.interp(number, self._numbers, self._shares))

    def number(self, share: float) -> float:
        """Give the zoom number of a motor's position from 0 to 1."""
        return float(np.interp(share, self._shares, self._numbers))

    def lens_table(self, magnification: float) -> list[list[float]]:
        """List zoom numbers and magnifications of a lens that magnifies so many times at its longest."""
        return [[number, magnification**share] for number, share in zip(self._numbers, self._shares, strict=True)]

    @property
    def _numbers(self) -> list[float]:
        return [float(number) for number, _ in self.knots]

    @property
    def _shares(self) -> list[float]:
        logarithms = np.log([times for _, times in self.knots])
        return (logarithms / logarithms[-1]).tolist()
