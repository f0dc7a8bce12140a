"""Record a run's device calls, and replay them."""
