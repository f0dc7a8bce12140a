"""Offscreen rendering of both cameras: optics, exposure and sensor."""
