"""``fig4``: tracking a kitchen from poses of its parts (2020 paper, IV-A; 2022 paper, IV-B, Fig. 4).

The papers' filter and :class:`kineverse.estimation.Tracker` get the same observations. In addition to the
papers' plots, errors are compared with the Cramér-Rao bound and with the covariance of each filter, under
Gaussian noise.
"""

from __future__ import annotations

from kineverse.formats import load
from kineverse.view.plots import Figure
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report

from .accuracy import measure_errors, measure_variants
from .consistency import measure_consistency
from .mechanisms import measure_mechanisms
from .protocol import CONFIGURATIONS, LEVELS, make_observed_model
from .report import FIGURE_SIZE, Fig4Results, draw_results, make_tables
from .timing import time_updates, time_updates_by_size

OPTIONS = ("quick", "model")

TIMED = 40
"""Number of configurations that are timed."""


def run(progress: Progress, options: Options) -> Report:
    """Track the model with both filters, by the papers' protocol and beyond it.

    The option ``quick`` reduces four seeds to one, and the configurations to a tenth.
    """
    model = options.model or "kitchen"
    scene = make_observed_model(load(model))
    seeds = range(1) if options.quick else range(4)
    configurations = CONFIGURATIONS // 10 if options.quick else CONFIGURATIONS
    timed = max(1, TIMED // 10) if options.quick else TIMED
    results = Fig4Results(
        model=model,
        scene=scene,
        seeds=tuple(seeds),
        configurations=configurations,
        errors=measure_errors(scene, seeds, configurations, progress),
        variants=measure_variants(scene, seeds, configurations, progress),
        by_size=time_updates_by_size(scene, timed, progress),
        by_noise=[
            (noise, time_updates(scene, noise, timed)) for noise in progress(LEVELS, "fig4: time", "level")
        ],
        consistency=measure_consistency(scene, seeds, configurations, progress),
        mechanisms=measure_mechanisms(configurations // 3, progress),
    )
    return Report(
        name="fig4",
        title=f"Tracking {len(scene.symbols)} degrees of freedom of '{model}' (2022 paper, Fig. 4)",
        tables=make_tables(results),
        numbers=results.numbers(),
        figure=Figure(lambda canvas: draw_results(canvas, results), FIGURE_SIZE),
    )
