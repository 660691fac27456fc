"""Benchmarks of the package beside peer libraries (layer 7).

:func:`run_benchmarks` yields a :class:`BenchmarkResult` for each benchmark. Benchmarks only measure;
no build fails because of them.
"""

from .harness import QUICK, BenchmarkSettings, DisagreementError
from .machine import Machine, describe_machine
from .registry import BENCHMARKS, run_benchmarks, select_benchmarks
from .result import Bar, BenchmarkResult, Comparison, Measurement

__all__ = [
    "BENCHMARKS",
    "QUICK",
    "Bar",
    "BenchmarkResult",
    "BenchmarkSettings",
    "Comparison",
    "DisagreementError",
    "Machine",
    "Measurement",
    "describe_machine",
    "run_benchmarks",
    "select_benchmarks",
]
