"""Commands ``kineverse bench`` and ``kineverse reproduce``, found by entry points."""
