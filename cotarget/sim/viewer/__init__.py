"""Windows on a simulated world: desktop and browser."""
