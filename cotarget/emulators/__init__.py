"""The devices' wire protocols in front of the simulated rig; shares nothing with the drivers but bytes."""
