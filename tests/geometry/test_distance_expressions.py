"""Distances as expressions: value, gradient against finite differences, across contact, in documents."""

import numpy as np
import pytest
from scene_models import arm_among_boxes, body, random_state

import kineverse as kv
from kineverse.geometry import Scene
from kineverse.geometry.bindings import collision_library
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere


def slopes(scene, state, pair, symbols, step=1e-5):
    """Central differences of the distance by coordinates, of what the scene measures."""
    found = []
    for symbol in symbols:
        ends = []
        for sign in (1, -1):
            scene.update(state.updated({symbol: state[symbol] + sign * step}))
            ends.append(scene.distance(*pair).distance)
        found.append((ends[0] - ends[1]) / (2 * step))
    return np.array(found)


def test_gradient_of_a_distance_expression_matches_finite_differences():
    model = arm_among_boxes()
    scene, rng = Scene(model), np.random.default_rng(7)
    symbols = [kv.position(name) for name in ("rail", "j0", "j1", "j2", "j3", "j4", "ball/x", "ball/y")]
    signs = set()
    for k in range(8):
        state = random_state(model, rng)
        if k % 2:  # the ball is partly in the hand
            x, y, z = model.fk("hand")(state)[:3, 3] + [0.03, 0.06, 0.02]
            state = state.updated({"ball/x": x, "ball/y": y, "ball/z": z})
        for pair in (("hand", "box0"), ("link2", "box3"), ("hand", "ball/body"), ("ball/body", "box1")):
            scene.update(state)
            distance = scene.expression(*pair)
            values = state | kv.State(scene.expression_values(distance))
            measured = scene.distance(*pair)
            assert distance.expression(values) == pytest.approx(measured.distance, abs=1e-9)
            for name in ("point_a", "point_b", "normal"):
                given, found = getattr(distance, name)(values), getattr(measured, name)
                np.testing.assert_allclose(given, found, atol=1e-9)
            exact = distance.expression.jacobian(symbols)(values)
            np.testing.assert_allclose(exact, slopes(scene, state, pair, symbols), atol=2e-3)
            signs.add(measured.distance > 0)
    assert signs == {True, False}


@pytest.mark.parametrize("geometry", [Box((0.4, 0.3, 0.2)), Sphere(0.2), Capsule(0.1, 0.3), Cylinder(0.2, 0.3),
                                      Ellipsoid((0.2, 0.3, 0.1))])  # fmt: skip
def test_distance_expression_is_signed_and_finite_across_contact(geometry):
    """A thing comes down on a table, through it, and the distance falls at the same rate all the way."""
    model = kv.Model()
    height, turn = kv.position("height"), kv.position("turn")
    with model.edit() as edit:
        edit.add_frame("table", "world", np.eye(4), body(Box((4, 4, 1)), at=(0, 0, -0.5)))
        pose = kv.translation(0, 0, height) @ kv.rotation_x(turn) @ kv.rotation_y(0.3)
        edit.add_frame("thing", "world", pose, body(geometry))
    scene = Scene(model)
    scene.update({"height": 1.0, "turn": 0.4})
    distance = scene.expression("table", "thing")
    touch = 1.0 - scene.distance("table", "thing").distance
    f = kv.compile([distance.expression, distance.expression.jacobian([height, turn])])
    turning = None
    for above in (0.5, 0.1, 1e-3, 1e-6, 1e-9, 0.0, -1e-9, -1e-6, -1e-3, -0.05):
        scene.update({"height": touch + above, "turn": 0.4})
        value, slope = f({height: touch + above, turn: 0.4, **scene.expression_values(distance)})
        assert value == pytest.approx(above, abs=2e-6)
        assert slope[0] == pytest.approx(1, abs=1e-4)
        turning = slope[1] if turning is None else turning
        assert slope[1] == pytest.approx(turning, abs=2e-3)


def between(low, value, high, tolerance):
    """Return whether values are between one-sided slopes, in either order."""
    low, high = np.minimum(low, high), np.maximum(low, high)
    return ((low - tolerance <= value) & (value <= high + tolerance)).all()


@pytest.mark.sampled(2)
@pytest.mark.compiler
@pytest.mark.parametrize("fixed", ["rod", "other"])
@pytest.mark.parametrize("geometry", [Sphere(0.03), Box((0.05, 0.06, 0.04)), Capsule(0.03, 0.08), Cylinder(0.03, 0.06),
                                      Cone(0.03, 0.06), Ellipsoid((0.02, 0.03, 0.04))])  # fmt: skip
def test_gradient_in_a_plane_is_between_the_one_sided_slopes_whichever_body_is_fixed(geometry, fixed):
    """In a plane the faces of a box are seen edge on, and the nearest ones share planes."""
    assert collision_library.prepare(wait=True)
    model, symbols = kv.Model(), [kv.position(name) for name in ("x", "z", "turn")]
    x, z, turn = symbols
    moving = kv.translation(x, 0, z) @ kv.rotation_y(turn)
    rod, other = body(Box((0.06, 0.06, 0.3))), body(geometry)
    with model.edit() as edit:
        edit.add_frame("rod", "world", np.eye(4) if fixed == "rod" else moving, rod)
        edit.add_frame("other", "world", np.eye(4) if fixed == "other" else moving, other)
    scene, rng, step, inside = Scene(model), np.random.default_rng(2), 1e-6, 0
    scene.update(dict.fromkeys(symbols, 0.0))
    distance = scene.expression("rod", "other")
    f = kv.compile([distance.expression, distance.expression.jacobian(symbols)])
    for _ in range(60):
        state = dict(zip(symbols, rng.uniform([-0.08, -0.2, -np.pi], [0.08, 0.2, np.pi]), strict=True))
        scene.update(state)
        found = scene.distance("rod", "other")
        value, slope = f({**state, **scene.expression_values(distance)})
        assert value == pytest.approx(found.distance, abs=1e-9)
        one_sided = []
        for sign in (step, -step):
            ends = []
            for symbol in symbols:
                scene.update({**state, symbol: state[symbol] + sign})
                ends.append((scene.distance("rod", "other").distance - found.distance) / sign)
            one_sided.append(np.array(ends))
        inside += found.distance < 0.0
        assert between(one_sided[0], slope, one_sided[1], 5e-3)
    assert inside > 10


def test_distance_expression_as_constraint_survives_a_document(tmp_path):
    model = arm_among_boxes(boxes=2)
    scene, state = Scene(model), random_state(model, np.random.default_rng(3))
    scene.update(state)
    distance = scene.expression("hand", "box0")
    with model.edit() as edit:
        edit.constrain("clear", 0.05, distance.expression, np.inf)
    model.save(tmp_path / "m.kv.json")
    again = kv.load(tmp_path / "m.kv.json")
    constraint = again.constraints["clear"]
    values = state | kv.State(scene.expression_values(distance))
    assert constraint.expression(values) == pytest.approx(scene.distance("hand", "box0").distance, abs=1e-9)
    # Without other values the parameters have those of where it was made.
    assert constraint.expression(state) == pytest.approx(float(constraint.expression(values)))
    assert "clear" in again.constraints_for(again.fk("hand"))
    assert again.velocity_rows(0.1, distance.expression) is not None


def test_distance_expression_reuses_its_symbols():
    model = arm_among_boxes(boxes=2)
    scene, rng = Scene(model), np.random.default_rng(3)
    scene.update(random_state(model, rng))
    one = scene.expression("hand", "box0")
    scene.update(random_state(model, rng))
    assert scene.expression("hand", "box0").parameters == one.parameters
    assert set(scene.expression_values([one])) == {s for row in one.parameters for s in row}
    assert not any(key.path.startswith("distance/") for key in one.expression.gradient())


def test_distance_expressions_of_different_pairs_have_different_symbols():
    """The word that stands between two names may be a part of them too."""
    model, slide = kv.Model(), kv.position("slide")
    names = (
        "a",
        "b",
        "c",
        "a/to/b",
        "b/to/c",
        "to",
        "to_",
        "to/to",
        "to_/to",
        "a/to",
        "to/b",
        "a/to_",
        "auto",
    )
    with model.edit() as edit:
        for k, name in enumerate(names):
            edit.add_frame(name, "world", kv.translation(k * slide, 0, 0), body(Sphere(0.1)))
    scene = Scene(model)
    scene.update({"slide": 1.0})
    pairs = [(a, b) for a in names for b in names if a != b]
    paths = {symbol.path for pair in pairs for row in scene.expression(*pair).parameters for symbol in row}
    assert len(paths) == 9 * len(pairs)
    assert "distance/a/to/b/point_a/x" in paths  # as in documents that there are


def test_distance_expression_reuses_parameters_of_the_model(tmp_path):
    """A program that reads its own document again speaks of the same distance, at whatever state it begins."""
    model = kv.load("kitchen")
    pair = "kitchen/fridge_door_handle", "kitchen/sink_area"
    scene = Scene(model)
    scene.update(model.default_state())
    with model.edit() as edit:
        edit.constrain("clear", 0.02, scene.expression(*pair).expression, float("inf"))
    model.save(tmp_path / "kitchen.kv.json")
    for again in (model, kv.load(tmp_path / "kitchen.kv.json")):
        other = Scene(again)
        state = again.default_state().updated({"kitchen/fridge_door": 0.4})
        other.update(state)
        distance = other.expression(*pair)
        kept = again.constraints["clear"].expression
        values = state | kv.State(other.expression_values(distance))
        assert (kept - distance.expression)(values) == pytest.approx(0, abs=1e-12)
        assert kept(values) == pytest.approx(other.distance(*pair).distance, abs=1e-9)
        kv.compile([kept, distance.expression])
