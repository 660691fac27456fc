"""Joint effort limits from MJCF actuators."""

from __future__ import annotations

import math
from typing import Any

from .mujoco_api import mujoco


def joint_efforts(spec: Any) -> dict[str, float]:
    """Return the largest force [N] or torque [N m] of all actuators on each joint, by joint name.

    Joints with an actuator whose strength depends on its controller are missing.
    """
    engine = mujoco()
    direct = (engine.mjtTrn.mjTRN_JOINT, engine.mjtTrn.mjTRN_JOINTINPARENT)
    found: dict[str, float] = {}
    for actuator in spec.actuators:
        if actuator.trntype in direct:
            strength = _strength(actuator) * abs(float(actuator.gear[0]))
            found[actuator.target] = found.get(actuator.target, 0.0) + strength
    return {name: effort for name, effort in found.items() if math.isfinite(effort)}


def _strength(actuator: Any) -> float:
    """Return the largest force of an actuator; infinite if its controller decides it."""
    engine = mujoco()
    if _limited(actuator.forcelimited, actuator.forcerange):
        return _largest(actuator.forcerange)
    motor = (
        actuator.gaintype == engine.mjtGain.mjGAIN_FIXED
        and actuator.biastype == engine.mjtBias.mjBIAS_NONE
        and actuator.dyntype == engine.mjtDyn.mjDYN_NONE
    )
    if motor and _limited(actuator.ctrllimited, actuator.ctrlrange):
        return abs(float(actuator.gainprm[0])) * _largest(actuator.ctrlrange)
    return math.inf


def _limited(flag: Any, limits: Any) -> bool:
    """Return True if MuJoCo applies a range."""
    kinds = mujoco().mjtLimited
    return bool(flag == kinds.mjLIMITED_TRUE or (flag == kinds.mjLIMITED_AUTO and limits[0] < limits[1]))


def _largest(limits: Any) -> float:
    """Return the largest magnitude in a range."""
    return max(abs(float(limits[0])), abs(float(limits[1])))
