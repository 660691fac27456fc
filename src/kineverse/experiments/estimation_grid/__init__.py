"""``estimation-grid``: hinges and sliders from poses, over noise, number and range of observations.

Each fit is held against the Cramér-Rao bound of its own sample, see :mod:`.bound`, and the most probable
family against the true one.
"""

from .report import OPTIONS, run

__all__ = ["OPTIONS", "run"]
