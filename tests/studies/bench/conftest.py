"""Small robot, and minimal settings of benchmarks."""

import sys
from functools import cache

import pytest
from small_robot import SMALL_ROBOT

from kineverse_studies.bench import BenchmarkSettings
from kineverse_studies.bench.geometry import make_clutter
from kineverse_studies.bench.workloads import make_kitchen_robot


@pytest.fixture
def robot_file(tmp_path):
    """Return the URDF file of a small robot."""
    file = tmp_path / "small.urdf"
    file.write_text(SMALL_ROBOT, encoding="utf-8")
    return file


@pytest.fixture
def tiny(robot_file):
    """Return minimal settings with the small robot."""
    return BenchmarkSettings(
        robot=str(robot_file),
        frame="tip",
        rounds=2,
        processes=1,
        configurations=6,
        steps=6,
        rows=40,
        operations=20,
        boxes=90,
        problems=1,
        queries=2,
        robots=("pr2",),
        examples=("arm_ur5_wrist_cam_lookat",),
    )


@pytest.fixture
def without(monkeypatch):
    """Return a function that makes modules appear not installed."""

    def hide(*modules):
        for module in modules:
            monkeypatch.setitem(sys.modules, module, None)

    return hide


make_clutter_once, make_kitchen_robot_once = cache(make_clutter), cache(make_kitchen_robot)


@pytest.fixture
def clutter_made_once(monkeypatch):
    """Have the benchmark of distances make its arm and its robot once for all tests."""
    monkeypatch.setattr("kineverse_studies.bench.geometry.make_clutter", make_clutter_once)
    monkeypatch.setattr("kineverse_studies.bench.geometry.make_kitchen_robot", make_kitchen_robot_once)
