"""Emulator of the Directed Perception PTU-D46."""
