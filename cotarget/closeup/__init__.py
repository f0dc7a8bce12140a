"""Finding the target in the zoom camera's own view: the very patch that the wide view sees, registered at its scale."""

from cotarget.closeup.finder import LATEST_S, CloseupFinder, Expected, Finder, Found

__all__ = ["LATEST_S", "CloseupFinder", "Expected", "Finder", "Found"]
