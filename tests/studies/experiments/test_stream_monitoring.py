"""Short form of the monitor's experiment on streams with correlated errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

import kineverse as kv
from kineverse_studies.experiments.stream import PERIOD, measure_monitoring, repeated_motion


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
        assert row.alarms == (0 if case.startswith("as modelled") else 1), case
        assert row.cpu < math.inf
        assert case in str(row)
    for case, most in (("axis 2 cm off", 120), ("axis 2 cm off, white noise", 40)):
        assert rows[case].worst <= most
        assert rows[f"{case}, door too"].worst <= most
