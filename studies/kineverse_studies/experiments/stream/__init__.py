"""``stream``: a door that a hand opens, tracked at 30 Hz with correlated errors and outliers.

Trackers are told nothing but the noise. They are compared with a textbook filter whose process noise is
chosen with hindsight, and which starts at the truth. The monitor tests the model in the same streams.
"""

from __future__ import annotations

from kineverse.formats import load
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report

from .monitoring import measure_monitoring
from .report import make_report
from .tracking import make_streams, run_trackers

OPTIONS = ("quick",)

SEEDS, QUICK_SEEDS = 20, 2
MINUTES, QUICK_MINUTES = 6.0, 1.0
"""Length of each stream of the monitor [min]."""


def run(progress: Progress, options: Options) -> Report:
    """Track and monitor the streams; the option ``quick`` reduces 20 seeds to 2, and their length."""
    model = load("kitchen")
    seeds = QUICK_SEEDS if options.quick else SEEDS
    tracked = run_trackers(model, make_streams(model, range(seeds), progress), progress)
    minutes = QUICK_MINUTES if options.quick else MINUTES
    return make_report(tracked, measure_monitoring(model, seeds, minutes))
