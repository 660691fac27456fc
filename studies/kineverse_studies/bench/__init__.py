"""Benchmarks of the package beside peer libraries (layer 7).

:func:`run_benchmarks` yields a :class:`BenchmarkResult` for each benchmark. Benchmarks only measure;
no build fails because of them.
"""

from .harness import (
    BENCHMARKS,
    QUICK,
    Bar,
    BenchmarkResult,
    BenchmarkSettings,
    Comparison,
    DisagreementError,
    Machine,
    Measurement,
    describe_machine,
    run_benchmarks,
    select_benchmarks,
)

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
