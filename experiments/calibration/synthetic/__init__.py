"""Synthetic rig: its true geometry, its cameras' views of a board, and the pointing error of a calibration.

The package's camera and head models are not used: corners come from OpenCV's projections and explicit matrices. The
truth can have what a model lacks: lenses of other kinds, a head that sags, lags, scatters or has a wrong scale, and a
lever that bends.
"""
