"""Parts of the shipped models that a URDF cannot express: mobile bases of robots, springs of joints.

A door on a hinge at its bottom has the mass m and the distance r of its centre from the hinge. The torque
m g r sin(q) opens it. The spring k (q - q_0) balances it best over [0, π/2] with

    k = 2/π · m g r,    q_0 = -0.165 rad,

which leaves at most 0.105 m g r: inward near 0 and outward about the middle. The friction of the hinge, in
the URDF, exceeds that, so that the door stays where it is left.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from kineverse import articulations
from kineverse.model.frame import WORLD

if TYPE_CHECKING:
    from kineverse.articulations import Joint


def mobile_base(model: str, prefix: str | None) -> Joint | None:
    """Return the mobile base of a shipped robot, None for a model without one."""

    def named(name: str) -> str:
        return f"{prefix}/{name}" if prefix else name

    name = named("base")
    if model in ("pr2", "hsr"):
        return articulations.OmniBase(name=name, parent=WORLD, child=name, speed=1.0, turn=0.6)
    if model == "fetch":
        return articulations.DifferentialDrive(
            name=name,
            parent=WORLD,
            child=name,
            radius=0.06,
            track=0.3748,
            left=named("l_wheel_joint"),
            right=named("r_wheel_joint"),
            wheel_speed=17.4,
        )
    return None


_REFERENCE = -0.165
_STIFFNESS = {"kitchen": {"oven_door": 15.1, "dishwasher_door": 30.6}}


def joint_spring(model: str, joint: str) -> tuple[tuple[str, float], ...]:
    """Return the spring of a joint as dynamics, (name, value) pairs; empty for a joint without one."""
    stiffness = _STIFFNESS.get(model, {}).get(joint)
    if stiffness is None:
        return ()
    return (("spring_stiffness", stiffness), ("spring_reference", _REFERENCE))
