"""The difference between models: what a commit would report that leads from one to the other."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import kineverse as kv
from kineverse.model.body import Mesh
from kineverse.model.changes import find_moved_tags
from kineverse.model.comparison import measure_deltas
from kineverse.model.sampling import StateSamples


def arm(length=0.4, upper=1.0, mass=1.0):
    """Return a link that turns, and a tool on it."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="elbow", parent="world", child="arm", lower=-1, upper=upper, velocity=2))
        body = kv.model.Body(inertia=kv.model.Inertia(mass, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)))
        edit.add_frame("tool", parent="arm", transform=kv.translation(length, 0, 0), body=body)
    return model


def details(before, after):
    found = kv.model.compare_models(before, after)
    parts = measure_deltas(found.changes, StateSamples(before, after))
    return {change.path: list(own) for change, own in zip(found.changes, parts, strict=True)}


def test_a_model_differs_from_itself_in_nothing():
    model = kv.load("kitchen")
    for other in (model, model.copy(), model.snapshot(), kv.load("kitchen")):
        assert kv.model.compare_models(model, other).is_empty


def test_a_document_is_its_model(tmp_path):
    model = arm()
    model.save(tmp_path / "arm.kv.json")
    assert kv.model.compare_models(model, kv.load(tmp_path / "arm.kv.json")).is_empty


def test_compare_models_equals_the_diff_of_a_commit():
    model = arm()
    before, heard = model.snapshot(), []
    model.listen(heard.append)
    with model.edit() as edit:
        edit.replace(
            "joint elbow",
            kv.Prismatic(name="elbow", parent="world", child="arm", lower=0, upper=1, velocity=1),
        )
        edit.remove("frame tool")
        edit.constrain("slow", -1, kv.velocity("elbow"), 1)
    found = kv.model.compare_models(before, model)
    assert found.paths == heard[0].paths
    assert (found.added, found.removed, found.replaced) == (
        heard[0].added,
        heard[0].removed,
        heard[0].replaced,
    )
    assert found.tags == {"joint elbow", "frame tool", "constraint slow"}


def test_back_is_the_other_way_round():
    one, other = arm(), arm(length=0.5)
    there, back = kv.model.compare_models(one, other), kv.model.compare_models(other, one)
    assert {(c.path, c.before, c.after) for c in there.changes} == {
        (c.path, c.after, c.before) for c in back.changes
    }


@given(st.permutations(range(8)))
def test_as_few_operations_as_possible_have_moved(order):
    moved = find_moved_tags(range(8), order)
    rest = [item for item in order if item not in moved]
    assert rest == sorted(rest)
    longest = [1] * 8
    for i in range(8):
        longest[i] += max((longest[k] for k in range(i) if order[k] < order[i]), default=0)
    assert len(moved) == 8 - max(longest)


def test_operations_in_another_order():
    one, other = kv.Model(), kv.Model()
    for model, names in ((one, "abc"), (other, "cab")):
        with model.edit() as edit:
            for name in names:
                edit.constrain(name, 0, kv.position(name), 1)
    assert kv.model.compare_models(one, other).moved == ("constraint c",)
    assert not kv.model.compare_models(one, other).is_empty


def test_parts_of_values_with_their_distance():
    found = details(arm(), arm(length=0.41, upper=1.5, mass=1.2))
    assert {path: [d.what for d in own] for path, own in found.items()} == {
        "frames/tool": ["transform"],
        "bodies/tool": ["inertia.mass"],
        "constraints/elbow/position": ["upper"],
    }
    assert found["frames/tool"][0].distance == pytest.approx(0.01)
    assert found["frames/tool"][0].angle == 0
    assert found["bodies/tool"][0].distance == pytest.approx(0.2 / 1.2), "relative above one"
    assert found["constraints/elbow/position"][0].is_within(0.34)
    assert not found["constraints/elbow/position"][0].is_within(0.3)


def test_a_motion_may_differ_away_from_the_default_state_only():
    one, other = kv.Model(), kv.Model()
    for model, axis in ((one, (0, 0, 1)), (other, (0, 1, 0))):
        with model.edit() as edit:
            edit.apply(
                kv.Revolute(name="q", parent="world", child="a", axis=axis, lower=-1, upper=1, velocity=1)
            )
    (delta,) = details(one, other)["frames/a"]
    assert delta.at_default == (0.0, 0.0)
    states = StateSamples(one, other).values_of(kv.position("q"))
    a_R_b = [kv.rotation_z(q)()[:3, :3].T @ kv.rotation_y(q)()[:3, :3] for q in states]
    expected = max(np.arccos((np.trace(R) - 1) / 2) for R in a_R_b)
    assert delta.angle == pytest.approx(expected)


def test_another_notation_has_distance_zero():
    q = kv.position("q")
    one, other = kv.Model(), kv.Model()
    for model, expression in ((one, np.sin(q) ** 2), (other, 1 - np.cos(q) ** 2)):
        with model.edit() as edit:
            edit.constrain("c", -1, expression, 1)
    (delta,) = details(one, other)["constraints/c"]
    assert delta.is_within(1e-12)
    assert not delta.is_within(0)


def test_gradients_count_as_well_as_values():
    q = kv.position("q")
    one, other = kv.Model(), kv.Model()
    for model, slope in ((one, 1.0), (other, 4.0)):
        with model.edit() as edit:
            edit.constrain("c", -1, (2 * q).augment({q.derivative(): slope}), 1)
    (delta,) = details(one, other)["constraints/c"]
    assert delta.distance == pytest.approx(3 / 4)


@pytest.mark.parametrize(
    ("mesh", "parts"),
    [
        (Mesh("a.stl", folder="/there"), []),
        (Mesh("../here/a.stl", folder="/there"), []),
        (Mesh("../a.stl", folder="/there"), ["visuals[0].geometry.uri"]),
        (Mesh("a.stl", (2.0, 2.0, 2.0), "/here"), ["visuals[0].geometry.scale"]),
    ],
)
def test_the_folder_of_a_mesh_is_no_difference(mesh, parts):
    models = kv.Model(), kv.Model()
    for model, geometry in zip(models, (Mesh("a.stl", folder="/here"), mesh), strict=True):
        with model.edit() as edit:
            body = kv.model.Body(visuals=(kv.model.Shape(geometry),))
            edit.add_frame("a", parent="world", transform=np.eye(4), body=body)
    assert [delta.what for delta in details(*models)["bodies/a"]] == parts


def test_samples_are_the_same_for_all_models_and_within_limits():
    kitchen, door = kv.load("kitchen"), kv.position("kitchen/fridge_door")
    values = StateSamples(kitchen).values_of(door)
    np.testing.assert_array_equal(values, StateSamples(kitchen, arm()).values_of(door))
    assert values[0] == kitchen.default_state()[door]
    low, high = kitchen.limits(door)
    assert ((low <= values) & (values <= high)).all()
    assert np.ptp(values) > 0.5 * (high - low)
    (numbers,) = StateSamples(kitchen).values([2 * door])
    np.testing.assert_allclose(numbers, 2 * values)
