"""Two cameras that cooperate: a wide one finds a small target, a zoom camera on a pan-tilt unit shows it large."""

__version__ = "0.1.0"
