"""Dependence of bodies and distances on symbols."""

import numpy as np
import pytest
from scene_models import arm_among_boxes, body, brute_force, random_state

import kineverse as kv
from kineverse.geometry import Scene
from kineverse.model.body import Box


def test_bodies_moved_by_a_hinge_are_the_door_and_its_handle():
    scene = Scene(kv.load("kitchen"))
    wanted = ("kitchen/fridge_door", "kitchen/fridge_door_handle")
    assert scene.bodies_moved_by("kitchen/fridge_door") == wanted
    assert scene.bodies_moved_by(kv.velocity("kitchen/fridge_door")) == wanted
    pairs = scene.pairs_affected_by("kitchen/fridge_door")
    assert all(set(pair) & set(wanted) for pair in pairs)
    assert ("kitchen/fridge_door", "kitchen/fridge_door_handle") not in pairs
    assert ("kitchen/wall", "kitchen/fridge_door") in pairs


@pytest.mark.parametrize("base", ["DifferentialDrive", "OmniBase"])
def test_bodies_moved_by_a_wheel_are_the_whole_robot(base):
    model = kv.Model()
    with model.edit() as edit:
        options = {"radius": 0.1, "track": 0.4} if base == "DifferentialDrive" else {}
        edit.apply(getattr(kv.articulations, base)(name="base", parent="world", child="base", **options))
        edit.add_frame("chassis", "base", np.eye(4), body(Box((0.5, 0.4, 0.2))))
        arm = kv.rotation_z(kv.position("arm"))
        edit.add_frame("arm", "chassis", kv.translation(0, 0, 0.5) @ arm, body(Box((0.5, 0.1, 0.1))))
        edit.add_frame("wall", "world", kv.translation(2, 0, 0), body(Box((0.1, 3, 3))))
    scene = Scene(model)
    for speed in model.speeds:
        assert scene.bodies_moved_by(speed) == (("arm",) if speed.path == "arm" else ("chassis", "arm"))
    assert scene.bodies_moved_by(["arm"]) == ("arm",)
    assert set(scene.pairs_affected_by(next(s for s in model.speeds if s.path != "arm"))) == {
        ("chassis", "wall"),
        ("arm", "wall"),
    }


def test_bodies_moved_by_a_crank_include_those_of_dependent_coordinates():
    model = kv.load("articulations/four_bar")
    scene = Scene(model)
    (crank,) = model.degrees_of_freedom
    moved = set(scene.bodies_moved_by(crank))
    assert len(moved) >= 3
    for follower in model.rates.dependent:
        assert set(scene.bodies_moved_by(follower)) <= moved


def test_pairs_affected_by_contains_every_pair_whose_distance_changes():
    model = arm_among_boxes()
    scene, state = Scene(model), random_state(model, np.random.default_rng(0))
    for symbol in ("rail", "j2", "ball/x", "ball/wz:velocity"):
        listed = {frozenset(pair) for pair in scene.pairs_affected_by(symbol)}
        if ":" in symbol:
            changed = model.integrate(state, {symbol: 0.5, **_still(model, symbol)}, 0.1)
        else:
            changed = state.updated({symbol: state[symbol] + 0.1})
        before, after = brute_force(scene, state), brute_force(scene, changed)
        different = {frozenset(p) for p in before if abs(before[p] - after[p]) > 1e-6}
        assert different <= listed
        assert different or symbol.startswith("ball/w")
        scene.update(state)
        near = {frozenset((r.a, r.b)) for r in scene.pairs_near_moving(symbol, 0.5)}
        assert near == {p for p in listed if before[_pair(before, p)] <= 0.5}


def _still(model, symbol):
    return {str(s): 0.0 for s in model.speeds if str(s) != symbol}


def _pair(known, names):
    return next(pair for pair in known if frozenset(pair) == names)


def test_bodies_moved_by_refuses_an_unknown_symbol():
    scene = Scene(kv.load("kitchen"))
    with pytest.raises(kv.errors.UnknownNameError, match="kitchen/fridge_door"):
        scene.bodies_moved_by("kitchen/fridge_dor")
    with pytest.raises(kv.errors.UnknownNameError, match="nobody"):
        scene.pairs_affected_by(kv.position("nobody"))
