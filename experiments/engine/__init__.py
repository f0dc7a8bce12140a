"""Engine of the experiments: run seeds, store rows, compare figures with bounds, write the report."""
