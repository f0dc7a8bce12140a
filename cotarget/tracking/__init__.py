"""Track detections over time in the fixed camera's image."""
