"""One of each mechanism, and its relatives with other numbers, at a place in the world."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from articulation_checks import ORIGIN, Matrix, homogeneous, model_of, turned

import kineverse as kv
from kineverse.articulations import Mechanism

WHERE: dict[str, Any] = {"name": "m", "parent": "world", "origin": kv.model.Pose.from_matrix(ORIGIN)}

EVERY: dict[str, Mechanism] = {
    "garage door": kv.articulations.GarageDoor(**WHERE),
    "published garage door": kv.articulations.GarageDoor(**WHERE, form="published", length=2.2),
    "folding door": kv.articulations.FoldingDoor(**WHERE),
    "door with handle": kv.articulations.DoorWithHandle(**WHERE),
    "latch": kv.articulations.Latch(**WHERE),
    "microwave": kv.articulations.Microwave(**WHERE),
    "faucet": kv.articulations.Faucet(**WHERE),
    "piston and rod": kv.articulations.PistonAndRod(**WHERE, turn=kv.Limits(-7.0, 7.0, 10.0)),
    "pedal bin": kv.articulations.PedalBin(**WHERE),
    "screw and nut": kv.articulations.ScrewAndNut(**WHERE),
    "left-handed screw": kv.articulations.ScrewAndNut(**WHERE, pitch=-0.02, travel=0.3, velocity=None),
    "ratchet": kv.articulations.Ratchet(**WHERE),
    "scissor lift": kv.articulations.ScissorLift(**WHERE),
    "whole scissor lift": kv.articulations.ScissorLift(
        **WHERE, stages=1, angle=kv.Limits(0.0, np.pi / 2, 1.0)
    ),
    "desk lamp": kv.articulations.DeskLamp(**WHERE),
}

KINDS: tuple[type[Mechanism], ...] = tuple({type(m): None for m in EVERY.values()})


def pose(operation: Mechanism, part: str, at: Mapping[str, float]) -> Matrix:
    """Return base_T_part as numbers."""
    found: Matrix = model_of(operation).fk(f"m/{part}", "m/base")(kv.State(at))
    return found


def ends(mechanism: Mechanism, q: kv.Symbol) -> tuple[float, float]:
    """Return the limits of a coordinate itself, without what locks it at the moment."""
    limits = mechanism.limits[q.path]
    low, high = (float("inf") if end is None else float(end) for end in (limits.lower, limits.upper))
    return (-low if limits.lower is None else low), high


def across(mechanism: Mechanism, steps: int = 9) -> list[dict[kv.Symbol, float]]:
    """Return states over the whole range of every coordinate, its ends included; the others at home."""
    model = model_of(mechanism)
    home, states = dict(model.default_state()), []
    for q in model.degrees_of_freedom:
        lower, upper = np.clip(ends(mechanism, q), -7.0, 7.0)
        states += [{**home, q: float(v)} for v in np.linspace(lower, upper, steps)]
    return states


def about_y(angle: float) -> Matrix:
    return turned((0, 1, 0), angle)


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Matrix:
    return homogeneous(position=(x, y, z))


def refused(kind: type[Mechanism], given: Mapping[str, Any]) -> str:
    """Return what the error says when a mechanism is made and applied; the model is what it was."""
    model = model_of(kv.Fixed(name="old", parent="world", child="old"))
    before = model.snapshot()
    try:
        with model.edit() as edit:
            edit.apply(kind(**{**WHERE, **given}), tag="mine")
    except kv.KineverseError as error:
        assert model.snapshot() == before
        return f"{type(error).__name__}: {error}"
    raise AssertionError("nothing was raised")
