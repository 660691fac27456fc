"""Models that come with the package, written for it."""
