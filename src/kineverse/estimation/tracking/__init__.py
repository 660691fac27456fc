"""The state of a model that is known, from noisy observations."""
