"""Jacobians after a document, to the last bit: a motion is the same however it was written down."""

from __future__ import annotations

import numpy as np
import pytest

import kineverse as kv
from kineverse.formats.document import read_operations, to_json
from kineverse.spatial import OneAxisTransform

Q, P = kv.position("q"), kv.position("p")
AXES = ((1, 2, 3), (-0.6, 0, 0.8), (0, -1, 0), (1, 0, 0), (0.6, 0.8, 0), (0, 0, 2))
AMOUNTS = (None, 2 * Q, -Q, 0.3 * Q + 0.1, -3 * Q - 0.2, Q * Q, np.sin(Q))
TRANSFORMS = (
    kv.translation(0.6 * Q, 0, 0.8 * Q),
    kv.translation(Q, P, 0),
    kv.translation(0, 0, 2 * Q),
    kv.translation(-Q, 0, 0),
    kv.translation(Q, Q, 0),
    kv.translation(0.6 * P, 0.8 * P, 0) @ kv.rotation_z(Q),
    kv.rotation_y(-2 * Q),
    kv.array([[np.cos(P), -np.sin(P), 0, 0], [np.sin(P), np.cos(P), 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
    kv.array([[np.cos(P), -np.sin(Q), 0, 0], [np.sin(Q), np.cos(Q), 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
    kv.rotation_x(Q.augment({kv.velocity("wheel"): P})),
)


def read_again(model: kv.Model) -> kv.Model:
    text, result = to_json(model), kv.Model()
    with result.edit() as edit:
        for tag, operation in read_operations(text):
            edit.apply(operation, tag)
    assert result.snapshot() == model.snapshot()
    assert to_json(result) == text
    return result


def assert_same_bits(model: kv.Model, other: kv.Model) -> None:
    frames, rng = list(model.frames), np.random.default_rng(1)
    ours, theirs = ([m.jacobian(frame) for frame in frames] for m in (model, other))
    for frame, a, b in zip(frames, ours, theirs, strict=True):
        assert a.symbols == b.symbols, frame
    one, two = (np.concatenate([e.ravel() for e in side]) for side in (ours, theirs))
    for _ in range(3):
        at = {s: rng.uniform(-1, 1) for s in one.symbols}
        assert one(at).tobytes() == two(at).tobytes()


@pytest.mark.parametrize("axis", AXES, ids=str)
def test_jacobian_of_joints_by_any_amount_survives_a_document(axis: tuple[float, float, float]) -> None:
    model, parent = kv.Model(), "world"
    with model.edit() as edit:
        for k, amount in enumerate(AMOUNTS):
            for kind in (kv.Prismatic, kv.Revolute):
                name = f"{kind.__name__}{k}"
                edit.apply(kind(name=name, parent=parent, child=name, axis=axis, position=amount))
                parent = name
    assert_same_bits(model, read_again(model))


def test_one_axis_transforms_are_recognised_in_documents() -> None:
    model, parent = kv.Model(), "world"
    with model.edit() as edit:
        for k, transform in enumerate(TRANSFORMS):
            edit.add_frame(f"f{k}", parent=parent, transform=transform)
            parent = f"f{k}"
    read = read_again(model)
    assert_same_bits(model, read)
    kinds = [[type(f) for f in m.frames[n].factors] for m in (model, read) for n in model.frames]
    assert kinds[: len(TRANSFORMS)] == kinds[len(TRANSFORMS) :]
    is_motion = [OneAxisTransform in kind for kind in kinds[: len(TRANSFORMS)]]
    assert is_motion == [True, False, True, True, False, False, True, False, False, True]


def test_one_axis_transform_from_a_document_has_the_same_matrix() -> None:
    for transform in TRANSFORMS:
        (factor,) = kv.model.Frame.from_transform("world", transform).factors
        assert factor == transform
