"""Robot of which nothing can be used but its interface, for tests of skills in simulated worlds."""

from __future__ import annotations

from typing import Any

from kineverse.worlds import RobotInterface

NAMES = {*RobotInterface.__annotations__, *(name for name in vars(RobotInterface) if name[0] != "_")}
"""Names of the interface: attributes, properties and methods."""


class InterfaceOnly:
    """Interface of a simulated world, whose truth nobody can reach."""

    __slots__ = ("_world",)

    def __init__(self, world: RobotInterface) -> None:
        object.__setattr__(self, "_world", world)

    def __getattribute__(self, name: str) -> Any:
        if name.startswith("__"):
            return object.__getattribute__(self, name)
        if name not in NAMES:
            raise AssertionError(f"'{name}' is not in the interface of a robot: {', '.join(sorted(NAMES))}.")
        return getattr(object.__getattribute__(self, "_world"), name)

    def __setattr__(self, name: str, value: object) -> None:
        raise AssertionError(f"'{name}' of a robot is set by nobody.")
