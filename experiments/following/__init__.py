"""How well a target is held in the close-up."""
