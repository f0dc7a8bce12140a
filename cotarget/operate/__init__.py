"""Run a rig under an operator: the mode of each head, who has control, and the orders that the run gets."""
