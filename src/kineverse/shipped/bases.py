"""Mobile bases of the shipped robots, which a URDF cannot express."""

from __future__ import annotations

from kineverse.articulations import DifferentialDrive, Joint, OmniBase
from kineverse.model.frame import WORLD


def mobile_base(model: str, prefix: str | None) -> Joint | None:
    """Return the mobile base of a shipped robot, None for a model without one."""

    def named(name: str) -> str:
        return f"{prefix}/{name}" if prefix else name

    name = named("base")
    if model in ("pr2", "hsr"):
        return OmniBase(name=name, parent=WORLD, child=name, speed=1.0, turn=0.6)
    if model == "fetch":
        return DifferentialDrive(
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
