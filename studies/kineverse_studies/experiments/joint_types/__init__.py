"""Experiment ``joint-types``: families of random hinges and sliders, with and without stated noise.

Each case is identified from poses and from positions of the child, with the noise stated and unknown. The
report compares the shares of right and of wrong sure answers with the targets, and probabilities with
frequencies.
"""

from .report import OPTIONS, run

__all__ = ["OPTIONS", "run"]
