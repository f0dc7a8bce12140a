"""Benchmarks of computing time: simulation, pipeline, calibration, sweeps and environments."""
