"""Springs of the shipped models' joints, which a URDF cannot express.

A door on a hinge at its bottom has the mass m and the distance r of its centre from the hinge. The torque
m g r sin(q) opens it. The spring k (q - q_0) balances it best over [0, π/2] with

    k = 2/π · m g r,    q_0 = -0.165 rad,

which leaves at most 0.105 m g r: inward near 0 and outward about the middle. The friction of the hinge, in
the URDF, exceeds that, so that the door stays where it is left.
"""

from __future__ import annotations

_REFERENCE = -0.165
_STIFFNESS = {
    "kitchen": {"oven_door": 15.1, "dishwasher_door": 30.6},
}


def joint_spring(model: str, joint: str) -> tuple[tuple[str, float], ...]:
    """Return the spring of a joint as dynamics, (name, value) pairs; empty for a joint without one."""
    stiffness = _STIFFNESS.get(model, {}).get(joint)
    if stiffness is None:
        return ()
    return (("spring_stiffness", stiffness), ("spring_reference", _REFERENCE))
