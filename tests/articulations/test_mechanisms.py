"""What holds for every mechanism: names, Jacobians, limits kept, documents, bodies, errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from articulation_checks import (
    ORIGIN,
    assert_is_a_value,
    assert_jacobian_at,
    assert_motion_law,
    assert_rows_keep_limits,
    model_of,
)
from mechanism_cases import EVERY, KINDS, WHERE, across, ends, refused

import kineverse as kv
from kineverse.articulations import Mechanism
from kineverse.model.body import Box, Cylinder

nan = float("nan")
each = pytest.mark.parametrize("mechanism", EVERY.values(), ids=EVERY.keys())
each_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)


@each_kind
def test_mechanism_needs_only_name_and_parent(kind: type[Mechanism]) -> None:
    model = model_of(kind(name="garage/thing", parent="world"))
    assert getattr(kv.articulations, kind.__name__) is kind
    assert kind.__name__ in kv.articulations.__all__
    assert all(name.startswith("garage/thing/") for name in model.frames)
    assert list(model.articulations) == ["garage/thing"]
    assert all(str(s).startswith("garage/thing") for s in model.symbols)
    # At rest nothing is broken, and nothing has to be put anywhere first.
    home = {**model.default_state(), **dict.fromkeys(model.speeds, 0.0)}
    assert not model.violations(home)
    assert not model.violations(home).unchecked


@each
def test_mechanism_base_is_at_its_origin(mechanism: Mechanism) -> None:
    model = model_of(mechanism)
    assert np.array_equal(model.fk("m/base")(), ORIGIN)
    assert [n for n, f in model.frames.items() if f.parent == "world"] == ["m/base"]
    parts = mechanism.parts()
    assert set(model.frames) == {f"m/{part}" for part in parts}
    assert next(iter(parts)) == "base"
    assert model.articulations["m"].child == f"m/{mechanism.main}"


@each
@pytest.mark.sampled(2)
def test_mechanism_jacobians_equal_finite_differences_over_the_whole_range(mechanism: Mechanism) -> None:
    model = model_of(mechanism)
    for at in across(mechanism):
        if mechanism is EVERY["published garage door"] and at[kv.position("m/door")] > 2.0:
            continue  # Towards 2.2 its slope is infinite, see the tests of the garage door.
        for frame in model.frames:
            if model.speeds_of(frame):
                assert_jacobian_at(model, frame, at)


@each
@pytest.mark.parametrize("seed", range(2))
def test_mechanism_tangent_equals_motion_along_rates(mechanism: Mechanism, seed: int) -> None:
    model, rng = model_of(mechanism), np.random.default_rng(seed)
    inside = {}
    for q in model.degrees_of_freedom:
        lower, upper = np.clip(ends(mechanism, q), -7.0, 7.0)
        inside[q] = float(rng.uniform(lower + 0.3 * (upper - lower), upper - 0.3 * (upper - lower)))
    assert_motion_law(model, [model.fk(mechanism.child)], seed, inside)


@each
def test_mechanism_limits_are_constraints(mechanism: Mechanism) -> None:
    model = model_of(mechanism)
    still = dict.fromkeys(model.speeds, 0.0)
    home = {**model.default_state(), **still}
    for q in model.degrees_of_freedom:
        lower, upper = ends(mechanism, q)
        width = upper - lower
        for end, sign in ((lower, -1), (upper, 1)):
            if np.isfinite(end):
                assert f"{q}/position" in [
                    v.name for v in model.violations({**home, q: end + sign * 0.01 * width})
                ]
                inside = model.violations({**home, q: end - sign * 0.01 * width})
                assert f"{q}/position" not in [v.name for v in inside]
        slowest, fastest = model.limits(q.derivative(), home)
        if np.isfinite(fastest):
            assert [v.excess for v in model.violations({**home, q.derivative(): fastest + 1})] == [1.0]
            assert not model.violations({**home, q.derivative(): slowest}) or mechanism.locks()


@pytest.mark.sampled(2)
@each
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_velocity_rows_keep_all_limits_of_mechanisms(mechanism: Mechanism, direction: float) -> None:
    model = model_of(mechanism)
    wish = {str(s): direction for s in model.speeds}
    end = assert_rows_keep_limits(model, model.default_state(), wish, 60, 0.05)
    for q in model.degrees_of_freedom:
        slack = 1e-9
        lower, upper = ends(mechanism, q)
        assert lower - slack <= end[q] <= upper + slack


@each
def test_mechanism_is_hashable_and_survives_a_document(mechanism: Mechanism, tmp_path: Path) -> None:
    model = model_of(mechanism)
    assert_is_a_value(mechanism, model, tmp_path)
    read = kv.load(tmp_path / "model.kv.json", prefix="new")
    for at in across(mechanism, 3):
        there = kv.State({f"new/{s}": v for s, v in at.items()})
        for frame in model.frames:
            ours, theirs = model.fk(frame)(kv.State(at)), read.fk(f"new/{frame}")(there)
            assert np.array_equal(ours, theirs, equal_nan=True)
    there = {f"new/{s}": v for s, v in {**model.default_state(), **dict.fromkeys(model.speeds, 0.5)}.items()}
    broken = model.violations({k.removeprefix("new/"): v for k, v in there.items()})
    assert [(f"new/{v.name}", *v[1:]) for v in broken] == [tuple(v) for v in read.violations(there)]
    assert set(read.bodies) == {f"new/{name}" for name in model.bodies}


@each
def test_mechanism_has_visual_and_collision_shapes(mechanism: Mechanism) -> None:
    model = model_of(mechanism)
    assert mechanism.child in model.bodies
    assert "m/base" in model.bodies
    for body in model.bodies.values():
        assert len(body.visuals) == len(body.collisions) > 0
        for seen, touched in zip(body.visuals, body.collisions, strict=True):
            assert (seen.geometry, seen.origin) == (touched.geometry, touched.origin)
            assert seen.color is not None
            assert touched.color is None
            numbers = seen.geometry.size if isinstance(seen.geometry, Box) else None
            if isinstance(seen.geometry, Cylinder):
                numbers = (seen.geometry.radius, seen.geometry.length)
            assert numbers is not None
            assert min(numbers) > 0


@each_kind
def test_mechanism_refuses_taken_names(kind: type[Mechanism]) -> None:
    words = refused(kind, {"name": "old"})
    assert words.startswith("DuplicateNameError: There is an articulation 'old' already, so the ")
    model = model_of(kv.Fixed(name="f", parent="world", child="m/base"))
    with (
        pytest.raises(kv.errors.DuplicateNameError, match="There is a frame 'm/base' already"),
        model.edit() as edit,
    ):
        edit.apply(kind(**WHERE))
    assert "UnknownNameError" in refused(kind, {"parent": "nowhere"})


@each_kind
def test_every_numeric_field_is_checked(kind: type[Mechanism]) -> None:
    """No length, speed or threshold may be NaN, zero or a word; the error names the mechanism and the number."""
    made, lengths = kind(**WHERE), 0
    for field, value in vars(made).items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            continue
        for wrong in (nan, "wide", None, float("inf")):
            if (kind, field, wrong) == (kv.articulations.ScrewAndNut, "velocity", None):
                continue
            if (kind, field, wrong) == (kv.articulations.ScrewAndNut, "velocity", float("inf")):
                continue
            words = refused(kind, {field: wrong})
            assert "InvalidValueError" in words
            assert "'m'" in words
            assert repr(wrong) in words
        for wrong in (0, -1.5):
            if field not in ("velocity", "rest", "pitch", "tipping"):
                words = refused(kind, {field: wrong})
                assert "InvalidValueError" in words
                assert "'m'" in words
                assert f"{wrong}" in words
        lengths += 1
    assert lengths or kind is kv.articulations.DeskLamp


@each_kind
def test_every_limits_field_is_checked(kind: type[Mechanism]) -> None:
    made: Any = kind(**WHERE)
    for field, value in vars(made).items():
        if not isinstance(value, kv.Limits):
            continue
        for wrong in (kv.Limits(2, 1), kv.Limits(0, nan), kv.Limits(0, 0.1, -1), (0, 1), None):
            words = refused(kind, {field: wrong})
            assert "InvalidValueError" in words, (field, wrong)
            assert "'m" in words
