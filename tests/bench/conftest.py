"""A robot that is measured quickly, and settings that measure next to nothing."""

from __future__ import annotations

import sys

import pytest
from small_robot import SMALL_ROBOT

from kineverse.bench import BenchmarkSettings


@pytest.fixture
def robot_file(tmp_path):
    """The URDF file of a small robot."""
    file = tmp_path / "small.urdf"
    file.write_text(SMALL_ROBOT, encoding="utf-8")
    return file


@pytest.fixture
def tiny(robot_file):
    """Settings for everything on the small robot, once."""
    return BenchmarkSettings(
        robot=str(robot_file),
        frame="tip",
        rounds=2,
        processes=1,
        configurations=6,
        rows=40,
        operations=60,
        boxes=90,
    )


@pytest.fixture
def without(monkeypatch):
    """Make modules look as if they were not installed."""

    def hide(*modules):
        for module in modules:
            monkeypatch.setitem(sys.modules, module, None)

    return hide
