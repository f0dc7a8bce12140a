"""Run experiments over seeds, keep their rows, compare figures with bounds, write the report."""
