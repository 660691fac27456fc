"""Prepared queries return what the scene's own queries do, for the selected pairs only."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scene_models import arm_among_boxes, body, brute_force, by_names, random_state

import kineverse as kv
from kineverse.geometry import Rule, Scene, bindings, collision_world, distance_queries
from kineverse.model.body import Body, Box, Mesh, Pose, Shape, Sphere


@pytest.fixture(scope="module")
def model():
    return arm_among_boxes()


@pytest.fixture(params=["numpy", pytest.param("c", marks=pytest.mark.compiler)])
def either_search(request, monkeypatch):
    library = bindings.CollisionLibrary()
    if request.param == "c":
        assert library.prepare(wait=True)
    else:
        library.prepare = lambda wait=False: False
    for module in (collision_world, distance_queries):
        monkeypatch.setattr(module, "collision_library", library)


def among(pairs):
    return lambda a, b: (a, b) in pairs or (b, a) in pairs


def test_watch_matches_brute_force_at_each_state(model, either_search):
    scene = Scene(model)
    watches = {
        scene.watch("link*", "box*", 0.3): lambda a, b: {a[:3], b[:3]} == {"lin", "box"},
        scene.watch(["hand", "ball/*"], radius=0.3): lambda a, b: {a, b} & {"hand", "ball/body"},
        scene.watch(moving="j2", radius=0.3): among(scene.pairs_affected_by("j2")),
        scene.watch(moving=[model.symbol("rail")], radius=0.3): among(scene.pairs_affected_by("rail")),
        scene.watch("box*", "box*", 0.3): lambda a, b: a[:3] == b[:3] == "box",
        scene.watch(radius=0.3): lambda a, b: True,
        scene.watch(radius=0.3, moving=()): lambda a, b: False,
        scene.watch("hand", radius=0.3, rules=[Rule("hand", "box[1-5]")]): (
            lambda a, b: "hand" in (a, b) and not {a, b} & {f"box{k}" for k in range(1, 6)}
        ),
    }
    rng = np.random.default_rng(3)
    for _ in range(2):
        state = random_state(model, rng)
        scene.update(state)
        everything = brute_force(scene, state)
        for watch, chosen in watches.items():
            near = {names: d for names, d in everything.items() if d <= 0.3}
            want = {
                frozenset(names): pytest.approx(d, abs=1e-6) for names, d in near.items() if chosen(*names)
            }
            assert by_names(watch()) == want


def test_arrays_of_indices_name_bodies_and_shapes(model):
    scene = Scene(model)
    scene.update(random_state(model, np.random.default_rng(0)))
    found = scene.watch(radius=0.5)()
    assert len(found) > 5
    assert found.body_indices.shape == found.shape_indices.shape == (len(found), 2)
    for pair, bodies, shapes in zip(found, found.body_indices, found.shape_indices, strict=True):
        assert (pair.a, pair.b) == tuple(scene.bodies[k] for k in bodies)
        assert (pair.shape_a, pair.shape_b) == tuple(shapes)
    watch = scene.watch("link*", "box1")
    assert {tuple(scene.bodies[k] for k in pair) for pair in watch.pairs} == {
        (f"link{k}", "box1") for k in range(5)
    }
    assert watch.pairs.dtype == np.int32
    assert repr(watch) == "<PreparedQuery: 5 pairs of bodies, within 0.1 m>"


def test_per_shape_returns_every_pair_of_shapes(either_search):
    model = kv.Model()
    with model.edit() as edit:
        bar = body(Box((0.1, 0.1, 1.0)))
        places = (Pose.from_matrix(np.array(kv.translation(0, 0, z)())) for z in (-0.3, 0.0, 0.3))
        handle = Body(collisions=tuple(Shape(Sphere(0.05), place) for place in places))
        edit.add_frame("bar", "world", kv.translation(kv.position("x"), 0, 0), bar)
        edit.add_frame("handle", "world", kv.translation(0.2, 0, 0), handle)
    scene = Scene(model)
    scene.update({"x": 0.02})
    one, each = scene.watch(radius=0.2), scene.watch(radius=0.2, per_shape=True)
    assert len(one()) == 1
    assert sorted(each().shape_indices[:, 1].tolist()) == [0, 1, 2]
    np.testing.assert_allclose(each().distances, 0.08, atol=1e-8)
    np.testing.assert_allclose(sorted(each().points_b[:, 2]), [-0.3, 0.0, 0.3], atol=1e-8)
    assert "each pair of shapes" in repr(each)


@pytest.mark.compiler
@pytest.mark.parametrize("rows", [130, pytest.param(90, id="interpreter"), pytest.param(5, id="numpy")])
def test_motions_match_a_query_at_each_configuration(rows, monkeypatch, tmp_path):
    if rows < 100:
        monkeypatch.setattr(collision_world.CollisionWorld, "kinematics_address", None)
    if rows < 10:
        monkeypatch.setattr(distance_queries, "collision_library", bindings.CollisionLibrary())
    roof = tmp_path / "roof.obj"
    roof.write_text("v -1 -1 0.9\nv 1 -1 0.9\nv 1 1 0.9\nv -1 1 0.9\nf 1 2 3\nf 1 3 4\n")
    model = arm_among_boxes()
    with model.edit() as edit:
        edit.add_frame("roof", "world", kv.translation(0, 0, kv.position("height")), body(Mesh(str(roof))))
    scene = Scene(model, triangles="roof")
    assert rows < 100 or scene.collision_world._function.wait()
    coordinates = [model.symbol(name) for name in ("j0", "rail", "j3")]
    queries = [scene.watch(moving=coordinates), scene.watch("hand"), scene.watch("base", "box*")]
    queries.append(scene.watch("link4", "roof"))
    columns = [scene.inputs.index(symbol) for symbol in coordinates]
    rng, found = np.random.default_rng(0), set()
    for number in range(12):
        values = random_state(model, rng).vector(scene.inputs)
        state = values.copy()
        knots = rng.uniform(-1.0, 1.0, (3, 3)) * (0.3, 1.0)[number % 2]
        Q = np.concatenate([np.linspace(a, b, rows) for a, b in pairwise(knots)])
        query, radius = queries[number % 4], (0.0, 0.05, 0.2)[number % 3]
        distances = []
        for q in Q:
            values[columns] = q
            scene.update(values)
            near = query(radius)
            distances.append(near.distances[0] if len(near) else np.inf)
        scene.update(state)
        least = query.least_distance(coordinates, Q, radius)
        assert least == pytest.approx(min(distances), rel=0.0, abs=1e-9 if rows < 10 else 0.0)
        before, first = query(1.0).distances, query.first_within(coordinates, Q, radius)
        assert first == next((k for k, d in enumerate(distances) if d <= radius), None)
        if first is None:
            assert np.array_equal(query(1.0).distances, before)
        else:
            assert query(radius).distances[0] == distances[first]
        found.add("first" if first == 0 else "later" if first else "none")
    assert found == {"first", "later", "none"}
    with pytest.raises(kv.errors.InvalidValueError, match="not finite"):
        queries[0].first_within(coordinates, np.full((1, 3), np.nan), -0.0)
    for question in (queries[0].first_within, queries[0].least_distance):
        with pytest.raises(kv.errors.ShapeError, match=r"\(N, 3\)"):
            question(coordinates, np.zeros(3))
        with pytest.raises(kv.errors.InvalidValueError, match="radius"):
            question(coordinates, np.zeros((0, 3)), -1.0)


def test_query_at_values_is_an_update_and_a_query(model, either_search):
    together, apart = Scene(model), Scene(model)
    facing = [bindings.FacingPoints(np.full((len(s.bodies),) * 2, 0.02), 0.02) for s in (together, apart)]
    watches = [scene.watch(radius=0.3, per_shape=True) for scene in (together, apart)]
    together.collision_world._function.wait()
    rng, counts = np.random.default_rng(5), set()
    for points in (False, True, False):
        values = random_state(model, rng).vector(together.inputs)
        apart.update(values)
        want = watches[1](0.3, facing[1] if points else None)
        found = watches[0].at(values, 0.3, facing[0] if points else None)
        counts.add(len(found))
        np.testing.assert_array_equal(found.body_indices, want.body_indices)
        np.testing.assert_array_equal(found.shape_indices, want.shape_indices)
        np.testing.assert_allclose(found.witnesses, want.witnesses, atol=1e-9)
        np.testing.assert_array_equal(together.collision_world.values, values)
        np.testing.assert_array_equal(together.pose("hand"), apart.pose("hand"))
    assert max(counts) > 5
    with pytest.raises(kv.errors.InvalidValueError, match="not finite"):
        watches[0].at(np.full(len(values), np.nan))
    np.testing.assert_array_equal(together.pose("hand"), apart.pose("hand"))
    with pytest.raises(kv.errors.ShapeError):
        watches[0].at(values[:-1])
    apart.update(values)
    found = watches[0].at(values.tolist())  # slower
    np.testing.assert_array_equal(found.body_indices, watches[1]().body_indices)


@pytest.mark.compiler
@pytest.mark.parametrize("shapes", [1, 5])
def test_neighbours_are_found_by_boxes_of_bodies_or_by_a_sweep(shapes):
    """Bodies of several shapes have boxes of their own; what is near is the same from scratch."""
    rng, model = np.random.default_rng(2), kv.Model()
    rail = kv.position("rail")
    with model.edit() as edit:
        edit.add_frame("carriage", "world", kv.translation(rail, 0, 0))
        for k in range(24):
            parts = [
                Shape(
                    Box(tuple(rng.uniform(0.02, 0.2, 3).tolist())),
                    Pose.from_matrix(np.vstack([np.c_[np.eye(3), rng.uniform(-0.2, 0.2, 3)], [0, 0, 0, 1]])),
                )
                for _ in range(shapes)
            ]
            at = kv.translation(*rng.uniform(-1, 1, 3)) @ kv.rpy(*rng.uniform(-3, 3, 3))
            edit.add_frame(
                f"body{k}", "carriage" if k % 3 else "world", at, body=Body(collisions=tuple(parts))
            )
    watch, counts = Scene(model).watch(radius=0.4, moving=[rail]), set()
    for value in np.cumsum(rng.normal(0.0, 0.2, 40)):
        found, fresh = watch.at(np.array([value])), Scene(model)
        fresh.update({rail: value})
        want = fresh.watch(radius=0.4, moving=[rail])()
        np.testing.assert_array_equal(found.body_indices, want.body_indices)
        np.testing.assert_allclose(found.distances, want.distances, atol=1e-9)
        counts.add(len(found))
    assert len(counts) > 3
    assert (watch._selection.binding._struct.boxes is not None) == (shapes > 1)


@pytest.mark.compiler
def test_queries_at_values_reset_a_travel_that_is_too_long(model):
    scene = Scene(model)
    watch = scene.watch(radius=0.1)
    scene.collision_world._function.wait()
    state = random_state(model, np.random.default_rng(0))
    for rail in (0.0, 2e4, 0.0):
        watch.at(state.updated({"rail": rail}).vector(scene.inputs))
    table = scene.collision_world.table
    assert table.resets > 0
    assert table.travel.max() < 2.1e4


@pytest.mark.compiler
def test_query_at_values_makes_room_for_its_results(model):
    scene = Scene(model)
    watch = scene.watch(radius=10.0, per_shape=True)
    scene.collision_world._function.wait()
    watch.prepare()
    watch.at(random_state(model, np.random.default_rng(0)).vector(scene.inputs))
    scene.collision_world.table.binding.reserve(3)
    values = random_state(model, np.random.default_rng(1)).vector(scene.inputs)
    assert len(watch.at(values)) == len(watch()) > 3


@pytest.mark.compiler
@pytest.mark.parametrize("step", [0.0005, 0.004, 0.3])
def test_watch_matches_a_query_from_scratch_along_a_random_motion(model, step, monkeypatch):
    """The list of neighbours misses no pair: as they move on or rest, at other radii, after resets."""
    library, rng = bindings.CollisionLibrary(), np.random.default_rng(1)
    assert library.prepare(wait=True)
    for module in (collision_world, distance_queries):
        monkeypatch.setattr(module, "collision_library", library)
    searches, scene = [], Scene(model)
    watches = [scene.watch("link*", radius=0.1), scene.watch(radius=0.1, moving="j2", per_shape=True)]
    fresh = Scene(model)
    anew = [fresh.watch("link*", radius=0.1), fresh.watch(radius=0.1, moving="j2", per_shape=True)]
    state = random_state(model, rng)
    drift = rng.normal(size=len(state))
    for k in range(60):
        if k % 10 < 8:
            change = step * (drift + rng.normal(size=len(state)))
            state = state.updated(
                {s: v + d for (s, v), d in zip(state.items(), change.tolist(), strict=True)}
            )
        for one in (scene, fresh):
            one.update(state)
        if k == 30:
            scene.collision_world.table.reset_travel()
        fresh.collision_world.table.reset_travel()  # forgets neighbours and bounds
        for watch, other in zip(watches, anew, strict=True):
            radius = 0.15 if k == 40 else 0.05 if k == 41 else None
            found, want = watch(radius), other(radius)
            searches.append(len(want))
            np.testing.assert_array_equal(found.body_indices, want.body_indices)
            np.testing.assert_array_equal(found.shape_indices, want.shape_indices)
            np.testing.assert_allclose(found.distances, want.distances, atol=1e-9)
    assert max(searches) > 5
    assert len(set(searches)) > 1 or step < 0.001


def test_the_nearest_pairs_of_shapes_are_those_of_the_bodies(model):
    scene = Scene(model)
    one, each = scene.watch(radius=0.4), scene.watch(radius=0.4, per_shape=True)
    rng = np.random.default_rng(5)
    for _ in range(20):
        scene.update(random_state(model, rng))
        nearest: dict[tuple[int, int], float] = {}
        for pair, distance in zip(each().body_indices.tolist(), each().distances, strict=True):
            nearest.setdefault(tuple(pair), distance)
        found = one()
        assert len(each()) >= len(found) == len(nearest)
        assert nearest == {
            tuple(p): d for p, d in zip(found.body_indices.tolist(), found.distances, strict=True)
        }


def test_watch_needs_the_files_of_its_own_bodies_only():
    model = arm_among_boxes()
    with model.edit() as edit:
        edit.add_frame("statue", "world", np.eye(4), body(Mesh("/nowhere/statue.stl")))
    scene = Scene(model)
    scene.update(model.default_state())
    assert len(scene.watch("hand", "box*", 5.0)()) == 8
    with pytest.raises(kv.errors.KineverseError, match="statue"):
        scene.watch("hand", radius=5.0)()


def test_watch_follows_the_model():
    model = arm_among_boxes()
    scene = Scene(model)
    scene.update(random_state(model, np.random.default_rng(0)))
    watch = scene.watch("hand", "box*", 5.0)
    assert len(watch()) == len(watch.pairs) == 8
    with model.edit() as edit:
        edit.add_frame("box/new", "world", np.eye(4), body(Box((0.1, 0.1, 0.1))), tag="new")
    assert len(watch.pairs) == 9
    beside_boxes = [pair for pair in scene.distances_to("hand") if pair.b.startswith("box")]
    assert by_names(watch()) == by_names(beside_boxes)
    with model.edit() as edit:
        edit.remove("new")
        edit.write(kv.geometry.RULES, kv.geometry.rules_as_data([Rule("hand", "box1")]))
    assert len(watch()) == len(watch.pairs) == 7


def test_pairs_of_a_watch_are_selected_once(model, monkeypatch):
    scene = Scene(model)
    scene.update(model.default_state())
    watch = scene.watch(moving=["rail"], radius=0.2)
    watch()
    monkeypatch.setattr(kv.geometry.scene, "flag_relatively_moving", None)
    assert by_names(watch(0.1)) == {k: d for k, d in by_names(watch()).items() if d <= 0.1}


def test_watch_names_what_does_not_exist(model):
    scene = Scene(model)
    with pytest.raises(kv.errors.UnknownNameError, match=r"'lnik\*'"):
        scene.watch("lnik*")
    with pytest.raises(kv.errors.UnknownNameError, match="Did you mean 'hand'"):
        scene.watch("hnad")
    with pytest.raises(kv.errors.UnknownNameError, match="raill"):
        scene.watch(moving="raill")
    with pytest.raises(kv.errors.UnknownNameError, match="A rule is about 'bxo1'"):
        scene.watch(rules=[Rule("bxo1")])
    with pytest.raises(kv.errors.InvalidValueError, match="radius"):
        scene.watch(radius=-1.0)
