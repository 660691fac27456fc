"""Doors that a handle, a bolt or a button holds: held when shut, free when open, and saying the way out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from articulation_checks import assert_rows_keep_limits, model_of, slid, turned
from mechanism_cases import WHERE, at, pose, refused

import kineverse as kv
from kineverse.articulations import Mechanism

inf = float("inf")
HANDLE, LATCH, MICROWAVE = (
    kv.articulations.DoorWithHandle(**WHERE),
    kv.articulations.Latch(**WHERE),
    kv.articulations.Microwave(**WHERE),
)
LOCKED = [
    (HANDLE, "handle", "lock", 0.7),
    (LATCH, "bolt", "latch", 0.01),
    (MICROWAVE, "button", "latch", 0.005),
]
each = pytest.mark.parametrize(("mechanism", "key", "lock", "away"), LOCKED, ids=["handle", "bolt", "button"])


def room(model: kv.Model, values: dict[str, float]) -> tuple[float, float]:
    """Return what all rows together leave of the door's speed."""
    rows = model.velocity_rows(0.1)
    assert not rows.skipped
    column = list(map(str, rows.speeds)).index("m/door:velocity")
    low, high = -inf, inf
    for weights, lower, upper in zip(
        rows.matrix(values), rows.lower(values), rows.upper(values), strict=True
    ):
        if weights[column]:
            assert weights[column] == 1
            low, high = max(low, lower), min(high, upper)
    return float(low), float(high)


@each
def test_lock_holds_the_shut_door_and_frees_the_open_one(
    mechanism: Mechanism, key: str, lock: str, away: float
) -> None:
    model = model_of(mechanism)
    fastest = 2.0 if mechanism is MICROWAVE else 1.5
    assert room(model, {"m/door": 0.0, f"m/{key}": 0.0}) == (0, 0)
    assert room(model, {"m/door": 0.0, f"m/{key}": away}) == (0, fastest)
    assert room(model, {"m/door": 0.5, f"m/{key}": 0.0}) == (-fastest, fastest)
    # A little ajar, it may be shut whatever the key does, and not be opened.
    low, high = room(model, {"m/door": 0.002, f"m/{key}": 0.0})
    assert low < 0 >= high


@each
def test_lock_gradient_shows_what_opens_the_door(
    mechanism: Mechanism, key: str, lock: str, away: float
) -> None:
    upper = model_of(mechanism).constraints[f"m/{lock}"].upper
    shut = {"m/door": 0.0, f"m/{key}": 0.0}
    assert {str(s): float(e(shut)) for s, e in upper.gradient().items()}[f"m/{key}:velocity"] > 0
    assert upper({**shut, f"m/{key}": away}) > upper(shut) == 0
    assert all(not e(shut) for e in upper.gradient(heuristic=False).values())


@each
def test_door_opens_with_its_key_and_shuts_without(
    mechanism: Mechanism, key: str, lock: str, away: float
) -> None:
    model = model_of(mechanism)
    door, other = kv.position("m/door"), kv.position(f"m/{key}")
    wish = {"m/door:velocity": 1.0}
    start = {door: 0.0, other: 0.0}
    assert assert_rows_keep_limits(model, start, wish, 10, 0.1)[door] == pytest.approx(0, abs=1e-12)
    pressed = assert_rows_keep_limits(model, {**start, other: away}, wish, 3, 0.1)
    let_go = assert_rows_keep_limits(model, {**pressed, other: 0.0}, wish, 30, 0.1)
    assert let_go[door] == pytest.approx(1.9)
    back = assert_rows_keep_limits(model, let_go, {"m/door:velocity": -1.0}, 30, 0.1)
    assert back[door] == pytest.approx(0, abs=1e-12)
    assert assert_rows_keep_limits(model, back, wish, 10, 0.1)[door] == pytest.approx(0, abs=1e-12)


@each
def test_constraints_for_pose_include_the_lock(
    mechanism: Mechanism, key: str, lock: str, away: float
) -> None:
    model = model_of(mechanism)
    found = set(model.constraints_for(model.fk("m/door")))
    assert found - {"m/door/velocity"} == {"m/door/position", f"m/{lock}"}
    assert f"m/{lock}" in model.constraints_for([kv.position(f"m/{key}")], bounds=True)


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.9])
def test_doors_rotate_and_keys_move(angle: float) -> None:
    for mechanism in (HANDLE, LATCH, MICROWAVE):
        door = pose(mechanism, "door", {"m/door": angle})
        np.testing.assert_allclose(door, turned((0, 0, 1), angle), atol=1e-15)
    # It opens towards who stands at -x.
    assert (pose(LATCH, "door", {"m/door": 0.4}) @ [0, 0.8, 0, 1])[0] < 0
    bolt = pose(LATCH, "bolt", {"m/door": angle, "m/bolt": 0.01})
    np.testing.assert_allclose(bolt, turned((0, 0, 1), angle) @ at(0, 0.8 - 0.01, 1.0), atol=1e-15)
    rest = pose(HANDLE, "handle", {"m/door": 0.0, "m/handle": 0.0})
    pressed = pose(HANDLE, "handle", {"m/door": angle, "m/handle": 0.6})
    np.testing.assert_allclose(pressed, turned((0, 0, 1), angle) @ rest @ turned((1, 0, 0), 0.6), atol=1e-15)
    assert (pressed @ [0, -0.1, 0, 1])[2] < pressed[2, 3]  # the lever goes down
    button = [pose(MICROWAVE, "button", {"m/button": b}) for b in (0.0, 0.005)]
    np.testing.assert_allclose(button[1], button[0] @ slid((1, 0, 0), 0.005), atol=1e-15)


def test_spring_parameters_are_in_the_record() -> None:
    lever, latch, oven = (model_of(m).articulations["m"].dynamics for m in (HANDLE, LATCH, MICROWAVE))
    assert lever == (("handle/stiffness", 1.5), ("handle/rest", -0.3))
    assert latch == (("bolt/stiffness", 300.0), ("bolt/rest", -0.01))
    assert oven[:2] == (("button/stiffness", 500.0), ("button/rest", -0.004))
    door = dict(oven[2:])
    stiffness, rest, friction = (door[f"door/{key}"] for key in ("stiffness", "rest", "friction"))
    # It springs ajar, beyond the play of the latch, and stays wherever else it is left.
    assert rest - friction / stiffness == pytest.approx(0.1)
    assert rest + friction / stiffness > 1.9


BROKEN: list[tuple[type[Mechanism], dict[str, Any], str]] = [
    (kv.articulations.DoorWithHandle, {"threshold": 0.9}, "The threshold of the door with handle 'm' lies between 0.0 and 0.9, and is not 0.9"),
    (kv.articulations.DoorWithHandle, {"handle_height": 2.0}, "The handle height of the door with handle 'm' is below its height 2, and not 2"),
    (kv.articulations.DoorWithHandle, {"door": kv.Limits(0.1, 1)}, "The door of the door with handle 'm' is shut at 0, and not at 0.1"),
    (kv.articulations.DoorWithHandle, {"rest": 0.1}, "The rest of the door with handle 'm' is at 0 or before it, where the spring pushes to, and not at 0.1"),
    (kv.articulations.DoorWithHandle, {"stiffness": 0}, "The stiffness of the door with handle 'm' is a positive, finite number, not 0"),
    (kv.articulations.Latch, {"door": kv.Limits(None, 1)}, "The door of the latch 'm' is shut at 0, and not at None"),
    (kv.articulations.Latch, {"catch": 0.012}, "The catch of the latch 'm' lies between 0.0 and 0.012, and is not 0.012"),
    (kv.articulations.Latch, {"catch": -0.1}, "is not -0.1"),
    (kv.articulations.Latch, {"stiffness": 0}, "The stiffness of the latch 'm' is a positive, finite number, not 0"),
    (kv.articulations.Latch, {"rest": 0.001}, "The rest of the latch 'm' is at 0 or before it, where the spring pushes to, and not at 0.001"),
    (kv.articulations.Latch, {"play": 0}, "The play of the latch 'm' is a positive, finite number, not 0"),
    (kv.articulations.Microwave, {"catch": 0.5}, "The catch of the microwave 'm' lies between 0.0 and 0.006, and is not 0.5"),
    (kv.articulations.Microwave, {"door_rest": 1.0}, "The spring of the door of the microwave 'm' opens it beyond the play 0.003; with its rest at"),
    (kv.articulations.Microwave, {"depth": 0}, "The depth of the microwave 'm' is a positive, finite number, not 0"),
    (kv.articulations.Microwave, {"button": kv.Limits(1, 0)}, "The limits of 'm/button' are no range"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "given", "words"), BROKEN)
def test_invalid_latched_door_is_refused(kind: type[Mechanism], given: dict[str, Any], words: str) -> None:
    assert words in refused(kind, given)


def test_door_limits_may_be_expressions() -> None:
    wall = kv.position("wall")
    model = model_of(kv.articulations.Latch(**WHERE, door=kv.Limits(0.0, wall), bolt=kv.Limits(0.0)))
    assert not model.violations({"m/door": 0.3, "wall": 0.5, "m/bolt": 9.0})
    assert [v.name for v in model.violations({"m/door": 0.6, "wall": 0.5, "m/bolt": 0.0})] == [
        "m/door/position"
    ]
