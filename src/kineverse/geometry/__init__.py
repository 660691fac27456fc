"""Layer 4: the collision scene of a model."""
