"""Commits: checks before them, their net changes, undo, and listeners and followers after them."""
