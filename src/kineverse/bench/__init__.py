"""Layer 7: speed, measured beside the peers.

:func:`run_benchmarks` yields a :class:`BenchmarkResult` for each benchmark. A benchmark measures; whether a
build passes is decided by tests alone.
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
