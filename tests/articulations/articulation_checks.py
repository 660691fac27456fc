"""What has to hold for any articulation: its Jacobian, the motion law, limits kept by rows, being a value."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

import kineverse as kv
import time_derivative_checks
from kineverse.formats.document import to_json

Matrix = np.ndarray[Any, np.dtype[np.float64]]
State = Mapping[kv.Symbol, float]

ORIGIN = np.eye(4)
ORIGIN[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.8, 1.9]).as_matrix()
ORIGIN[:3, 3] = [0.5, -0.25, 2.0]
WHERE: dict[str, Any] = {
    "name": "j",
    "parent": "world",
    "child": "c",
    "origin": kv.model.Pose.from_matrix(ORIGIN),
}


def model_of(*operations: kv.Operation) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for operation in operations:
            edit.apply(operation)
    return model


def homogeneous(rotation: Rotation | None = None, position: Any = (0, 0, 0)) -> Matrix:
    result = np.eye(4)
    if rotation is not None:
        result[:3, :3] = rotation.as_matrix()
    result[:3, 3] = position
    return result


def turned(axis: Any, angle: float) -> Matrix:
    return homogeneous(Rotation.from_rotvec(np.asarray(axis) / np.linalg.norm(axis) * angle))


def slid(axis: Any, distance: float) -> Matrix:
    return homogeneous(position=np.asarray(axis) / np.linalg.norm(axis) * distance)


def random_state(model: kv.Model, seed: int, reach: float = 1.0) -> dict[kv.Symbol, float]:
    """Return values for all coordinates."""
    rng = np.random.default_rng(seed)
    return {s: float(rng.uniform(-reach, reach)) for s in model.symbols}


def assert_jacobian(model: kv.Model, frame: str, seed: int, reach: float = 1.0) -> None:
    """Each column is the twist that its speed makes, at a random place."""
    assert_jacobian_at(model, frame, random_state(model, seed, reach))


def assert_jacobian_at(model: kv.Model, frame: str, at: State) -> None:
    """Each column is the twist that its speed makes, found by moving there and back."""
    pose, speeds, h = model.fk(frame), model.speeds_of(frame), 1e-5
    jacobian = model.jacobian(frame)(at)
    assert jacobian.shape == (6, len(speeds))
    for column, speed in zip(jacobian.T, speeds, strict=True):
        before, after = (pose(model.integrate(at, {speed: 1.0}, dt)) for dt in (-h, h))
        turning = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
        twist = np.concatenate([after[:3, 3] - before[:3, 3], turning]) / (2 * h)
        np.testing.assert_allclose(column, twist, atol=2e-9 * max(1.0, float(np.abs(column).max())))


def assert_motion_law(
    model: kv.Model, expressions: list[kv.Expression], seed: int, start: State | None = None
) -> None:
    """Along q̇ = R(q)u, differences of values are ė, and those of ė are ë."""
    start = random_state(model, seed) if start is None else start
    rng = np.random.default_rng(seed + 1)
    speeds = {s: float(rng.uniform(-1, 1)) for s in model.speeds}
    time_derivative_checks.assert_time_derivatives(model, expressions, start, speeds)


def assert_rows_keep_limits(
    model: kv.Model, start: State, wish: Mapping[str, float], steps: int, dt: float, slack: float = 1e-9
) -> dict[kv.Symbol, float]:
    """Follow a wish as far as the rows allow; no constraint is ever broken. Return where it ends."""
    rows = model.velocity_rows(dt)
    assert not rows.skipped
    numbers = kv.compile([rows.matrix, rows.lower, rows.upper], model.symbols, tier="interpreter")
    goal = np.array([wish.get(str(s), 0.0) for s in rows.speeds])
    state = dict(start)
    for _ in range(steps):
        matrix, lower, upper = numbers([state[s] for s in model.symbols])
        both, bounds = np.vstack([matrix, -matrix]), np.concatenate([upper, -lower])
        keep = np.isfinite(bounds)
        found = linprog(-goal, both[keep], bounds[keep], bounds=[(-1e3, 1e3)] * len(goal), method="highs")
        assert found.status == 0, found.message
        speeds = dict(zip(rows.speeds, found.x.tolist(), strict=True))
        state = {**model.integrate(state, speeds, dt)}
        assert not model.violations({**state, **speeds}, tolerance=slack), (state, speeds)
    return state


def assert_is_a_value(operation: Any, model: kv.Model, folder: Path) -> None:
    """Operation and model can be copied, pickled, saved and read; it knows its coordinates."""
    for other in (copy.copy(operation), copy.deepcopy(operation), pickle.loads(pickle.dumps(operation))):
        assert other == operation
        assert hash(other) == hash(operation)
    record = model.articulations[operation.name]
    assert record.kind == type(operation).__name__.lower()
    assert (record.parent, record.child) == (operation.parent, operation.child)
    assert set(record.coordinates) <= set(model.degrees_of_freedom)
    assert set(record.speeds) <= set(model.speeds)
    assert len(record.home) == len(record.coordinates)
    assert pickle.loads(pickle.dumps(model)).snapshot() == model.snapshot()
    path = folder / "model.kv.json"
    model.save(path)
    read = kv.load(path)
    assert read.snapshot() == model.snapshot()
    assert to_json(read) == to_json(model)
