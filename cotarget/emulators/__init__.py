"""Emulators: the devices' wire protocols in front of the simulated rig; they share only bytes with the drivers."""
