"""Experiments: one module for each table or figure that the project reports."""
