"""Arm among boxes: all searches find equal pairs, and differences are errors."""

import numpy as np
import pytest

from kineverse.geometry import Scene
from kineverse_studies.bench import DisagreementError, run_benchmarks
from kineverse_studies.bench.geometry import (
    RADIUS,
    RULES,
    CoalSearch,
    KineverseSearch,
    RobotSurroundings,
    SearchEntry,
    check_distances,
    make_clutter,
)
from kineverse_studies.bench.workloads import make_kitchen_robot


@pytest.fixture(scope="module")
def arm():
    return make_clutter(steps=40)


@pytest.fixture
def scene(arm, tmp_path):
    return Scene(arm.model(tmp_path), rules=RULES)


def names(search, angles):
    search.update(angles)
    search.query()
    return {frozenset(pair[:2]) for pair in search.distances()}


def test_peers_find_the_same_pairs(arm, scene):
    pytest.importorskip("mujoco")
    from kineverse_studies.bench.peers.mujoco import MujocoPairSearch, MujocoSearch

    ours, *peers = KineverseSearch(scene), CoalSearch(scene), MujocoSearch(arm), MujocoPairSearch(arm)
    for angles in arm.angles[::8]:
        found = names(ours, angles)
        assert len(found) > 20
        assert all(names(peer, angles) == found for peer in peers)


def test_bullet_finds_the_same_pairs(arm, scene):
    pytest.importorskip("pybullet")
    from kineverse_studies.bench.peers.bullet import BulletSearch

    check_distances(
        [SearchEntry("ours", KineverseSearch(scene), 0.0), SearchEntry("bullet", BulletSearch(arm), 3e-3)],
        arm.angles,
    )


@pytest.fixture(scope="module")
def robot():
    return make_kitchen_robot(steps=40)


def test_mujoco_finds_the_pairs_of_a_robot_in_a_kitchen(robot):
    pytest.importorskip("mujoco")
    from kineverse_studies.bench.peers.mujoco import MujocoRobotSearch

    ours = SearchEntry("ours", KineverseSearch(robot.scene()), 0.0)
    room = RobotSurroundings(robot.scene(), robot.values[0], "robot/")
    assert len(names(ours.search, robot.values[0])) > 20
    check_distances([ours, SearchEntry("mujoco", MujocoRobotSearch(room), 1e-5)], robot.values)


@pytest.mark.long
def test_bullet_finds_the_pairs_of_a_robot_in_a_kitchen(robot):
    pytest.importorskip("pybullet")
    from kineverse_studies.bench.peers.bullet import BulletRobotSearch

    room = RobotSurroundings(robot.scene(), robot.values[0], "robot/")
    entries = [
        SearchEntry("ours", KineverseSearch(robot.scene()), 0.0),
        SearchEntry("bullet", BulletRobotSearch(room), 3e-3),
    ]
    check_distances(entries, robot.values[::4])


class IncompleteSearch(KineverseSearch):
    """Search that misses the nearest pair, or the furthest."""

    def __init__(self, scene, which):
        super().__init__(scene)
        self.which = which

    def distances(self):
        found = list(super().distances())
        del found[self.which]
        return iter(found)


def test_check_distances_refuses_a_missed_pair(arm, scene):
    whole = SearchEntry("whole", KineverseSearch(scene), 0.0)
    check_distances([whole, whole], arm.angles)
    with pytest.raises(DisagreementError, match="'incomplete' and 'whole' differ by"):
        check_distances([whole, SearchEntry("incomplete", IncompleteSearch(scene, 0), 1e-6)], arm.angles)
    assert max(distance for *_, distance in whole.search.distances()) > 0.9 * RADIUS
    # A pair near the radius may be missing.
    check_distances([whole, SearchEntry("incomplete", IncompleteSearch(scene, -1), 2e-2)], arm.angles[:1])


def test_further_boxes_keep_a_distance(arm):
    many = make_clutter(300, steps=40)
    np.testing.assert_array_equal(many.angles.shape, arm.angles.shape)
    assert len(many.sizes) == len(many.poses) == 300
    assert np.linalg.norm(many.poses[60:, :3, 3], axis=1).max() > 1.0


@pytest.mark.long
@pytest.mark.usefixtures("clutter_made_once")
def test_peers_that_are_not_installed_are_reported(tiny, without):
    without("mujoco", "pybullet")
    (result,) = run_benchmarks(["geometry"], tiny)
    assert {c.name.split(", ")[2] for c in result.comparisons if c.status == "missing"} >= {"beside mujoco"}
    assert any("mujoco is not installed" in line for line in result.missing)
    assert any("pybullet is not installed" in line for line in result.missing)
