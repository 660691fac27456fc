"""The garage door of the papers (2022, Eqs. 11-13), in both of its coordinates."""

from __future__ import annotations

import math

import numpy as np
import pytest
from articulation_checks import Matrix, assert_rows_keep_limits, model_of
from mechanism_cases import WHERE, about_y, at, pose, refused

import kineverse as kv

nan = float("nan")
REGULAR = kv.articulations.GarageDoor(name="m", parent="world")
PUBLISHED = kv.articulations.GarageDoor(name="m", parent="world", form="published")
BOTH = pytest.mark.parametrize("door", [REGULAR, PUBLISHED], ids=["regular", "published"])


def printed(a: float, length: float) -> Matrix:
    """Return Eq. 12 for a length other than 2, with the height that is 0 at the floor when closed."""
    c, s = a / length, math.sqrt(1 - (a / length) ** 2)
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, length - a], [0, 0, 0, 1]])


@pytest.mark.parametrize("length", [2.0, 2.4])
def test_regular_and_published_form_have_equal_poses(length: float) -> None:
    regular = kv.articulations.GarageDoor(**WHERE, length=length)
    published = kv.articulations.GarageDoor(**WHERE, length=length, form="published")
    for angle in np.linspace(0, math.pi / 2, 20):
        a = length * math.cos(angle)
        expected = printed(a, length)
        np.testing.assert_allclose(pose(published, "door", {"m/door": a}), expected, atol=1e-12)
        found = pose(regular, "door", {"m/door": angle})
        np.testing.assert_allclose(found, expected, atol=1e-8)
        np.testing.assert_allclose(found, at(z=length * (1 - math.cos(angle))) @ about_y(angle), atol=1e-14)


def test_door_edges_move_along_the_rails() -> None:
    """Closed it stands, open it lies under the ceiling: a = 2 has A at z 0 and B at 2, a = 0 has B at (2, 0, 2)."""
    for door, closed, opened in ((REGULAR, 0.0, math.pi / 2), (PUBLISHED, 2.0, 0.0)):
        for q, lower, upper in ((closed, (0, 0, 0), (0, 0, 2)), (opened, (0, 0, 2), (2, 0, 2))):
            for part, where in (("door", lower), ("upper_edge", upper)):
                np.testing.assert_allclose(pose(door, part, {"m/door": q})[:3, 3], where, atol=1e-15)
    for angle in np.linspace(0, math.pi / 2, 7):
        assert pose(REGULAR, "door", {"m/door": angle})[0, 3] == pytest.approx(0, abs=1e-15)
        assert pose(REGULAR, "upper_edge", {"m/door": angle})[2, 3] == pytest.approx(2.0)


def test_only_the_regular_form_has_a_finite_slope_when_closed() -> None:
    regular, published = model_of(REGULAR), model_of(PUBLISHED)
    # Closed, it begins to turn and nothing else.
    found = regular.jacobian("m/door")({"m/door": 0.0}).ravel()
    np.testing.assert_allclose(found, [0, 0, 0, 0, 1, 0], atol=1e-15)
    assert not np.isfinite(published.jacobian("m/door")({"m/door": 2.0})).all()
    assert np.isfinite(published.jacobian("m/door")({"m/door": 1.999})).all()
    for angle in np.linspace(0, math.pi / 2, 11):
        assert np.isfinite(regular.jacobian("m/upper_edge")({"m/door": angle})).all()


def test_garage_door_constraints_equal_those_of_the_papers() -> None:
    a, b = kv.position("m/door"), kv.position("m/bolt")
    constraints = model_of(PUBLISHED).constraints
    assert constraints["m/door/position"] == kv.Constraint.from_expressions(0, a, 2)
    c2 = constraints["m/lock"]
    assert c2.expression is a.derivative()
    unlocked, product = ~((b < 0.3) & (a > 1.99)), 1 - (b < 0.3) * (a > 1.99)
    for where in (1.0, 1.99, 1.995, 2.0):
        for bolt in np.linspace(0, 0.6, 50):  # fig. 3, right
            values = {"m/door": where, "m/bolt": float(bolt)}
            assert c2.upper(values) == unlocked(values) == product(values) == -c2.lower(values)
    assert set(model_of(PUBLISHED).constraints_for(model_of(PUBLISHED).fk("m/door"))) == {
        "m/door/position",
        "m/lock",
    }


@BOTH
def test_lock_forces_speed_zero_and_its_gradient_shows_how_to_open(door: kv.articulations.GarageDoor) -> None:
    model = model_of(door)
    closed, opening = (2.0, -1.0) if door is PUBLISHED else (0.0, 1.0)
    rows = model.velocity_rows(0.1)
    i = rows.names.index("m/lock")
    shut = {"m/door": closed, "m/bolt": 0.0}
    assert (rows.lower(shut)[i], rows.upper(shut)[i]) == (0, 0)
    for free in ({**shut, "m/bolt": 0.4}, {**shut, "m/door": closed + 0.2 * opening}):
        assert (rows.lower(free)[i], rows.upper(free)[i]) == (-1, 1)
    gradient = model.constraints["m/lock"].upper.gradient()
    assert {str(s): float(e(shut)) for s, e in gradient.items()} == {
        "m/bolt:velocity": 1.0,
        "m/door:velocity": opening,
    }


@BOTH
def test_garage_door_opens_after_the_bolt_is_back(door: kv.articulations.GarageDoor) -> None:
    model = model_of(door)
    closed, opened, speed = (2.0, 0.0, -1.0) if door is PUBLISHED else (0.0, math.pi / 2, 1.0)
    q, b = kv.position("m/door"), kv.position("m/bolt")
    locked = assert_rows_keep_limits(model, {q: closed, b: 0.0}, {"m/door:velocity": speed}, 20, 0.1)
    assert locked[q] == closed
    end = assert_rows_keep_limits(model, {q: closed, b: 0.5}, {"m/door:velocity": speed}, 25, 0.1)
    assert end[q] == pytest.approx(opened)


@BOTH
def test_both_forms_lock_within_the_same_play(door: kv.articulations.GarageDoor) -> None:
    for a, shut in ((1.991, 1.0), (1.989, 0.0)):
        q = a if door is PUBLISHED else math.acos(a / 2)
        assert door.closed({"m/door": q}) == shut


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"form": "fast"}, "The form of the garage door 'm' is 'regular' or 'published', not 'fast'"),
        ({"length": 0}, "The length of the garage door 'm' is a positive, finite number, not 0"),
        ({"play": 2.0}, "The play of the garage door 'm' is less than its length 2, and not 2"),
        ({"catch": 0.6}, "The catch of the garage door 'm' lies between 0.0 and 0.6, and is not 0.6"),
        ({"catch": nan}, "The catch of the garage door 'm' is a finite number, not nan"),
        ({"bolt": kv.Limits(0.4, 0.6)}, "lies between 0.4 and 0.6, and is not 0.3"),
        ({"bolt": kv.Limits(1, 0)}, "The limits of 'm/bolt' are no range"),
    ],
)
def test_invalid_garage_door_is_refused(given: dict[str, object], words: str) -> None:
    assert words in refused(kv.articulations.GarageDoor, given)
