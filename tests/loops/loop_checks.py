"""What every closed loop has to do, for any model."""

from __future__ import annotations

import numpy as np

import kineverse as kv
from kineverse.loops import CloseLoop
from kineverse.loops.equations import AXES


def loops_of(model: kv.Model) -> list[CloseLoop]:
    operations = [model.history.entry(tag).operation for tag in model.history.tags]
    return [o for o in operations if isinstance(o, CloseLoop)]


def record(model: kv.Model, name: str) -> dict:
    return dict(model.articulations[name].dynamics)


def residual(model: kv.Model) -> kv.Expression:
    """Return what is left between the ends of all loops, all rows of their masks [m], [rad]."""
    rows = []
    for loop in loops_of(model):
        for frame, to in ((loop.frame, loop.to), *loop.more):
            pose = model.fk(frame, to)
            r = pose[:3, :3]
            by_name = dict(zip(AXES, [*(pose[i, 3] for i in range(3)), *vector_of(r)], strict=True))
            rows += [by_name[axis] for axis in loop.mask]
    return kv.array(rows)


def vector_of(rotation):
    """Return the axis of a rotation times the sine of its angle."""
    r = rotation
    return [(r[2, 1] - r[1, 2]) / 2, (r[0, 2] - r[2, 0]) / 2, (r[1, 0] - r[0, 1]) / 2]


def configurations(model: kv.Model, count: int, turns: float = 8.0) -> np.ndarray:
    """Return configurations within the limits of what is free; what goes round goes round many times."""
    bounds = np.array([model.limits(s) for s in model.degrees_of_freedom]).reshape(-1, 2)
    bounds = np.where(np.isfinite(bounds), bounds, np.array([-turns, turns]) * np.pi)
    points = np.random.default_rng(0).uniform(bounds[:, 0], bounds[:, 1], (count, len(bounds)))
    corners = np.array(np.meshgrid(*bounds)).reshape(len(bounds), -1).T
    points[: len(corners)] = corners
    if len(bounds) == 1:
        points = np.sort(points, axis=0)
    return points


def function(model: kv.Model, *outputs):
    return kv.compile(list(outputs), model.degrees_of_freedom, tier="interpreter")


def assert_closed(model: kv.Model, count: int = 1000, tolerance: float = 1e-10) -> None:
    gaps = function(model, residual(model)).batch(configurations(model, count))[0]
    assert gaps.shape[1] > 0
    assert np.abs(gaps).max() <= tolerance


def assert_moves_as_its_jacobian_says(
    model: kv.Model, frame: str, count: int = 40, to: str = "world"
) -> None:
    """Compare the Jacobian of a frame with central differences of its pose."""
    poses = function(model, model.fk(frame, to))
    jacobians = function(model, model.jacobian(frame, to, symbols=model.degrees_of_freedom))
    step = 1e-5
    for q in configurations(model, count)[:count]:
        (jacobian,) = jacobians(q)
        middle = poses(q)[0][:3, :3]
        for column, e in zip(jacobian.T, np.eye(len(q)) * step, strict=True):
            after, before = poses(q + e)[0], poses(q - e)[0]
            turned = (after - before)[:3, :3] @ middle.T / (2 * step)
            wanted = [*(after - before)[:3, 3] / (2 * step), *vector_of(turned)]
            np.testing.assert_allclose(column, wanted, rtol=0, atol=2e-7 * max(1, np.abs(column).max() ** 2))


def dependent(model: kv.Model) -> kv.Expression:
    """Return the coordinates that follow, in the order of their names."""
    followers = sorted(model.rates.dependent, key=str)
    return kv.array([model.rates.carried(s) for s in followers])
