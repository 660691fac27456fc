"""A model with something upstream, an operation of anybody's code that reads it, and what strangers make of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scenes import build_scene  # noqa: F401  - it is no part of the package

import kineverse as kv
from kineverse.formats.document import to_json

LIFT, KNOB, WHEEL = kv.position("lift"), kv.position("knob"), kv.velocity("wheel")


@dataclass(frozen=True)
class Custom(kv.Operation):
    """An operation of anybody's code."""

    code: Callable[[kv.model.ReadRecorder], kv.model.Writes]
    name: str = "custom"

    def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
        return self.code(model)


def build(code: Callable[[kv.model.ReadRecorder], kv.model.Writes], **changes: Any) -> kv.Model:
    """Return a model with something upstream to read and an operation that reads it."""
    given = {
        "car": kv.translation(0.1, 0, 2 * LIFT) @ kv.rotation_x(LIFT),
        "upper": 3.0,
        "number": 1.5,
        "damping": 0.1,
        **changes,
    }
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("car", parent="world", transform=given["car"])
        edit.constrain("range", 0, LIFT, given["upper"])
        edit.write("number", given["number"])
        hinge = kv.Revolute(
            name="hinge",
            parent="car",
            child="flap",
            axis=(0, 1, 0),
            dynamics=(("damping", given["damping"]),),
        )
        edit.apply(hinge, "hinge")
        edit.apply(Custom(code), "custom")
    return model


def reloaded(model: kv.Model) -> kv.Model:
    """Return what a process without the code makes of a model."""
    return read_document(to_json(model))


def read_document(text: str, prefix: str | None = None) -> kv.Model:
    """Return what a process without the code makes of the document of a model."""
    return kv.formats.from_bytes(text.encode(), prefix)


def changed(model: kv.Model, other: kv.Model) -> None:
    """Exchange what is upstream for what another model has there."""
    with model.edit() as edit:
        for tag in ("frame car", "constraint range", "data number", "hinge"):
            edit.replace(tag, other.history.operation(tag))


def agree(one: kv.Model, other: kv.Model) -> None:
    """Compare everything that two models contain by its values and gradients."""
    assert list(one.frames) == list(other.frames)
    assert list(one.constraints) == list(other.constraints)
    at = kv.State({"lift": 0.3, "knob": -0.4, "hinge": 0.2, "wheel:velocity": 0.7, "lift:velocity": 1.1})
    pairs = [(one.fk(f), other.fk(f)) for f in one.frames]
    for name, constraint in one.constraints.items():
        twin = other.constraints[name]
        pairs += [(constraint.lower, twin.lower), (constraint.upper, twin.upper)]
        pairs += [(constraint.expression, twin.expression)]
    entries = list(pairs)
    for a, b in pairs:
        assert a.symbols == b.symbols
        for heuristic in (True, False):
            ours, theirs = a.gradient(heuristic), b.gradient(heuristic)
            assert set(ours) == set(theirs)
            entries += [(entry, theirs[key]) for key, entry in ours.items()]
    assert all(a.shape == b.shape for a, b in entries)
    # All at once: an evaluation is a function of casadi's that has to be made.
    wanted, found = (np.concatenate([e.ravel() for e in side])(at) for side in zip(*entries, strict=True))
    np.testing.assert_allclose(found, wanted, rtol=1e-13, atol=1e-14)
