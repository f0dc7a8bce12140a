"""Command the head and the zoom lens."""
