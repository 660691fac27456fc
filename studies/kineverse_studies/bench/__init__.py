"""Benchmarks of the package, with peer libraries. They only measure: no build fails because of them."""

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
