"""Experiments: one file a table or figure, each a script whose numbers the project states."""
