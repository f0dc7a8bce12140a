"""MuJoCo simulation of the rig behind the device Protocols of `cotarget.rig`."""
