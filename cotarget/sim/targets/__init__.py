"""The simulated targets: pose, gait and path."""
