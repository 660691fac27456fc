"""Guaranteed ranges of expressions by interval arithmetic."""
