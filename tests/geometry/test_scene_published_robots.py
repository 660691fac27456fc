"""Scenes of published robots and kitchens with their meshes."""

import numpy as np
import pytest
from scene_models import brute_force, by_names

import kineverse as kv
from kineverse.geometry import Scene


@pytest.mark.long
def test_scene_of_the_shipped_robot_and_kitchen():
    model = kv.load("kitchen")
    model.include("fetch")
    scene, state = Scene(model), model.default_state()
    rng = np.random.default_rng(0)
    robot = [s for s in model.degrees_of_freedom if str(s).startswith("fetch/")]
    for step in range(3):
        state = state.updated({s: state[s] + float(rng.normal()) * 0.05 for s in robot})
        scene.update(state)
        near = by_names(scene.pairs_between("fetch/base_link", "kitchen/kitchen", 0.3))
        assert near
        assert all(len({name.split("/")[0] for name in names}) == 2 for names in near)
        if step == 2:
            expected = {frozenset(n): d for n, d in brute_force(scene, state).items() if d <= 0.3}
            assert near == {
                names: pytest.approx(d, abs=1e-6)
                for names, d in expected.items()
                if len({name.split("/")[0] for name in names}) == 2
            }


def test_scene_of_the_pr2_in_the_iai_kitchen(monkeypatch, published):
    packages = [published("pr2"), published("iai_kitchen")]
    monkeypatch.setenv("KINEVERSE_PACKAGE_PATH", ":".join(map(str, packages)))
    robot = next(path for path in packages[0].rglob("*.urdf"))
    model = kv.load(str(next(path for path in packages[1].rglob("kitchen.urdf"))), prefix="kitchen")
    model.include(str(robot), prefix="pr2")
    scene, state = Scene(model), model.default_state()
    scene.update(state)
    assert len(scene.bodies) > 150
    moved = scene.bodies_moved_by("pr2/torso_lift_joint")
    assert "pr2/head_pan_link" in moved
    assert not any(name.startswith("kitchen/") for name in moved)
    near = scene.pairs_near_moving("pr2/torso_lift_joint", 0.1)
    assert [r.distance for r in near] == sorted(r.distance for r in near)
    scene.update(state.updated({"pr2/torso_lift_joint": 0.2}))
    fresh = Scene(model)
    fresh.update(state.updated({"pr2/torso_lift_joint": 0.2}))
    assert by_names(scene.pairs_within(0.05)) == by_names(fresh.pairs_within(0.05))
