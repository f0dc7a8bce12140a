"""How well a rig is calibrated."""
