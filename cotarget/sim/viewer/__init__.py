"""Interactive windows on a simulated world: desktop and browser."""
