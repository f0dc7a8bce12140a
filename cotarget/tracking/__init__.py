"""Track detections over time in the fixed view."""
