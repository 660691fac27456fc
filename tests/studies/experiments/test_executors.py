"""Experiments on executors, those of Dask among them."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse_studies.experiments import Options, reproduce
from kineverse_studies.experiments.estimation_grid import fit_all
from kineverse_studies.experiments.estimation_grid.cramer_rao import Cell
from kineverse_studies.experiments.execution import run_jobs

CELLS = [Cell("prismatic", 0.001, np.pi / 180, count, 0.4) for count in (5, 6)]


def silent(items, what, unit):
    return items


@pytest.fixture
def dask_executor(tmp_path: Path) -> Iterator[Executor]:
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, local_directory=tmp_path
    )
    with cluster, distributed.Client(cluster) as client:
        yield client.get_executor()


def check_cells(options: Options) -> None:
    alone = fit_all(CELLS, 2, silent, Options(processes=1))
    for one, other in zip(alone, fit_all(CELLS, 2, silent, options), strict=True):
        assert one.cell == other.cell
        # The estimator stops within some percent of a standard deviation, compiled and not at different places.
        assert (np.abs(one.degrees - other.degrees) < 0.05 * one.bound_degrees).all()


def check_error(options: Options) -> None:
    """The first error of a job ends the experiment, as it is."""
    with pytest.raises(UnknownNameError, match="nowhere"):
        run_jobs(kv.load, ["nowhere.urdf"], silent, "models", "model", options)  # type: ignore[arg-type]


def test_trials_run_in_threads() -> None:
    with ThreadPoolExecutor(2) as executor:
        options = Options(executor=executor)
        check_error(options)
        assert run_jobs(range, [1, 3, 2], silent, "ranges", "range", options) == [0, 0, 1, 2, 0, 1]


@pytest.mark.long
def test_results_are_independent_of_the_number_of_processes() -> None:
    check_cells(Options(processes=2))


@pytest.mark.long
def test_trials_run_on_two_workers_of_dask(dask_executor: Executor) -> None:
    check_cells(Options(executor=dask_executor))
    check_error(Options(executor=dask_executor))


def test_experiment_of_one_process_refuses_an_executor() -> None:
    with ThreadPoolExecutor(1) as executor, pytest.raises(InvalidValueError, match="runs in one process"):
        reproduce("fig3", options=Options(executor=executor))
