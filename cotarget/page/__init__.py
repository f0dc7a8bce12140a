"""Serve the page from which an operator steers a run."""
