"""Random models with every kind of articulation, for the laws of kinematics and motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

import kineverse as kv

Matrix = npt.NDArray[np.float64]
KINDS = (
    "fixed",
    "revolute",
    "continuous",
    "prismatic",
    "planar",
    "floating",
    "omni",
    "differential",
    "mimic",
)


def constrained(triples: Mapping[str, tuple[Any, Any, Any]], *operations: kv.Operation) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for operation in operations:
            edit.apply(operation)
        for name, triple in triples.items():
            edit.constrain(name, *triple)
    return model


def random_pose(rng: np.random.Generator) -> kv.model.Pose:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(rng=rng).as_matrix()
    matrix[:3, 3] = rng.uniform(-1, 1, 3)
    return kv.model.Pose.from_matrix(matrix)


def joint(kind: str, name: str, parent: str, child: str, rng: np.random.Generator) -> kv.Operation:
    """Return a joint of a kind, placed and turned at random."""
    where = {"name": name, "parent": parent, "child": child, "origin": random_pose(rng)}
    axis = (
        tuple(rng.normal(size=3)) if rng.integers(2) else ((0, 0, 1), (0, -1, 0), (1, 0, 0))[rng.integers(3)]
    )
    if kind == "fixed":
        return kv.Fixed(**where)
    if kind == "revolute":
        return kv.Revolute(**where, axis=axis, lower=-2, upper=2, velocity=1)
    if kind == "continuous":
        return kv.Continuous(**where, axis=axis)
    if kind == "prismatic":
        return kv.Prismatic(**where, axis=axis, lower=-1, upper=1)
    if kind == "planar":
        return kv.Planar(**where, axis=axis)
    if kind == "floating":
        return kv.Floating(**where)
    if kind == "omni":
        return kv.articulations.OmniBase(**where)
    if kind == "differential":
        return kv.articulations.DifferentialDrive(**where, radius=0.2, track=0.5, wheel_speed=3)
    source = kv.position("shared")
    return kv.Revolute(**where, axis=axis, position=0.5 * source + 0.1 * source**2)


def random_tree(seed: int, size: int = 9) -> kv.Model:
    """Return a tree of frames joined at random; every kind of joint occurs."""
    rng, model = np.random.default_rng(seed), kv.Model()
    kinds = [*rng.permutation(KINDS), *rng.choice(KINDS, max(0, size - len(KINDS)))]
    frames = ["world"]
    with model.edit() as edit:
        for i, kind in enumerate(kinds):
            parent = frames[rng.integers(max(0, len(frames) - 3), len(frames))]
            frames.append(f"f{i}")
            edit.apply(joint(str(kind), f"j{i}", parent, f"f{i}", rng))
    return model


def random_state(model: kv.Model, seed: int) -> dict[kv.Symbol, float]:
    """Return values for all coordinates; quaternions of length one."""
    rng = np.random.default_rng(seed)
    values = {s: float(rng.uniform(-1, 1)) for s in model.symbols}
    for record in model.articulations.values():
        if record.kind == "floating":
            quaternion = record.coordinates[3:]
            length = float(np.linalg.norm([values[s] for s in quaternion]))
            values.update({s: values[s] / length for s in quaternion})
    return values


def random_speeds(model: kv.Model, seed: int) -> dict[kv.Symbol, float]:
    rng = np.random.default_rng(seed + 1000)
    return {s: float(rng.uniform(-1, 1)) for s in model.speeds}


def twist_between(before: Matrix, after: Matrix, step: float) -> Matrix:
    """Return velocity of the origin and angular velocity, in axes of the frame that poses are given in."""
    omega = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
    return np.concatenate([after[:3, 3] - before[:3, 3], omega]) / step
