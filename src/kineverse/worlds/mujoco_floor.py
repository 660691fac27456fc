"""Floor at z = 0 of a world with physics, where nothing of the model reaches below it."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from kineverse.formats.mjcf.mujoco_api import mujoco

from .mujoco_coordinates import MujocoCoordinates
from .mujoco_model import compile_world

_STANDS = -0.01, 0.005
"""Gaps between the floor and bodies that stand or roll on it [m]."""


def add_floor(
    spec: Any,
    coordinates: MujocoCoordinates,
    is_robot: Callable[[str], bool],
    names: Collection[str],
    samples: int,
    seed: int,
    remark: Callable[[str], None],
) -> None:
    """Add a floor to a specification, unless a body reaches below it.

    Bodies that stand on it at the default state, such as wheels, have no contact with it, unless they are
    loose and would fall. There is no floor if another body is below it then, or if furniture is in any
    sampled state: then z = 0 is no floor.
    """
    engine, name = mujoco(), "floor"
    while name in names:
        name += "_"
    body = spec.worldbody.add_body(name=name)
    geom = body.add_geom(type=engine.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], margin=_STANDS[1])
    compiled = compile_world(spec)
    data, random = engine.MjData(compiled), np.random.default_rng(seed)
    floor = compiled.body(name).id

    def touching() -> dict[str, float]:
        engine.mj_kinematics(compiled, data)
        engine.mj_comPos(compiled, data)
        engine.mj_collision(compiled, data)
        found: dict[str, float] = {}
        bodies = compiled.geom_bodyid[data.contact.geom]
        for (a, b), gap in zip(bodies.tolist(), data.contact.dist.tolist(), strict=True):
            if floor in (a, b):
                other = compiled.body(a + b - floor).name
                found[other] = min(gap, found.get(other, gap))
        return found

    data.qpos[:] = coordinates.positions(coordinates.default)
    standing, move = touching(), coordinates.sampler()
    below = {b for b, gap in standing.items() if gap < _STANDS[0]}
    for _ in range(samples):
        move(data, random)
        below |= {b for b, gap in touching().items() if gap < _STANDS[0] and not is_robot(b)}
    geom.margin = 0.0
    if below:
        geom.contype = geom.conaffinity = 0
        reason = f"{', '.join(sorted(below))} {'reaches' if len(below) == 1 else 'reach'} below z = 0"
        remark(f"there is no floor, as {reason}")
        return
    roots = {b: compiled.body_jntadr[compiled.body_rootid[compiled.body(b).id]] for b in standing}
    free = engine.mjtJoint.mjJNT_FREE
    borne = sorted(b for b, k in roots.items() if is_robot(b) or k < 0 or compiled.jnt_type[k] != free)
    for other in borne:
        spec.add_exclude(bodyname1=name, bodyname2=other)
    text = f"; these stand on it, without contact: {', '.join(borne)}" if borne else ""
    remark(f"there is a floor at z = 0{text}")
