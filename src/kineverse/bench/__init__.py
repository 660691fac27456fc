"""Layer 7: speed, measured beside the peers.

:func:`measure` yields a :class:`Result` for each benchmark. Nothing here decides whether a build passes: a
benchmark measures, a test decides.
"""

from .agreement import DisagreementError
from .machine import Machine, machine
from .registry import BENCHMARKS, chosen, measure
from .result import Bar, Comparison, Measurement, Result
from .settings import QUICK, Settings

__all__ = [
    "BENCHMARKS",
    "QUICK",
    "Bar",
    "Comparison",
    "DisagreementError",
    "Machine",
    "Measurement",
    "Result",
    "Settings",
    "chosen",
    "machine",
    "measure",
]
