"""Layer 5: where things are, from noisy observations, and how they move.

:mod:`kineverse.estimation.tracking` estimates the state of a model that is known,
:mod:`kineverse.estimation.identification` the model of parts whose poses are known.
"""

from .noise import pose_covariance

__all__ = ["pose_covariance"]
