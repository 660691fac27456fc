"""Experiment ``estimation-grid``: identified hinges and sliders over noise, number and range of observations.

Each fit is compared with the Cramér-Rao bound of its own sample, see :mod:`.cramer_rao`, and the most
probable family with the true one.
"""

from .report import OPTIONS, run

__all__ = ["OPTIONS", "run"]
