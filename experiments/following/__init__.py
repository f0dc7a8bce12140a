"""Experiments on following: how well the rig keeps a target in the close-up, and against what alternatives."""
