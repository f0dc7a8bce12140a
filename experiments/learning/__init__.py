"""Policies that are learnt in the environments; `python -m experiments.learning.train --help` says how."""
