"""Offscreen rendering of both cameras."""
