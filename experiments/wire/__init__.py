"""Experiments on drivers and emulators, which communicate by the devices' wire protocols."""
