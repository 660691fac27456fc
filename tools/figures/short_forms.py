"""Short forms of the commands that make the tables: fewer samples, seconds in place of minutes and hours.

Each returns the tables of the command's report. Several tables of one command share a run.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import kineverse as kv
from kineverse_studies.commands.reproduce import format_report
from kineverse_studies.experiments.report import Figure, Report, ReportTable

from .pages import Table, find_titled_tables

DATA = Path(os.environ.get("KINEVERSE_TEST_DATA") or os.devnull).absolute()
"""Other people's models and recordings, see ``tests/DATA.md``."""

Tables = list[tuple[str, Table]]

FIG4_CONFIGURATIONS = 20
STREAMS, STREAM_SECONDS = 1, 45.0
TYPE_CASES = 12
CALIBRATED_DRAWS, CALIBRATED_DRIVES, HAND_EYES = 4, 1, 4
GRID_SAMPLES = 3
LOCKBOXES = 20
"""Every ninth cell of the grid, with one sample."""


def _quiet(items: Iterable[Any], what: str, unit: str) -> Iterable[Any]:
    return items


def as_tables(report: Report) -> Tables:
    """Return the tables of a report as the command prints them."""
    return list(find_titled_tables(format_report(report, markdown=True)))


def tables_of(*tables: ReportTable) -> Tables:
    """Return tables of a report that the short form does not make as a whole."""
    return as_tables(Report("", "", tables, {}, Figure(lambda canvas: None, (1.0, 1.0))))


@cache
def calibration() -> Tables:
    """Calibrate few draws, and one drive without and with slips."""
    from kineverse_studies.experiments.calibration import measure, report

    return as_tables(report(*measure(_quiet, CALIBRATED_DRAWS, CALIBRATED_DRIVES, HAND_EYES, seed=1000)))


@cache
def fig4() -> Tables:
    """Track few configurations, with one seed, and without times and mechanisms."""
    from kineverse_studies.experiments.fig4.accuracy import measure_consistency, measure_errors
    from kineverse_studies.experiments.fig4.protocol import make_observed_model

    scene = make_observed_model(kv.load("kitchen"))
    errors = measure_errors(scene, range(1), FIG4_CONFIGURATIONS, _quiet)
    consistency = measure_consistency(scene, range(1), FIG4_CONFIGURATIONS, _quiet)
    return _fig4_tables(scene, errors, consistency=consistency)


@cache
def fig4_authors() -> Tables:
    """Track few configurations of the authors' kitchen by the papers' filter, and by two of its variants."""
    from kineverse_studies.experiments.fig4.accuracy import (
        VARIANTS,
        Errors,
        measure_variants,
        simulate_observations,
    )
    from kineverse_studies.experiments.fig4.protocol import LEVELS, make_observed_model, run_published

    model = DATA / "iai_kitchen" / "iai_kitchen" / "urdf_obj" / "IAI_kitchen.urdf"
    scene = make_observed_model(kv.load(model))
    errors = []
    for noise in LEVELS:
        truth, observations, training = simulate_observations(scene, noise, 0, FIG4_CONFIGURATIONS)
        found = np.abs(run_published(scene, observations, training).q - truth)[None]
        errors.append(Errors(noise, {"published": found, "proper": found}, {"published": 0.0, "proper": 0.0}))
    chosen = [one for one in VARIANTS if one.steps == 1 or one.directions == "uniform"]
    variants = measure_variants(scene, range(1), FIG4_CONFIGURATIONS, _quiet, chosen)
    return _fig4_tables(scene, tuple(errors), variants=variants)


def _fig4_tables(scene: Any, errors: Any, variants: Any = None, consistency: Any = None) -> Tables:
    from kineverse_studies.experiments.fig4 import Fig4Results, make_tables
    from kineverse_studies.experiments.fig4.accuracy import FILTERS
    from kineverse_studies.experiments.fig4.protocol import Duration

    untimed = dict.fromkeys(FILTERS, Duration(math.nan, math.nan, math.nan, 0))
    results = Fig4Results(
        model="",
        scene=scene,
        seeds=(0,),
        configurations=FIG4_CONFIGURATIONS,
        errors=errors,
        variants=variants or {},
        by_size=[],
        by_noise=[(one.noise, untimed) for one in errors],
        consistency=consistency or {},
        mechanisms=[],
    )
    return tables_of(*make_tables(results))


@cache
def sturm() -> Tables:
    """Classify all recordings, reduced to 20 poses each."""
    from kineverse_studies.experiments import Options, reproduce

    return as_tables(reproduce("sturm", options=Options(quick=True, data=DATA / "sturm_tracks")))


@cache
def sturm_statements() -> Tables:
    """Identify the shortest recording by all of its poses."""
    from kineverse_studies.experiments.sturm import answer_statements, read_labelled_pairs, statement_table

    pairs = read_labelled_pairs(DATA / "sturm_tracks")
    shortest = min(pairs, key=lambda one: len(one[2].child_poses))
    return tables_of(statement_table(answer_statements(*shortest)))


@cache
def stream_tracking() -> Tables:
    """Track a stream of 45 s."""
    from kineverse_studies.experiments.stream import make_report, make_streams, run_trackers

    model = kv.load("kitchen")
    streams = make_streams(model, range(STREAMS), _quiet, STREAM_SECONDS)
    return as_tables(make_report(run_trackers(model, streams, _quiet), []))


@cache
def stream_monitoring() -> Tables:
    """Monitor one stream of half a minute of each kind."""
    from kineverse_studies.experiments.stream import measure_monitoring, monitoring_table

    return tables_of(monitoring_table(measure_monitoring(kv.load("kitchen"), seeds=1, minutes=0.5)))


@cache
def joint_types() -> Tables:
    """Identify the first cases."""
    from kineverse_studies.experiments import Options
    from kineverse_studies.experiments.joint_types import identify_cases, report_answers

    return as_tables(report_answers(identify_cases(TYPE_CASES, _quiet, Options(processes=1))))


@cache
def conversion() -> Tables:
    """Write and check a few of the models."""
    from kineverse_studies.experiments import Options, reproduce

    return as_tables(reproduce("conversion", options=Options(quick=True, processes=1)))


@cache
def estimation_grid() -> Tables:
    """Fit few samples of each cell."""
    from kineverse_studies.experiments import Options
    from kineverse_studies.experiments.estimation_grid import fit_all, make_quick_grid, report_grid

    return as_tables(report_grid(fit_all(make_quick_grid(), GRID_SAMPLES, _quiet, Options(processes=1))))


@cache
def kitchen(what: str) -> Tables:
    """Open and close one object of the shipped kitchen, with the last robot."""
    from kineverse_studies.experiments.kitchens import KitchenJob, report_trials, run_kitchen
    from kineverse_studies.experiments.manipulation.skills import find_robots

    trials = run_kitchen(KitchenJob("kitchen", find_robots((), None)[-1], only=what))
    return as_tables(report_trials(trials, ["kitchen"]))


@cache
def pushes() -> Tables:
    """Push the fridge door shut with the last robot."""
    from kineverse_studies.experiments.manipulation.skills import find_robots
    from kineverse_studies.experiments.table1_push import SHIPPED_KITCHEN, PushJob, make_push_report, run_push

    job = PushJob(find_robots((), None)[-1], SHIPPED_KITCHEN, None, "fridge door")
    return as_tables(make_push_report(run_push(job), seed=0))


@cache
def lockbox() -> Tables:
    """Open the first random box, plan the first of each kind, and explore the first with unknown locks."""
    from kineverse_studies.experiments.lockbox import (
        KINDS,
        list_explorer_jobs,
        list_planner_jobs,
        make_explorer_table,
        make_planner_table,
        run_explorer,
        run_planner,
    )
    from kineverse_studies.experiments.lockbox.unknown_locks import (
        list_unknown_jobs,
        make_unknown_table,
        run_unknown,
    )

    explored = run_explorer(list_explorer_jobs(LOCKBOXES, 0, quick=False)[0])
    jobs = list_planner_jobs(LOCKBOXES, 0, quick=False)
    plans = {kind: run_planner(next(job for job in jobs if job.kind == kind)) for kind in KINDS}
    unknown = run_unknown(list_unknown_jobs(LOCKBOXES, 0)[0])
    return tables_of(
        make_explorer_table({("and", False): explored}),
        make_planner_table(plans),
        make_unknown_table(unknown),
    )


CHECK_SEED = 200  # first seed of the page; the checks were made with others


@cache
def checks() -> Tables:
    """Break one model in each way, by the first seed of the page."""
    from kineverse_studies.experiments import Options, reproduce

    return as_tables(reproduce("checks", options=Options(seed=CHECK_SEED, count=1)))


def has_data(folder: str) -> bool:
    """Return whether there is a folder of other people's data."""
    return (DATA / folder).exists()


@cache
def costs_of_messages() -> Tables:
    """Count few messages to two clients."""
    from faults.costs import Size, format_tables

    return list(find_titled_tables(format_tables(Size(edits=10, clients=2, seconds=1.0, turns=1))))
