"""Streams of a door, and monitoring of them: the short form of ``kineverse reproduce stream``."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

import kineverse as kv
from kineverse_studies.experiments.stream import (
    PERIOD,
    StreamErrors,
    correlated_errors,
    make_report,
    make_streams,
    measure_monitoring,
    repeated_motion,
    run_trackers,
    summarize_trackers,
)

MODEL = kv.load("kitchen")


def no_progress(items: Iterable[Any], what: str, unit: str) -> Iterable[Any]:
    return items


@pytest.fixture(scope="module")
def tracked():
    return run_trackers(MODEL, make_streams(MODEL, range(2), no_progress, duration=15.0), no_progress)


def test_errors_are_correlated_as_stated():
    errors = correlated_errors(40_000, (4,), np.random.default_rng(0), StreamErrors())
    assert errors.std() == pytest.approx(1.0, abs=0.03)
    for lag in (1, 10):
        assert np.mean(errors[lag:] * errors[:-lag]) == pytest.approx(0.7 * 0.95**lag, abs=0.04)


@pytest.mark.long
def test_trackers_follow_the_door_and_are_never_silently_lost(tracked):
    summaries = {summary.name: summary for summary in summarize_trackers(tracked)}
    textbook, velocity = summaries["textbook"], summaries["velocity"]
    for name in ("position", "velocity"):
        assert summaries[name].silently_lost < 1.0
        # Less than 1 while the door is shut, at its limit.
        assert 0.3 < summaries[name].nees < 1.5
    assert velocity.moving < 1.1 * textbook.moving
    assert velocity.resting < 1.05 * textbook.resting
    assert velocity.moving < 0.9 * summaries["position"].moving


@pytest.mark.long  # the table of the docs is made of this report as well
def test_report_has_a_row_for_each_filter(tracked, tmp_path):
    report = make_report(tracked, [])
    assert [row[0] for row in report.tables[0].rows] == ["position", "velocity", "textbook"]
    assert report.numbers["tracking"][2]["mean_time"] is None
    report.figure.save(tmp_path / "stream.png")
    assert (tmp_path / "stream.png").stat().st_size > 10_000


def test_repeated_motion_is_smooth() -> None:
    angles = repeated_motion(np.arange(0.0, 3.0 * PERIOD, 1.0 / 30.0))
    assert np.abs(np.diff(angles)).max() < 0.03
    assert angles[0] == 0.0
    assert angles.max() == pytest.approx(1.3)


@pytest.mark.long
def test_monitor_on_correlated_streams() -> None:
    rows = {
        row.case: row
        for row in measure_monitoring(kv.load("kitchen"), seeds=1, minutes=0.2, displacements=(0.02,))
    }
    for case, row in rows.items():
        assert row.alarms == (0 if case.startswith(("as modelled", "repaired")) else 1), case
        assert row.cpu < math.inf
        assert case in str(row)
    for case, most in (("axis 2 cm off", 120), ("axis 2 cm off, white noise", 40)):
        assert rows[case].worst <= most
        assert rows[f"{case}, door too"].worst <= most
