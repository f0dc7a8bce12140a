"""Control the head and the zoom lens, and choose which target they follow."""
