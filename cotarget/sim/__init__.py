"""The simulated rig: a MuJoCo world behind the device Protocols."""
